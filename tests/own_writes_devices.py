"""Rig: a simulated device on a line, and the drivers that serve it, for the worlds of own_writes_rig."""

from __future__ import annotations

import os
import random
import time
from collections.abc import Sequence
from typing import Any

import msgspec
import numpy as np
from own_writes_rig import CLOCK, DEVICE

from sioms.motion import AxisSettings, DriveAction
from sioms.protocol.flags import ControlMode, NodeClass, Request
from sioms.protocol.nodeinfo import ChannelInfo
from sioms.sdk.blocks import AnalogBlock, AnyBlock, BinaryBlock, BlockSpec, Description
from sioms.sdk.drive_axes import AxesUnit
from sioms.sdk.driver import Kit, LineDriver, LineUnit, StreamDriver
from sioms.sdk.exchange import Exchange, Steps
from sioms.sdk.settings import LineSettings


class Device:
    """What is at the other end of the line, and the connection to it: it works off a request when its turn comes.

    It holds an axis that moves slowly, four outputs, a sensor with a tare of its own.
    """

    def __init__(self, chance: random.Random, *, pushes: bool = False) -> None:
        self.fd = os.eventfd(0)
        self.settings = LineSettings(tcp="nowhere:1")
        self.outputs = 0
        self.tare = 0
        self.position, self.velocity = 0.0, 0.0
        self.faulty = False
        self._chance = chance
        self._asked: list[bytes] = []
        self._heard = b""
        self._pushes = pushes
        self._count = 0
        DEVICE.append(self)

    @property
    def owes(self) -> bool:
        """Whether a request has not been answered."""
        return bool(self._asked or self._heard)

    def is_connected(self) -> bool:
        return True

    def write(self, data: bytes) -> None:
        self._asked.append(bytes(data))

    def read(self) -> bytes:
        data, self._heard = self._heard, b""
        return data

    def close(self) -> None:
        fd, self.fd = self.fd, -1
        if fd >= 0:
            os.close(fd)

    def work(self) -> bool:
        """Do one thing; return whether there is something to read."""
        self.position += self.velocity * 1e-3
        if self._pushes and self._chance.random() < 0.6:
            self._count += 1
            self._heard += b"S%d,%d,%d\n" % (CLOCK.now_ns, self._count, self.tare)  # the sample is on its way
            return self._chance.random() < 0.5
        if self._asked:
            self._heard += self._answer(self._asked.pop(0)) + b"\n"
        return bool(self._heard)

    def _answer(self, request: bytes) -> bytes:
        word, _, number = request.strip().partition(b" ")
        match word:
            case b"out":
                self.outputs = int(number)
            case b"tare":
                self.tare = int(number)
            case b"run":
                self.velocity = float(number)
            case b"halt":
                self.velocity = 0.0
            case b"get":
                return b"%d,%d,%.6f,%.6f" % (self.outputs, self.tare, self.position, self.velocity)
        return b"ok"


def ask(text: str) -> Exchange:
    """Return the exchange of one line each way; samples in between are not for it."""

    def want(got: bytes) -> int | None:
        end = 0
        for line in got.splitlines(keepends=True):
            end += len(line)
            if line.endswith(b"\n") and not line.startswith(b"S"):
                return end
        return None

    def decode(reply: bytes) -> str:
        return reply.splitlines()[-1].decode()

    return Exchange(text.encode() + b"\n", want, decode, 1e3, False, text)


def tare(number: Any) -> Steps:
    """Give the device a tare."""
    yield ask(f"tare {int(number)}")


class LineTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Settings of the drivers below."""

    pieces: int = 2


_AXIS = AxisSettings(
    "x", velocity_max=1.0, acceleration_max=10.0, force_max=1.0,
    modes=ControlMode.VELOCITY | ControlMode.POSITION | ControlMode.WAIT_FOR_EXTERNAL_SYNCH
    | ControlMode.SPECIFIED_WAIT_MARKER,
)  # fmt: skip
_AXIS_SPEC = BlockSpec("", NodeClass.AXIS, (ChannelInfo("x", "m"),), capacity=64)
_OUT_SPEC = BlockSpec("out", NodeClass.BINARY, (ChannelInfo("out", width=4),), True)
_TARE_SPEC = BlockSpec("tare", NodeClass.ANALOG, (ChannelInfo("tare", "N"),))


class _AxisUnit(AxesUnit):
    def open(self) -> Steps:
        yield ask("halt")

    def poll(self) -> Steps:
        text: str = yield ask("get")
        yield ask("nothing")  # a poll of several exchanges: what it read first is from before
        _, _, position, velocity = (float(n) for n in text.split(","))
        moving = np.array([velocity != 0.0])
        self.report(np.array([position]), np.array([velocity]), moving, ~moving, [""])

    def start_position(self, axis: int, position: float, speed: float, action: DriveAction) -> Steps:
        yield ask(f"run {speed}")

    def start_velocity(self, axis: int, velocity: float, action: DriveAction) -> Steps:
        yield ask(f"run {velocity}")

    def halt(self, axis: int, *, fastest: bool) -> Steps:
        yield ask("halt")


class _OutUnit(LineUnit):
    """Outputs and a number in the device, read back by the poll."""

    name = "unit"

    def __init__(self) -> None:
        self.out, self.tare = BinaryBlock(_OUT_SPEC), AnalogBlock(_TARE_SPEC)

    @property
    def blocks(self) -> Sequence[AnyBlock]:
        return (self.out, self.tare)

    def open(self) -> Steps:
        yield ask("nothing")

    def poll(self) -> Steps:
        text: str = yield ask("get")
        yield ask("nothing")
        outputs, tare, _, _ = text.split(",")
        self.out.set(0, int(outputs), time.monotonic_ns())
        self.tare.data[0] = float(tare)

    def write_outputs(self, block: BlockSpec, channels: Sequence[int], values: Sequence[float]) -> Steps:
        yield ask(f"out {int(values[-1])}")


class OnLine(LineDriver):
    """A drive and an output block on one line."""

    Settings = LineTable

    def __init__(self, name: str, settings: LineTable, kit: Kit) -> None:
        super().__init__(name, settings, kit)
        self.line = LineSettings(tcp="nowhere:1")
        self._units = [_AxisUnit("drive", [_AXIS], _AXIS_SPEC, kit), _OutUnit()]

    @classmethod
    def describe(cls, name: str, settings: LineTable) -> Description:
        return Description((_AXIS_SPEC, _OUT_SPEC, _TARE_SPEC), 50.0, lease_s=1e6)

    @property
    def units(self) -> Sequence[LineUnit]:
        return self._units

    def ioctl(self, block: BlockSpec, request: Request, channels: Sequence[int], argument: Any) -> Any:
        if request is not Request.CALIBRATE_DEVICE:
            return super().ioctl(block, request, channels, argument)

        return tare(argument)


class Pushing(StreamDriver):
    """A sensor that pushes samples and can be told a tare."""

    Settings = LineTable
    silence_s = 1e6

    def __init__(self, name: str, settings: LineTable, kit: Kit) -> None:
        super().__init__(name, settings, kit)
        self.line = LineSettings(tcp="nowhere:1")
        self._block = AnalogBlock(_TARE_SPEC)
        self._rest = b""

    @classmethod
    def describe(cls, name: str, settings: LineTable) -> Description:
        return Description((_TARE_SPEC,), 100.0, lease_s=1e6)

    @property
    def blocks(self) -> Sequence[AnyBlock]:
        return (self._block,)

    def open(self) -> Steps:
        yield from ()

    def ioctl(self, block: BlockSpec, request: Request, channels: Sequence[int], argument: Any) -> Any:
        if request is not Request.CALIBRATE_DEVICE:
            return super().ioctl(block, request, channels, argument)
        return tare(argument)

    def feed(self, data: bytes, now_ns: int) -> int:
        *lines, self._rest = (self._rest + data).split(b"\n")
        for line in lines:
            stamp_ns, _, tare = line[1:].split(b",")
            self._block.data[0] = float(tare)
            self.kit.publish(self._block, int(stamp_ns))
        return len(lines)
