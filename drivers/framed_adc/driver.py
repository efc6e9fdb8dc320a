"""Tactile arrays and ADC front ends that push framed samples (COBS, CRC, own clock).

The device is asked what it is, started at a rate, and kept alive by a hello every second; it stops by itself 5 s after
the last. Each block carries the time at which it was sampled, by a running fit of the device's clock.

    [device.tactile0]
    driver = "framed-adc"
    line = { serial = "/dev/ttyACM0", baud = 115200 }
    channels = 16
    rate_hz = 200
    scale = 0.0005
    unit = "N"

The front end of a calibrated tactile finger has a table ``shape``, see ``tactile_nodes``: the strains and what touches
the finger are then published with every block.
"""

from __future__ import annotations

import errno
import math
from collections.abc import Mapping, Sequence
from typing import Any

import msgspec
import numpy as np

from sioms.drivers import tactile_nodes
from sioms.protocol.flags import AnalogStatus, NodeClass
from sioms.protocol.nodeinfo import ChannelInfo
from sioms.sdk.blocks import BlockSpec, Description
from sioms.sdk.codec.sequence import SequenceWatch
from sioms.sdk.device_clock import DeviceClock
from sioms.sdk.driver import Kit, StreamDriver
from sioms.sdk.exchange import DeviceError, LinkError, Send, Steps
from sioms.sdk.golden import Golden, Incomplete
from sioms.sdk.settings import LineSettings

from . import codec as stream
from .cobs import FrameReceiver, frame

_BYTES = {"i16": 2, "i32": 4, "f32": 4}
_FIXED_BYTES = 10 + 2 + 2
"""Header, CRC, code byte and closing zero of a sample frame."""
LINE_SHARE = 0.95
"""Part of the line's capacity that a stream may fill."""
RATE_BLOCKS, RATE_S = 20, 0.25
"""The rate is looked at over so many blocks and so long a time."""
RATE_TOLERANCE = 0.05
LATE_US = 1_000_000


class FramedAdcSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Keys of the device.

    Attributes:
        line: the line that the device is on.
        channels: number of values in a block; the device must have as many.
        rate_hz: blocks per second.
        scale, offset: value = (raw - offset) * scale; one number, or one a channel.
        unit: of the values.
        names: of the channels; c0, c1 ... without.
        minimum, maximum: range of the values [unit].
        device_name: what the device must call itself; anything when empty.
        stream: number of the stream.
        format: of the values, for the arithmetic of the line; the device must send it.
        history: snapshots kept for readers.
        shape: of a tactile finger: shows its strains and the shape that touches it, too.
    """

    line: LineSettings
    channels: int
    rate_hz: int = 200
    scale: float | list[float] = 1.0
    offset: float | list[float] = 0.0
    unit: str = ""
    names: list[str] = []
    minimum: float | None = None
    maximum: float | None = None
    device_name: str = ""
    stream: int = 1
    format: str = "i16"
    history: int = 256
    shape: tactile_nodes.ShapeSettings | None = None


class FramedAdc(tactile_nodes.FingerDriver, StreamDriver):
    """A front end that pushes blocks of samples.

    Concurrency: the one thread of the driver process.
    """

    Settings = FramedAdcSettings
    heartbeat_s = stream.HEARTBEAT_S

    @classmethod
    def describe(cls, name: str, settings: FramedAdcSettings) -> Description:
        """Tell the channels; raises ValueError for what neither frame nor line could carry."""
        _check(settings)
        names = settings.names or [f"c{i}" for i in range(settings.channels)]
        channels = tuple(ChannelInfo(each, settings.unit, settings.minimum, settings.maximum) for each in names)
        block = BlockSpec("", NodeClass.ANALOG, channels, history=settings.history)
        more = tactile_nodes.specs(settings.shape, settings.channels, settings.history)
        return Description(
            (block, *more),
            settings.rate_hz,
            tactile_nodes.inputs(settings.shape),
            max(0.5, 10 / settings.rate_hz),
        )

    @classmethod
    def golden(cls, settings: Any) -> Sequence[Golden]:
        """Return the frames of the protocol's description."""
        block = stream.SampleBlock(1, 7, 123456, 0, (100, -200, 0, 32767))
        about = stream.Hello(1, 4, stream.Format.I16, 1000, "TAC4")

        def first(data: bytes) -> stream.SampleBlock:
            payloads = FrameReceiver().feed(data)
            if not payloads:
                raise Incomplete("no good frame")
            return stream.parse_samples(payloads[0]) or block

        return (
            Golden(
                "samples",
                reply="04 01 01 07 04 40 e2 01 02 04 02 64 03 38 ff 01 05 ff 7f f5 76 00",
                value=block,
                read=first,
            ),
            Golden(
                "hello",
                stream.hello(),
                "04 10 c1 f3 00",
                "04 11 01 04 03 e8 03 01 07 54 41 43 34 de c8 00",
                about,
            ),
            Golden("start", stream.start(1, 1000), "05 12 01 e8 03 01 03 fc 6d 00", "03 1f 12 03 df c6 00"),
            Golden("stop", stream.stop(1), "05 13 01 0e 5b 00"),
        )

    def __init__(self, name: str, settings: FramedAdcSettings, kit: Kit) -> None:
        super().__init__(name, settings, kit)
        self.line = settings.line
        self.silence_s = max(0.25, 20 / settings.rate_hz)
        self._make_blocks(self.describe(name, settings).blocks, settings.shape)
        self._scale = np.broadcast_to(np.array(settings.scale, dtype=np.float64), settings.channels)
        self._offset = np.broadcast_to(np.array(settings.offset, dtype=np.float64), settings.channels)
        self._receiver = FrameReceiver()
        self._clock = DeviceClock(name, kit, 1e6, stream.CLOCK_MODULUS_US)
        self._sequence = SequenceWatch(stream.SEQUENCE_MODULUS, settings.rate_hz)
        self._t_us: int | None = None
        self._blocks_since = 0
        self._since_us: int | None = None
        self._granted_hz = 0.0
        self._foreign = 0

    def open(self) -> Steps:
        """Ask the device what it is, compare, and start the stream."""
        settings = self.settings
        about: stream.Hello = yield stream.hello()
        if about.version != stream.PROTOCOL_VERSION:
            raise self._not_this(f"speaks version {about.version} of the protocol; want 1")
        if about.channels != settings.channels:
            raise self._not_this(f"has {about.channels} channels; the configuration says {settings.channels}")
        if about.format.name.lower() != settings.format:
            raise self._not_this(f"sends {about.format.name.lower()}; the configuration says {settings.format}")
        if settings.device_name and about.name != settings.device_name:
            raise self._not_this(f"calls itself {about.name!r}; the configuration says {settings.device_name!r}")
        if settings.rate_hz > about.max_rate_hz:
            raise self._not_this(f"sends at most {about.max_rate_hz} Hz; rate_hz = {settings.rate_hz}")
        self._sequence.expect_anew()
        self._t_us, self._since_us, self._granted_hz, self.trouble = None, None, 0.0, ""
        yield stream.start(settings.stream, settings.rate_hz)

    def feed(self, data: bytes, now_ns: int) -> int:
        """Publish a snapshot for every good block."""
        good = 0
        for payload in self._receiver.feed(data):
            block = stream.parse_samples(payload)
            if block is None:
                # acknowledgements and answers to the heartbeat come between the blocks
                self._foreign += payload[0] not in (stream.Message.HELLO_REPLY, stream.Message.ACKNOWLEDGE)
                continue
            if block.stream != self.settings.stream or len(block.values) != self._block.n:
                self._foreign += 1
                continue
            good += self._take(block, now_ns)
        return good

    def heartbeat(self) -> Steps:
        """Say hello; the answer is not waited for, so that it never stands in the way of samples."""
        yield Send(frame(bytes((stream.Message.HELLO,))), "hello")

    def counters(self) -> Mapping[str, int | str]:
        """Return what the receiver saw."""
        seen = self._receiver.counters
        return {
            "frames": seen.frames,
            "bad_crc": seen.bad_crc,
            "malformed": seen.malformed + seen.oversized,
            "lost_blocks": self._sequence.lost,
            "old_blocks": self._sequence.late + self._sequence.doubled,
            "foreign_frames": self._foreign,
            **self._clock.counters(),
        }

    def close(self) -> Steps:
        """Stop the stream."""
        yield Send(frame(bytes((stream.Message.STOP, self.settings.stream))), "stop")

    def _take(self, block: stream.SampleBlock, now_ns: int) -> bool:
        """Publish a block; return whether it was a new one."""
        self._check_clock(block.t_us)
        lost = self._sequence.accept(block.sequence, now_ns)
        if lost is None:
            self._t_us = block.t_us if self._t_us is None else self._t_us
            self.trouble = f"blocks come, but their number stands still at {block.sequence}: the device is frozen"
            return False
        last_us, self._t_us = self._t_us, block.t_us
        if block.t_us == last_us:
            self.trouble = f"blocks come, but the device's clock stands still at {last_us} us"
            return False
        self._check_rate(lost + 1, block.t_us)
        self.trouble = ""
        flags = int(AnalogStatus.OVERRUN) if lost else 0
        if block.flags & stream.SampleFlag.SATURATED:
            flags |= int(AnalogStatus.SATURATED)
        if block.flags & stream.SampleFlag.OVERRUN:
            flags |= int(AnalogStatus.OVERRUN)
        if block.flags & stream.SampleFlag.REFERENCE_FAULT:
            flags |= int(AnalogStatus.INVALID)
        data = self._block.data
        np.subtract(block.values, self._offset, out=data)
        np.multiply(data, self._scale, out=data)
        self._block.flags[:] = flags | np.where(np.isfinite(data), 0, int(AnalogStatus.INVALID))
        self._block.stamp_ns = self._clock.to_host(block.t_us, now_ns)
        self.kit.publish(self._block, self._block.stamp_ns)
        if self._finger is not None:
            for derived in self._finger.take(data, self._block.flags, self._block.stamp_ns, now_ns, now_ns):
                self.kit.publish(derived, derived.stamp_ns)
        return True

    def _check_clock(self, t_us: int) -> None:
        """Raise LinkError when the device's clock was set back, by more than a block can be late."""
        behind_us = 0 if self._t_us is None else (self._t_us - t_us) % stream.CLOCK_MODULUS_US
        if LATE_US < behind_us < stream.CLOCK_MODULUS_US // 2:
            raise LinkError(
                f"{self.name}: the device's clock went from {self._t_us} back to {t_us} us: it has restarted"
            )

    def _check_rate(self, blocks: int, t_us: int) -> None:
        """Compare the rate with the one that was granted when the stream began; raises LinkError when it is another."""
        if self._since_us is None:
            self._blocks_since, self._since_us = 0, t_us
            return
        self._blocks_since += blocks
        passed_s = (t_us - self._since_us) % stream.CLOCK_MODULUS_US * 1e-6
        if self._blocks_since < RATE_BLOCKS or passed_s < RATE_S:
            return
        hz = self._blocks_since / passed_s
        self._blocks_since, self._since_us = 0, t_us
        wanted_hz = self._granted_hz or self.settings.rate_hz
        if abs(hz / wanted_hz - 1) <= RATE_TOLERANCE:
            self._granted_hz = wanted_hz
        elif self._granted_hz:
            text = (
                f"{self.name}: {hz:.1f} blocks a second after {wanted_hz:g}: another host has started the stream anew"
            )
            raise LinkError(text)
        else:
            self._granted_hz = hz
            self.kit.log(
                "warning",
                f"{self.name}: the device sends {hz:.1f} blocks a second, not rate_hz = {wanted_hz:g}",
            )

    def _not_this(self, what: str) -> DeviceError:
        return DeviceError(errno.ENODEV, f"identify {self.name} on {self.line}: the device {what}")


def _check(settings: FramedAdcSettings) -> None:
    """Raise ValueError for settings that contradict each other, the frame or the line."""
    if settings.format not in _BYTES:
        raise ValueError(f"format = {settings.format}; want one of {', '.join(_BYTES)}")
    size = _BYTES[settings.format]
    most = (252 - 10) // size
    if not 1 <= settings.channels <= most:
        raise ValueError(f"channels = {settings.channels}; want 1 to {most} of format {settings.format}")
    if not 0 <= settings.stream <= 255:
        raise ValueError(f"stream = {settings.stream}; want 0 to 255")
    if settings.names and len(settings.names) != settings.channels:
        raise ValueError(f"names: {len(settings.names)} for {settings.channels} channels; want one each")
    for key in ("scale", "offset"):
        value = getattr(settings, key)
        numbers = value if isinstance(value, list) else [value]
        if isinstance(value, list) and len(value) != settings.channels:
            raise ValueError(f"{key}: {len(value)} for {settings.channels} channels; want one number, or one each")
        if not all(map(math.isfinite, numbers)) or (key == "scale" and 0 in numbers):
            raise ValueError(f"{key} = {value}; want finite numbers{', not 0' if key == 'scale' else ''}")
    if settings.rate_hz < 1:
        raise ValueError(f"rate_hz = {settings.rate_hz}; want 1 or more")
    if settings.line.serial is not None:
        _check_line(settings, _FIXED_BYTES + settings.channels * size)


def _check_line(settings: FramedAdcSettings, frame_bytes: int) -> None:
    line = settings.line
    top_hz = LINE_SHARE * line.baud / line.bits_per_character / frame_bytes
    if settings.rate_hz > top_hz:
        raise ValueError(
            f"rate_hz = {settings.rate_hz}: {frame_bytes} bytes a block at {line.baud} baud carry {top_hz:.0f} Hz; "
            "want a lower rate or a faster line (a USB CDC port has no baud rate: give 12000000)"
        )
