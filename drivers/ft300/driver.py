"""Robotiq FT 300, FT 300-S and FT 150 force/torque sensors on their serial line: the stream at 100 Hz, or Modbus RTU.

[device.force0]
driver = "ft300"
line = { serial = "/dev/ttyUSB0", baud = 19200 }
mode = "stream"            # or "modbus", at poll_hz
"""

from __future__ import annotations

import errno
import time
from collections.abc import Mapping, Sequence
from typing import Any, Literal

import msgspec
import numpy as np

from sioms.protocol.flags import AnalogStatus, NodeClass
from sioms.protocol.nodeinfo import ChannelInfo
from sioms.sdk.blocks import AnalogBlock, AnyBlock, BlockSpec, Description
from sioms.sdk.codec.modbus import RtuUnit, SerialLine
from sioms.sdk.driver import Driver, Kit, LineDriver, LineUnit, StreamDriver
from sioms.sdk.exchange import DeviceError, LinkError, Pause, Send, Steps
from sioms.sdk.force_torque import ForceBlock, Six, force_spec
from sioms.sdk.golden import Golden, Incomplete
from sioms.sdk.settings import LineSettings

from . import codec as ft300

STOP_PIECE = 50
"""Bytes of 0xFF sent at a time: 26 ms of line time."""
SILENCE_S = 0.16
"""Without a good record for this long the stream is dead, as the vendor's own software judges."""
TURNAROUND_S = 0.05
LINE = SerialLine(ft300.BAUD)
PERIOD_NS = int(1e9 / ft300.RATE_HZ)
RECORD_NS = int(LINE.duration_s(ft300.RECORD_BYTES) * 1e9)
"""Time that a record is on the line: its sample is at least so much older than its last byte."""
AXES = ("ax", "ay", "az")


class Ft300Settings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Keys of the device.

    Attributes:
        line: the sensor's serial port, or a serial server's TCP port.
        mode: "stream": 100 records a second; "modbus": forces, and accelerations if wanted, at ``poll_hz``.
        poll_hz: rate of polls [Hz].
        acceleration: show the sensor's accelerations as a node ``acceleration``; polls alone have them.
        address: Modbus address.
        serial_number: the sensor must have it; 0 takes any.
        full_scale: greatest forces [N] and torques [N m]; those of the FT 300 without.
        history: snapshots kept for readers.
    """

    line: LineSettings
    mode: Literal["stream", "modbus"] = "stream"
    poll_hz: float = 40.0
    acceleration: bool = False
    address: int = ft300.SLAVE
    serial_number: int = 0
    full_scale: Six = (300.0, 300.0, 300.0, 30.0, 30.0, 30.0)
    history: int = 128


class Ft300(StreamDriver):
    """The sensor as it pushes records.

    Concurrency: the one thread of the driver process.
    """

    Settings = Ft300Settings
    silence_s = SILENCE_S
    gap_s = LINE.frame_gap_s
    advice = "check the wiring; the sensor speaks 19200 baud, 8N1"

    @classmethod
    def variant(cls, settings: Ft300Settings) -> type[Driver]:
        """Return the class of the mode."""
        return Ft300Registers if settings.mode == "modbus" else cls

    @classmethod
    def describe(cls, name: str, settings: Ft300Settings) -> Description:
        """Tell the channels; raises ValueError for a line or a rate that the sensor has not."""
        _check(settings)
        rate_hz = ft300.RATE_HZ if settings.mode == "stream" else settings.poll_hz
        return Description(_specs(settings), rate_hz, lease_s=max(0.5, 5 / rate_hz))

    @classmethod
    def golden(cls, settings: Any) -> Sequence[Golden]:
        """Return frames of the instruction manual."""
        unit = RtuUnit(ft300.SLAVE, LINE, TURNAROUND_S)

        def first(data: bytes) -> tuple[int, ...]:
            found = ft300.RecordReceiver().feed(data)
            if not found:
                raise Incomplete("no good record")
            return found[0][0]

        return (
            Golden(
                "read the forces",
                unit.read_holding(ft300.FORCES_AT, 6),
                "09 03 00 b4 00 06 84 a6",
                "09 03 0c fe d8 fb 2e 16 2e 00 64 ff 38 01 2c 9d fc",
                (0xFED8, 0xFB2E, 0x162E, 0x0064, 0xFF38, 0x012C),
            ),
            Golden(
                "start the stream",
                unit.write_registers(ft300.STREAM_AT, [ft300.START_STREAM]),
                "09 10 01 9a 00 01 02 02 00 cd ca",
                "09 10 01 9a 00 01 21 52",
            ),
            Golden(
                "record",
                reply="20 4e d8 fe 2e fb 2e 16 64 00 38 ff 2c 01 7d af",
                value=(-296, -1234, 5678, 100, -200, 300),
                read=first,
            ),
        )

    def __init__(self, name: str, settings: Ft300Settings, kit: Kit) -> None:
        super().__init__(name, settings, kit)
        self.line = settings.line
        self._sensor = Sensor(name, settings, kit)
        self._block = _force_block(name, settings, kit)
        self._receiver = ft300.RecordReceiver()
        self._still = ft300.Standstill()
        self._stamp_ns = 0

    @property
    def blocks(self) -> Sequence[AnyBlock]:
        """The six components."""
        return (self._block,)

    def open(self) -> Steps:
        """End a stream that may still run, identify the sensor, and start the stream."""
        yield from self._sensor.identify()
        self._receiver.restart()
        yield self._sensor.unit.write_registers(ft300.STREAM_AT, [ft300.START_STREAM])

    def feed(self, data: bytes, now_ns: int) -> int:
        """Publish every good record; those that came together were measured one period apart."""
        found, good = self._receiver.feed(data), 0
        for behind, (counts, after_loss) in zip(range(len(found) - 1, -1, -1), found, strict=True):
            if not self._still.is_fresh(counts):
                self.trouble = self._still.text
                continue
            good, self.trouble = good + 1, ""
            stamp_ns = max(now_ns - RECORD_NS - behind * PERIOD_NS, self._stamp_ns + 1)
            self._stamp_ns = stamp_ns
            self._block.show(counts, stamp_ns, int(AnalogStatus.OVERRUN) if after_loss else 0)
        return good

    def counters(self) -> Mapping[str, int | str]:
        """Return what the receiver saw."""
        seen = self._receiver.counters
        return {
            "records": seen.records, "bad_crc": seen.bad_crc, "skipped_bytes": seen.skipped_bytes, "lost": seen.lost,
            "saturated": self._block.saturated, "equal": self._still.equal,
        }  # fmt: skip

    def close(self) -> Steps:
        """End the stream."""
        yield from self._sensor.end_stream()


class Ft300Registers(LineDriver):
    """The sensor as it is asked.

    Concurrency: the one thread of the driver process.
    """

    Settings = Ft300Settings
    describe = Ft300.describe
    gap_s = LINE.frame_gap_s
    recovery_s = 0.1

    def __init__(self, name: str, settings: Ft300Settings, kit: Kit) -> None:
        super().__init__(name, settings, kit)
        self.line = settings.line
        self._units = (RegisterUnit(name, settings, kit),)

    @property
    def units(self) -> Sequence[LineUnit]:
        """The sensor."""
        return self._units

    def counters(self) -> Mapping[str, int | str]:
        """Return how often the sensor was overloaded; the rest stands in the link's counters."""
        return {"saturated": self._units[0].force.saturated}


class RegisterUnit(LineUnit):
    """Polls the forces, and the accelerations in the same message."""

    def __init__(self, name: str, settings: Ft300Settings, kit: Kit) -> None:
        self.name = name
        self._sensor = Sensor(name, settings, kit)
        self.force = _force_block(name, settings, kit)
        self._still = ft300.Standstill()
        specs = _specs(settings)
        self._acceleration = AnalogBlock(specs[1]) if settings.acceleration else None

    @property
    def blocks(self) -> Sequence[AnyBlock]:
        """The forces, and the accelerations if wanted."""
        return (self.force,) if self._acceleration is None else (self.force, self._acceleration)

    def open(self) -> Steps:
        """End a stream that may still run, and identify the sensor."""
        yield from self._sensor.identify()

    def poll(self) -> Steps:
        """Read the registers once; the stamp is the time of the reply."""
        last = ft300.FORCES_AT + 6 if self._acceleration is None else ft300.ACCELERATION_AT + 3
        words = yield self._sensor.unit.read_holding(ft300.FORCES_AT, last - ft300.FORCES_AT)
        counts = [word - 0x10000 if word & 0x8000 else word for word in words]
        if not self._still.is_fresh(tuple(counts[:6])):
            raise LinkError(f"poll {self.name}: {self._still.text}")
        now_ns = time.monotonic_ns()
        self.force.fill(counts[:6], now_ns)
        if self._acceleration is not None:
            self._acceleration.data[:] = np.multiply(counts[-3:], ft300.ACCELERATION_MS2)
            self._acceleration.stamp_ns = now_ns


class Sensor:
    """What both modes do first and last: end the stream, tell whether this is the sensor."""

    def __init__(self, name: str, settings: Ft300Settings, kit: Kit) -> None:
        self.unit = RtuUnit(settings.address, LINE, TURNAROUND_S)
        self._settings, self._kit = settings, kit
        self._what = f"identify {name} at address {settings.address} on {settings.line}"
        self._known = ""

    def end_stream(self) -> Steps:
        """Send 0xFF for as long as the manual says; the time passes on the line, or beside it where that has no baud
        rate.
        """
        piece_s = LINE.duration_s(STOP_PIECE)
        for _ in range(int(ft300.STOP_S / piece_s) + 1):
            yield Send(ft300.STOP_BYTE * STOP_PIECE, "end the stream")
            if self._settings.line.serial is None:
                yield Pause(piece_s)

    def identify(self) -> Steps:
        """Read firmware and serial number; raises DeviceError when they are no FT sensor's, or another's."""
        yield from self.end_stream()
        yield Pause(ft300.QUIET_S)
        try:
            firmware = yield self.unit.read_holding(ft300.FIRMWARE_AT, 3)
            about = yield self.unit.read_holding(ft300.SERIAL_AT, 5)
        except LinkError as error:
            text = f"{self._what}: {error}; check port, power and address, and that the line has 19200 baud, 8N1"
            raise LinkError(text) from None
        except DeviceError as error:
            raise DeviceError(errno.ENODEV, f"{self._what}: no FT 300 answers there: {error}") from None
        version = b"".join(word.to_bytes(2, "big") for word in firmware).rstrip(b"\0 ")
        serial, year = about[3] << 16 | about[2], about[4]
        if not (version and version.isascii() and version.decode().isprintable()):
            shown = " ".join(f"{word:04x}" for word in firmware)
            text = (
                f"registers {ft300.FIRMWARE_AT} to {ft300.FIRMWARE_AT + 2} read {shown}, which is not a firmware "
                "version of an FT 300"
            )
            raise DeviceError(errno.ENODEV, f"{self._what}: {text}")
        wanted = self._settings.serial_number
        if wanted and serial != wanted:
            text = f"the sensor has serial number {serial}; the configuration says {wanted}"
            raise DeviceError(errno.ENODEV, f"{self._what}: {text}")
        found = f"firmware {version.decode()}, serial number {serial} of {year}"
        if found != self._known:
            self._known = found
            self._kit.log("info", f"{self._what}: {found}")


def _specs(settings: Ft300Settings) -> tuple[BlockSpec, ...]:
    force = force_spec(settings.full_scale, settings.history, "Robotiq FT 300")
    if not settings.acceleration:
        return (force,)
    channels = tuple(ChannelInfo(axis, "m/s^2", description="Robotiq FT 300") for axis in AXES)
    return force, BlockSpec("acceleration", NodeClass.ANALOG, channels, history=settings.history)


def _force_block(name: str, settings: Ft300Settings, kit: Kit) -> ForceBlock:
    block = ForceBlock(_specs(settings)[0], name, kit)
    block.set_scale(ft300.FORCE_N, ft300.TORQUE_NM)
    return block


def _check(settings: Ft300Settings) -> None:
    line = settings.line
    if line.udp is not None:
        raise ValueError("line.udp: the sensor is on a serial line; want line.serial, or line.tcp of a serial server")
    if line.serial is not None and (line.baud, line.parity, line.stop_bits) != (ft300.BAUD, "N", 1):
        found = f"{line.baud} baud, 8{line.parity}{line.stop_bits}"
        raise ValueError(f"line: {found}; the sensor speaks 19200 baud, 8N1: want baud = 19200")
    if not 1 <= settings.address <= 247:
        raise ValueError(f"address = {settings.address}; want 1 to 247 ({ft300.SLAVE} from the factory)")
    if settings.mode == "stream":
        if settings.acceleration:
            raise ValueError('acceleration: the stream has none; want mode = "modbus" or acceleration = false')
        return
    registers = ft300.ACCELERATION_AT + 3 - ft300.FORCES_AT if settings.acceleration else 6
    top_hz = 1 / (LINE.duration_s(8 + 5 + 2 * registers) + 2 * LINE.frame_gap_s)
    if not 0.1 <= settings.poll_hz <= top_hz:
        text = f"{registers} registers a poll at {ft300.BAUD} baud carry at most {top_hz:.0f} Hz"
        raise ValueError(f"poll_hz = {settings.poll_hz:g}: {text}; want 0.1 to {top_hz:.0f}")
