"""Rig of Modbus drives: the driver of one drive against its simulated device's register model, on an invented clock."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import msgspec
import numpy as np
import pytest
from steps_rig import Exchanging

from sioms.drivers.modbus.axis import ModbusAxis
from sioms.drivers.modbus.simulated import leadshine, oriental_az
from sioms.motion import DriveAction
from sioms.protocol.flags import AxisStatus, ControlMode
from sioms.protocol.markers import TABLE_SIZE, MarkerTable
from sioms.protocol.records import NodeClass, numpy_dtype
from sioms.sdk.codec.modbus import frame_rtu
from sioms.sdk.exchange import DeviceError, Exchange, LinkError
from sioms.sdk.markers import Markers

EXCHANGE_S = 0.003


class Kit:
    """What a line driver needs of the kit."""

    def __init__(self) -> None:
        self.markers = Markers(MarkerTable(memoryview(bytearray(TABLE_SIZE))), lambda number: None)
        self.said: list[str] = []

    def log(self, level: str, text: str) -> None:
        """Take what the driver says."""
        self.said.append(text)


class Bus(Exchanging):
    """A line whose drives are register models; each exchange takes 3 ms of the invented time."""

    def __init__(self) -> None:
        super().__init__(EXCHANGE_S)
        self.drives: dict[int, Any] = {}
        self.sent: list[bytes] = []
        self.broken: Callable[[Exchange], bytes | None] = lambda exchange: None

    def clock_ns(self) -> int:
        return round(self.now_s * 1e9)

    def answer(self, request: bytes) -> bytes:
        drive, function, address = self.drives[request[0]], request[1], int.from_bytes(request[2:4], "big")
        if function == 3:
            words = drive.read(3, address, int.from_bytes(request[4:6], "big"))
            if not isinstance(words, list):
                return frame_rtu(request[0], bytes((0x83, int(words))))
            return frame_rtu(request[0], bytes((3, 2 * len(words))) + np.array(words, ">u2").tobytes())
        values = [int.from_bytes(request[4:6], "big")]
        if function == 16:
            values = np.frombuffer(request[7:-2], ">u2").tolist()
        refused = drive.write(function, address, values)
        if refused:
            return frame_rtu(request[0], bytes((function | 0x80, int(refused))))
        return request if function == 6 else frame_rtu(request[0], request[1:6])

    def reply(self, exchange: Exchange) -> bytes:
        """Return what comes from the line."""
        self.sent.append(exchange.data)
        return self.broken(exchange) or self.answer(exchange.data)


class Rig:
    """A driver of one drive, polled at 50 Hz as the kit does."""

    def __init__(self, family: str, model: Any, table: dict[str, Any]) -> None:
        self.bus = Bus()
        self.drive = model(lambda: self.bus.now_s)
        self.bus.drives[1] = self.drive
        device = {"map": family, "line": {"serial": "/dev/null"}, "axis": [{"name": "x", **table}]}
        kit = Kit()
        self.said = kit.said
        self.driver = ModbusAxis("mod0", msgspec.convert(device, ModbusAxis.Settings), kit)  # type: ignore[arg-type]
        self.unit: Any = self.driver.units[0]
        self.unit._clock = self.bus.clock_ns
        self.bank = self.unit.bank
        self.bus.run(self.unit.open())
        self.poll()

    def poll(self) -> None:
        self.bus.run(self.unit.poll())
        for action in self.bank.take_actions():
            self.act(action)

    def act(self, action: DriveAction) -> None:
        now_ns = self.bus.clock_ns()
        try:
            self.bus.run(self.unit.act(action))
        except (DeviceError, LinkError) as error:
            self.bank.action_failed(action, str(error), now_ns)
        else:
            self.bank.action_done(action, self.bus.clock_ns())

    def go(self, duration_s: float) -> None:
        end_s = self.bus.now_s + duration_s
        while self.bus.now_s < end_s:
            start_s = self.bus.now_s
            self.poll()
            self.bus.now_s = max(self.bus.now_s, start_s + 0.02)

    def until_idle(self, limit_s: float = 30.0) -> float:
        """Poll until the axis is idle; returns how long that took."""
        start_s = self.bus.now_s
        while not self.bank.is_idle([0]):
            self.go(0.02)
            assert self.bus.now_s < start_s + limit_s, "never idle"
        return self.bus.now_s - start_s

    def write(self, mode: ControlMode, **fields: float) -> None:
        records = np.zeros(1, numpy_dtype(NodeClass.AXIS))
        records["control_mode"] = int(mode)
        for name, value in fields.items():
            records[name] = value
        self.bank.append(records, [0], self.bus.clock_ns())

    @property
    def position(self) -> float:
        return float(self.bank.rows["position"][0])

    @property
    def status(self) -> AxisStatus:
        return AxisStatus(int(self.bank.rows["status"][0]))


LIMITS = {"position_min": -0.5, "position_max": 0.5, "velocity_max": 0.1, "acceleration_max": 1.0}


def leadshine_rig(**more: Any) -> Rig:
    return Rig("leadshine", leadshine.Drive, LIMITS | {"travel_per_turn": 0.01, "homing": True} | more)


def az_rig(**more: Any) -> Rig:
    table = LIMITS | {"travel_per_turn": 0.01, "pulses_per_turn": 1000.0, "homing": True}
    return Rig("oriental_az", lambda clock: oriental_az.Drive(clock, 0.2), table | more)


RIGS = pytest.mark.parametrize("make", [leadshine_rig, az_rig])
