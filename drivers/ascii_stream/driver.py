"""Sensors that print lines of numbers: Arduino-class boards, load-cell amplifiers, laboratory meters that talk by
themselves.

One line is one sample of all channels; ``sioms.drivers.ascii_stream.codec`` tells what a line may look like. Most of
these devices
can say no name: the driver takes them for what their lines look like, and for the words of a greeting where they have
one. With a time column each sample carries the time at which the device took it, by a running fit of its clock; without
one the time at which the line's last byte arrived.

    [device.scale0]
    driver = "ascii-stream"
    line = { serial = "/dev/ttyUSB0", baud = 115200 }
    columns = ["left", "right"]
    unit = "N"
    scale = 0.0098
    rate_hz = 80.0
    time = "ms"

A finger that prints its elements' readings has a table ``shape``, see ``tactile_nodes``: strains and what touches it
are then published with every line.
"""

from __future__ import annotations

import errno
import math
import time
from collections.abc import Mapping, Sequence
from typing import Any, Literal, TypeVar

import msgspec
import numpy as np

from sioms.drivers import tactile_nodes
from sioms.protocol.flags import AnalogStatus, NodeClass
from sioms.protocol.nodeinfo import ChannelInfo
from sioms.sdk.blocks import BlockSpec, Description
from sioms.sdk.device_clock import DeviceClock
from sioms.sdk.driver import Kit, StreamDriver
from sioms.sdk.exchange import DeviceError, Exchange, LinkError, Send, Steps
from sioms.sdk.golden import Golden, Incomplete
from sioms.sdk.settings import LineSettings

from .codec import MAX_LINE_BYTES, LineReceiver

T = TypeVar("T")
CLOCKS = {"us": (1.0, 1 << 32), "ms": (1e3, 1000 << 32), "s": (1e6, 1 << 32)}
"""Unit of a time column to microseconds in it, and to the microseconds after which a 32-bit counter begins again."""
TRIES = 5
"""Lines after which a device that sent no good one is another device."""
LINE_SHARE = 0.95
"""Part of the line's capacity that a stream may fill."""
SET_BACK_US = 100_000
"""A time column that goes back by more than this is a board that has restarted."""
NEVER_NS = 1 << 62
GREETED_NS = 10_000_000_000
"""A device that was read so short a time ago need not greet again: a board greets when it starts."""


class AsciiStreamSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Keys of the device.

    Attributes:
        line: the line that the device is on.
        columns: names of the channels, in the order of the columns, without the time column.
        rate_hz: lines per second that the device sends; a silence of 20 lines, or 0.25 s, is a loss.
        unit: of the values; one, or one a channel.
        scale, offset: value = (number - offset) * scale; one number, or one a channel.
        time: unit of the first column when that is the device's clock; "" when there is none.
        checksum: every line must end in ``*hh``; without, a checksum is checked where it is.
        greeting: words that one of the lines after opening must contain, comments included.
        start, stop: sent on opening and on closing, with the ends of line written in them ("RUN\\r\\n").
        open_s: longest time until the first good line [s]; boards that restart when opened take two.
        frozen_after: equal lines in a row after which the device counts as frozen, and its link as lost; 0 = never. For
            devices without a time column whose noise is larger than their last digit: nothing else tells.
        low, high: numbers at which the converter is at its end: at or beyond them a sample is SATURATED.
        minimum, maximum: range of the values [unit].
        history: snapshots kept for readers.
        shape: of a tactile finger: shows its strains and the shape that touches it, too.
    """

    line: LineSettings
    columns: list[str]
    rate_hz: float
    unit: str | list[str] = ""
    scale: float | list[float] = 1.0
    offset: float | list[float] = 0.0
    time: Literal["", "us", "ms", "s"] = ""
    checksum: bool = False
    greeting: str = ""
    start: str = ""
    stop: str = ""
    open_s: float = 3.0
    frozen_after: int = 0
    low: float | None = None
    high: float | None = None
    minimum: float | None = None
    maximum: float | None = None
    history: int = 256
    shape: tactile_nodes.ShapeSettings | None = None


class AsciiStream(tactile_nodes.FingerDriver, StreamDriver):
    """A device that prints its samples.

    Concurrency: the one thread of the driver process.
    """

    Settings = AsciiStreamSettings

    @classmethod
    def describe(cls, name: str, settings: AsciiStreamSettings) -> Description:
        """Tell the channels; raises ValueError for what no line could carry."""
        _check(settings)
        units = _each(settings.unit, len(settings.columns))
        channels = tuple(
            ChannelInfo(column, unit, settings.minimum, settings.maximum)
            for column, unit in zip(settings.columns, units, strict=True)
        )
        block = BlockSpec("", NodeClass.ANALOG, channels, history=settings.history)
        more = tactile_nodes.specs(settings.shape, len(settings.columns), settings.history)
        felt = tactile_nodes.inputs(settings.shape)
        return Description((block, *more), settings.rate_hz, felt, max(0.5, 10 / settings.rate_hz))

    @classmethod
    def golden(cls, settings: Any) -> Sequence[Golden]:
        """Return lines of the format's description, behind the cut one that every stream begins with."""

        def first(data: bytes) -> tuple[float, ...]:
            rows = LineReceiver(3, checked=True).feed(data)
            if not rows:
                raise Incomplete("no good line")
            return rows[0]

        return tuple(
            Golden(what, reply=(b"\n" + line).hex(" "), value=(1.0, 2.0, 3.0), read=first)
            for what, line in (("commas", b"1,2,3*30\n"), ("blanks, CR LF", b"1 2 3*30\r\n"))
        )

    def __init__(self, name: str, settings: AsciiStreamSettings, kit: Kit) -> None:
        super().__init__(name, settings, kit)
        self.line = settings.line
        self.silence_s = max(0.25, 20 / settings.rate_hz)
        self._make_blocks(self.describe(name, settings).blocks, settings.shape)
        n = self._block.n
        self._scale = np.array(_each(settings.scale, n), dtype=np.float64)
        self._offset = np.array(_each(settings.offset, n), dtype=np.float64)
        self._low = -math.inf if settings.low is None else settings.low
        self._high = math.inf if settings.high is None else settings.high
        self._receiver = LineReceiver(_columns(settings), settings.checksum)
        modulus_us = CLOCKS[settings.time][1] if settings.time else 0
        self._clock = DeviceClock(name, kit, 1e6, modulus_us) if settings.time else None
        self._modulus_us = modulus_us
        self._time_us: int | None = None
        self._gone_on_ns = 0
        self._is_open_anew = True
        self._last: tuple[float, ...] | None = None
        self._equal = 0
        self._good_ns, self._since_ns = -GREETED_NS, NEVER_NS
        line = settings.line
        self._character_ns = 1e9 * line.bits_per_character / line.baud if line.serial else 0.0
        self._stamp_ns = 0
        self._dropped = 0

    def open(self) -> Steps:
        """Wait for the greeting and a good line; tell what is wrong with the lines when none comes."""
        self._receiver.restart()
        settings = self.settings
        is_known = time.monotonic_ns() - self._good_ns < GREETED_NS
        greeting = "" if is_known else settings.greeting
        inspection = Inspection(_columns(settings), settings.checksum, greeting)
        start = settings.start.encode("ascii")
        what = f"wait for lines of {_columns(settings)} numbers from {self.name} on {self.line}"
        yield Exchange(start, inspection.want, lambda reply: None, settings.open_s, False, what)
        self._dropped = self._receiver.counters.dropped
        self._is_open_anew, self._since_ns, self.trouble = True, NEVER_NS, ""

    def feed(self, data: bytes, now_ns: int) -> int:
        """Publish a snapshot for every good line."""
        good, end = 0, 0
        greeting = self.settings.greeting.encode()
        for piece in data.splitlines(keepends=True):
            end += len(piece)
            if greeting and greeting in piece and now_ns - self._since_ns > self.settings.open_s * 1e9:
                raise LinkError(f"{self.name}: it has greeted again: it has restarted")
            for row in self._receiver.feed(piece):
                # the bytes behind a line's end came after it
                arrived_ns = now_ns - round((len(data) - end) * self._character_ns)
                if self._is_fresh(row, arrived_ns):
                    self._take(row, arrived_ns, now_ns)
                    good += 1
        if good:
            self._since_ns = min(self._since_ns, now_ns)
            self._good_ns, self.trouble = now_ns, ""
        return good

    def counters(self) -> Mapping[str, int | str]:
        """Return what the receiver saw."""
        seen = self._receiver.counters
        return {
            "lines": seen.lines,
            "bad_columns": seen.bad_columns,
            "bad_number": seen.bad_number,
            "bad_checksum": seen.bad_checksum,
            "oversized": seen.oversized,
            "equal": self._equal,
            **(self._clock.counters() if self._clock is not None else {}),
        }

    def close(self) -> Steps:
        """Tell the device to be silent, where it knows how."""
        if self.settings.stop:
            yield Send(self.settings.stop.encode("ascii"), "stop")

    def _is_fresh(self, row: tuple[float, ...], now_ns: int) -> bool:
        """Tell whether a line is a new sample; raises LinkError when its time says that the board has restarted."""
        if self._clock is not None and not self._has_gone_on(row[0], now_ns):
            return False
        self._equal = self._equal + 1 if row == self._last else 0
        self._last = row
        limit = self.settings.frozen_after
        if limit and self._equal >= limit:
            self.trouble = f"the last {self._equal + 1} lines were all the same: the device is frozen"
            return False
        return True

    def _has_gone_on(self, number: float, now_ns: int) -> bool:
        """Tell whether the time column goes on; it may stand still while lines come faster than it counts."""
        time_us, last_us = self._device_us(number), self._time_us
        behind_us = 0 if last_us is None else (last_us - time_us) % self._modulus_us
        if last_us is not None and not self._is_open_anew and SET_BACK_US < behind_us < self._modulus_us // 2:
            raise LinkError(f"{self.name}: its time went from {last_us} back to {time_us} us: it has restarted")
        is_old = behind_us == 0 if self._is_open_anew else behind_us < self._modulus_us // 2
        if last_us is None or not is_old:
            self._time_us, self._gone_on_ns, self._is_open_anew = time_us, now_ns, False
            return True
        if self._is_open_anew or now_ns - self._gone_on_ns > self.silence_s / 2 * 1e9:
            self.trouble = (
                f"lines come, but their time stands still at {number:g} {self.settings.time}: the device is frozen"
            )
            return False
        return behind_us == 0

    def _device_us(self, number: float) -> int:
        return round(number * CLOCKS[self.settings.time][0]) % self._modulus_us

    def _take(self, row: tuple[float, ...], now_ns: int, begun_ns: int) -> None:
        arrived_ns = now_ns
        if self._clock is not None:
            now_ns = self._clock.to_host(self._device_us(row[0]), now_ns)
            row = row[1:]
        numbers = np.array(row)
        flags = np.where((numbers <= self._low) | (numbers >= self._high), int(AnalogStatus.SATURATED), 0)
        dropped = self._receiver.counters.dropped
        if dropped != self._dropped:
            flags |= int(AnalogStatus.OVERRUN)
            self._dropped = dropped
        np.subtract(numbers, self._offset, out=self._block.data)
        np.multiply(self._block.data, self._scale, out=self._block.data)
        self._block.flags[:] = flags
        self._stamp_ns = self._block.stamp_ns = max(now_ns, self._stamp_ns + 1)
        self.kit.publish(self._block, self._block.stamp_ns)
        if self._finger is not None:
            stamp_ns = self._block.stamp_ns
            for derived in self._finger.take(self._block.data, self._block.flags, stamp_ns, arrived_ns, begun_ns):
                self.kit.publish(derived, derived.stamp_ns)


class Inspection:
    """Looks at the first lines of a device until one is good, or none will be.

    Args:
        columns: numbers that a line must have.
        checked: every line must carry a checksum.
        greeting: words that a line before it must contain.
    """

    def __init__(self, columns: int, checked: bool, greeting: str) -> None:
        self._columns, self._checked, self._greeting = columns, checked, greeting

    def want(self, reply: bytes) -> int | None:
        """Return where the first good line ends, None while there is none.

        Raises:
            LinkError: this is not text: a wrong baud rate, most likely.
            DeviceError: another device: its lines are never what is configured.
        """
        end = reply.find(b"\n") + 1  # the first line is cut
        if not end and len(reply) > MAX_LINE_BYTES:
            raise LinkError(f"{len(reply)} bytes without an end of line; is this the right device and baud rate")
        receiver, tried, greeted = LineReceiver(self._columns, self._checked), 0, not self._greeting
        receiver.feed(reply[:end])
        greeted = greeted or self._greeting.encode() in reply[:end]
        while end and (next_end := reply.find(b"\n", end) + 1):
            line, end = reply[end:next_end], next_end
            greeted = greeted or self._greeting.encode() in line
            if receiver.feed(line) and greeted:
                return end
            tried = receiver.counters.dropped + receiver.counters.lines
            if tried >= TRIES:
                raise self._refusal(line, receiver, greeted)
        return None

    def _refusal(self, line: bytes, receiver: LineReceiver, greeted: bool) -> DeviceError:
        seen = receiver.counters
        text = line.decode("ascii", "replace").strip()[:60]
        if not greeted and seen.lines:
            why = f"did not greet with {self._greeting!r}; check the port and the key greeting"
        elif seen.bad_checksum:
            why = f"sends lines without a right checksum, e.g. {text!r}; check checksum and baud"
        elif seen.bad_columns and text.isascii():
            columns = f"{self._columns} number{'s' * (self._columns > 1)} a line, the time column included"
            why = f"sends other lines, e.g. {text!r}; the configuration says {columns}"
        else:
            why = f"sends lines that are not numbers, e.g. {text!r}; check the baud rate"
        return DeviceError(errno.ENODEV, f"identify the device: it {why}")


def _each(value: T | list[T], n: int) -> list[T]:
    return value if isinstance(value, list) else [value] * n


def _columns(settings: AsciiStreamSettings) -> int:
    return len(settings.columns) + bool(settings.time)


def _check(settings: AsciiStreamSettings) -> None:
    """Raise ValueError for settings that contradict each other or the line."""
    n = len(settings.columns)
    if not n:
        raise ValueError("columns: none given; want a name for each column")
    for key in ("unit", "scale", "offset"):
        value = getattr(settings, key)
        if isinstance(value, list) and len(value) != n:
            raise ValueError(f"{key}: {len(value)} for {n} columns; want one for all, or one each")
    for key in ("scale", "offset"):
        numbers = _each(getattr(settings, key), n)
        if not all(map(math.isfinite, numbers)) or (key == "scale" and 0 in numbers):
            raise ValueError(f"{key} = {numbers}; want finite numbers{', not 0' if key == 'scale' else ''}")
    if not 0.1 <= settings.rate_hz <= 20_000:
        raise ValueError(f"rate_hz = {settings.rate_hz:g}; want 0.1 to 20000")
    if not 0 < settings.open_s <= 60:
        raise ValueError(f"open_s = {settings.open_s:g}; want more than 0 and up to 60")
    if settings.frozen_after < 0 or settings.frozen_after == 1:
        raise ValueError(f"frozen_after = {settings.frozen_after}; want 0 for never, or 2 and more")
    if settings.low is not None and settings.high is not None and settings.low >= settings.high:
        raise ValueError(f"low = {settings.low:g} and high = {settings.high:g}; want low below high")
    for key in ("start", "stop", "greeting"):
        if not getattr(settings, key).isascii():
            raise ValueError(f"{key} = {getattr(settings, key)!r}; want ASCII characters")
    line = settings.line
    if line.serial is None and line.tcp is None:
        raise ValueError("line: lines of numbers come on serial and tcp; want one of these")
    if line.serial is not None:
        shortest = 2 * _columns(settings) + 3 * settings.checksum
        top_hz = LINE_SHARE * line.baud / line.bits_per_character / shortest
        if settings.rate_hz > top_hz:
            raise ValueError(
                f"rate_hz = {settings.rate_hz:g}: lines of {shortest} bytes, the shortest possible, at {line.baud} "
                "baud "
                f"carry {top_hz:.0f} Hz; want a lower rate or a faster line"
            )
