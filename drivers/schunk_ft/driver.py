"""SCHUNK FTS force/torque sensors with the Ethernet interface box (IFB-EN): commands on TCP, 1000 records/s on UDP.

[device.force0]
driver = "schunk-ft"
line = { tcp = "192.168.0.100:82" }
full_scale = [400, 400, 1000, 15, 15, 15]
"""

from __future__ import annotations

import errno
from collections.abc import Mapping, Sequence
from typing import Any

from sioms.protocol.flags import AnalogStatus, Request
from sioms.sdk.blocks import AnyBlock, BlockSpec, Description
from sioms.sdk.codec.sequence import SequenceRestart, SequenceWatch
from sioms.sdk.datagram import split_address
from sioms.sdk.device_clock import DeviceClock
from sioms.sdk.driver import Kit, Refusal, StreamDriver
from sioms.sdk.exchange import DeviceError, Exchange, LinkError, SideExchange, Steps
from sioms.sdk.force_torque import ForceBlock, ForceSettings, check_whole, force_spec
from sioms.sdk.golden import Golden, Incomplete
from sioms.sdk.settings import LineSettings

from . import codec as ifb
from .codec import Command, Status

SILENCE_S = 3 / ifb.RATE_HZ + 0.1
_BAD = Status.INVALID | Status.HARDWARE
_OVERLOAD = Status.MECHANICAL_RANGE | Status.USER_RANGE
SAME_RUN_NS = 10_000_000_000
"""After a longer absence nothing tells whether the sensor kept its power."""
SAME_RUN_RECORDS = 100
"""So far may its counter be from where time has brought it, and 2 % of that time."""


class SchunkFtSettings(ForceSettings, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Keys of the device, beside those of ForceSettings.

    Attributes:
        line: the box's TCP port, ``host:82``.
        data: where the records come: ``address:port`` of this host. The firmware knows port 54843 alone.
        product: what the sensor must call itself; anything without.
        tool: tool setting 0 to 3 to select; left alone without.
        noise_filter: 0 to 4, means of 1, 2, 4, 8, 16 samples; left alone without.
    """

    data: str = f"0.0.0.0:{ifb.DATA_PORT}"
    product: str = ""
    tool: int | None = None
    noise_filter: int | None = None


class SchunkFt(StreamDriver):
    """One sensor.

    Concurrency: the one thread of the driver process.
    """

    Settings = SchunkFtSettings
    silence_s = SILENCE_S

    @classmethod
    def describe(cls, name: str, settings: SchunkFtSettings) -> Description:
        """Tell the channels; raises ValueError for what the box could not do."""
        _check(settings)
        spec = force_spec(settings.full_scale, settings.history, "SCHUNK FTS force/torque sensor")
        return Description((spec,), ifb.RATE_HZ, lease_s=0.5)

    @classmethod
    def golden(cls, settings: Any) -> Sequence[Golden]:
        """Return frames of the vendor's repository."""
        sent = (
            "ff ff 40 11 1d 00 40 01 00 00 00 55 50 02 3f f2 04 e6 be 01 98 7e bf 04 1b 20 bf 7c 2a a3 3e ad 43 78 3f"
        )
        values = (0.50904, -0.44926, -0.99451, -0.62541, 0.31868, 0.96978)

        def read(data: bytes) -> tuple[int, int, int, tuple[float, ...]]:
            record = ifb.parse(data[: ifb.RECORD_BYTES])
            if record is None:
                raise Incomplete("no record")
            return (
                record.counter,
                record.packet,
                record.status,
                tuple(round(value, 5) for value in record.values),
            )

        return (
            Golden(
                "read the product's name", ifb.get(ifb.PRODUCT), "ff ff 00 00 04 00 f0 01 00 00",
                "ff ff 01 00 08 00 f0 00 01 00 00 4b 4d 53", b"KMS",
            ),
            Golden(
                "tare", ifb.act(Command.TARE), "ff ff 00 00 01 00 12", "ff ff 03 00 02 00 12 00",
            ),
            Golden(
                "start", ifb.act(Command.START), "ff ff 00 00 01 00 40", "ff ff 07 00 02 00 40 00",
            ),
            Golden("record", reply=sent, value=(4416, 64, 1, values), read=read),
        )  # fmt: skip

    def __init__(self, name: str, settings: SchunkFtSettings, kit: Kit) -> None:
        super().__init__(name, settings, kit)
        self.side_line = settings.line
        host = (settings.line.tcp or "").rpartition(":")[0]
        self.line = LineSettings(udp=f"{host}:0", local=settings.data)
        self.advice = f"look whether a firewall keeps UDP from {host} to {settings.data} away"
        self._block = ForceBlock(self.describe(name, settings).blocks[0], name, kit)
        self._sequence = SequenceWatch(ifb.SEQUENCE_MODULUS, ifb.RATE_HZ)
        self._clock = DeviceClock(name, kit, ifb.RATE_HZ, ifb.SEQUENCE_MODULUS)
        self._status: int | None = None
        self._records = self._malformed = 0
        self._newest: tuple[int, int] | None = None
        self._known = ""

    @property
    def blocks(self) -> Sequence[AnyBlock]:
        """The six components."""
        return (self._block,)

    def open(self) -> Steps:
        """Stop a stream that may still run, identify the sensor, set it up, and start the stream."""
        settings = self.settings
        try:
            yield from self._tolerated(ifb.act(Command.STOP), anew=True)
            yield from self._identify()
            if settings.tool is not None:
                yield SideExchange(ifb.act(Command.TOOL, settings.tool))
            if settings.noise_filter is not None:
                yield SideExchange(ifb.act(Command.NOISE_FILTER, settings.noise_filter))
            self._sequence.expect_anew(goes_on=True)
            self._clock.expect_anew()
            self.trouble = ""
            yield SideExchange(ifb.act(Command.START))
        except LinkError as error:
            raise LinkError(f"open {self.name}: {error}") from None
        except DeviceError as error:
            raise DeviceError(error.errno, f"open {self.name} at {settings.line}: {error}") from None

    def feed(self, data: bytes, now_ns: int) -> int:
        """Publish the record of a datagram, if it is fresh."""
        record = ifb.parse(data)
        if record is None:
            self._malformed += 1
            return 0
        is_first = self._sequence.last is None
        try:
            lost = self._sequence.accept(record.counter, now_ns)
        except SequenceRestart:
            self._doubt_zero("the sensor restarted")
            raise
        if lost is None:
            if is_first and self._sequence.last is not None:
                self._compare(record.counter, now_ns)
            else:
                self.trouble = f"records come, but their number stands still at {record.counter}: the sensor is frozen"
            return 0
        self._newest, self.trouble = (record.counter, now_ns), ""
        flags = int(AnalogStatus.OVERRUN) if lost else 0
        if record.status != self._status or record.status != Status.READY:
            flags |= self._judge(record.status, now_ns)
        self._block.show(record.values, self._clock.to_host(record.counter, now_ns), flags)
        self._records += 1
        return 1

    def ioctl(self, block: BlockSpec, request: Request, channels: Sequence[int], argument: Any) -> Any:
        """Let the sensor tare itself on CALIBRATE_DEVICE; with the argument 0 it takes its tare back."""
        if request is not Request.CALIBRATE_DEVICE:
            return super().ioctl(block, request, channels, argument)
        check_whole(block, channels)
        number = argument[0] if isinstance(argument, list) and len(argument) == 1 else argument
        if number not in (None, 0):
            raise Refusal(errno.EINVAL, f"{argument!r}; want nothing for a tare, or 0 to take it back")
        return self._tare(Command.TARE if number is None else Command.RESET_TARE)

    def counters(self) -> Mapping[str, int | str]:
        """Return what came, and the status of the last record."""
        seen, block = self._sequence, self._block
        return {
            "records": self._records, "malformed": self._malformed, "lost": seen.lost, "late": seen.late,
            "doubled": seen.doubled, "sequence_restarts": seen.restarts, "saturated": block.saturated,
            "invalid": block.invalid, "status": block.status, **self._clock.counters(),
        }  # fmt: skip

    def close(self) -> Steps:
        """Stop the stream."""
        yield from self._tolerated(ifb.act(Command.STOP))

    # --- inside ----------------------------------------------------------------------------------

    def _tolerated(self, exchange: Exchange, *, anew: bool = False) -> Steps:
        """Do what the sensor may refuse: a stop when nothing streams."""
        try:
            yield SideExchange(exchange, anew)
        except DeviceError:
            return

    def _tare(self, command: Command) -> Steps:
        yield SideExchange(ifb.act(command))
        if command is Command.TARE:
            self._block.take_zero()
        else:
            self._block.forget_zero()

    def _compare(self, counter: int, now_ns: int) -> None:
        """Tell from the first number after an opening whether the sensor has been at it all the time."""
        if self._newest is None:
            return
        last, last_ns = self._newest
        away_ns = now_ns - last_ns
        expected = last + round(away_ns * 1e-9 * ifb.RATE_HZ)
        half = ifb.SEQUENCE_MODULUS // 2
        off = (counter - expected + half) % ifb.SEQUENCE_MODULUS - half
        if away_ns > SAME_RUN_NS or abs(off) > SAME_RUN_RECORDS + 0.02 * away_ns * 1e-9 * ifb.RATE_HZ:
            self._doubt_zero(f"the sensor was away for {away_ns * 1e-9:.1f} s and has counted anew, as after a restart")

    def _doubt_zero(self, why: str) -> None:
        if self._block.is_zeroed:
            self._block.lose_zero(f"its tare may be gone: {why}")

    def _identify(self) -> Steps:
        product: str = (yield SideExchange(ifb.get(ifb.PRODUCT))).rstrip(b"\0").decode("ascii", "replace")
        unit: bytes = yield SideExchange(ifb.get(ifb.UNIT))
        firmware: str = (yield SideExchange(ifb.get(ifb.FIRMWARE))).rstrip(b"\0").decode("ascii", "replace")
        if self.settings.product and product != self.settings.product:
            raise _not_this(f"calls itself {product!r}; the configuration says {self.settings.product!r}")
        known = f"{product}, firmware {firmware}"
        if unit == product.encode("ascii", "replace"):
            known += (
                "; it answers every parameter with its name, as the vendor's simulator does, so units are taken for N "
                "and N*m"
            )
        elif unit.strip(b"\0"):
            number = int.from_bytes(unit, "little")
            raise _not_this(f"has unit selection {number}; want 0 (N and N*m): set it on the sensor's page")
        if known != self._known:
            self._known = known
            self.kit.log("info", f"identified {self.name} at {self.settings.line}: {known}")

    def _judge(self, status: int, now_ns: int) -> int:
        """Return the flags of a status, and tell of its change."""
        if status != self._status:
            self._status = status
            self._block.say(ifb.status_text(status), now_ns)
        good = status & Status.READY and not status & _BAD
        flags = 0 if good else int(AnalogStatus.INVALID)
        return flags | (int(AnalogStatus.SATURATED) if status & _OVERLOAD else 0)


def _not_this(what: str) -> DeviceError:
    return DeviceError(errno.ENODEV, f"the sensor {what}")


def _check(settings: SchunkFtSettings) -> None:
    if settings.line.tcp is None:
        raise ValueError('line: the box takes commands on TCP; want line = { tcp = "host:82" }')
    try:
        if split_address(settings.data)[1] == 0:
            raise ValueError(settings.data)
        LineSettings(udp="localhost:0", local=settings.data)
    except ValueError:
        raise ValueError(f'data = "{settings.data}"; want "0.0.0.0:{ifb.DATA_PORT}"') from None
    for key, most in (("tool", 3), ("noise_filter", 4)):
        value = getattr(settings, key)
        if value is not None and not 0 <= value <= most:
            raise ValueError(f"{key} = {value}; want 0 to {most}")
