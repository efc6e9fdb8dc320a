"""Ends of motion: a drive told at rest stands, and the place told is where it stands, whatever has ended its motion.

Each family is polled against its simulated device on an invented clock, on a slow line; the truth is the device's own.
"""

from __future__ import annotations

import random
from collections.abc import Callable
from typing import Any

import drive_rig
import msgspec
import pytest
from drive_rig import LIMITS, Joined
from modbus_rig import LIMITS as MODBUS_LIMITS
from modbus_rig import Rig, az_rig, leadshine_rig

from sioms.drivers.dynamixel import simulator as dynamixel
from sioms.drivers.dynamixel.driver import Dynamixel
from sioms.drivers.grbl import simulator as grbl
from sioms.drivers.grbl.driver import Grbl
from sioms.drivers.modbus.simulated import leadshine
from sioms.drivers.odrive import simulator as odrive
from sioms.drivers.odrive.driver import Odrive
from sioms.drivers.tmcl import simulator as tmcl
from sioms.drivers.tmcl.driver import Tmcl
from sioms.protocol.flags import AxisStatus, ControlMode

X = {"name": "x", "travel_per_turn": 0.01, **LIMITS}
SLOW_LINE_BAUD = 19200


class Drive:
    """A family's driver and simulated device.

    Args:
        poll: polls once and carries out what the bank wants; the time between two polls is its argument [s].
        bank: of the driver.
        now_ns: the time.
        truth: returns where the device is and how fast, in the units of the axis.
        count: the driver tells places in steps of this [m].
        crawl: highest speed of one that is told at rest [m/s].
        near: puts what a homing looks for near, and away again with False; None for a family that does not home.
    """

    def __init__(
        self,
        poll: Callable[[float], None],
        bank: Any,
        now_ns: Callable[[], int],
        truth: Callable[[], tuple[float, float]],
        count: float,
        crawl: float,
        near: Callable[[bool], None] | None = None,
    ) -> None:
        self.poll, self.bank, self.now_ns, self.truth = poll, bank, now_ns, truth
        self.count, self.crawl, self.near = count, crawl, near


def joined(driver: Any, table: dict[str, Any], make: Any, truth: Any, *numbers: Any) -> Drive:
    rig = Joined(driver, table, make)
    rig.do(rig.unit.open())
    *numbers, near = numbers
    found = Drive(
        lambda pause_s: rig.poll(1, pause_s), rig.unit.bank, rig.unit.clock, lambda: truth(rig.device), *numbers,
        (lambda comes: near(rig.device, comes)) if near else None,
    )  # fmt: skip
    found.rig = rig  # type: ignore[attr-defined]
    return found


def tmcl_drive() -> Drive:
    axis = {**X, "motor": 0, "microsteps_per_turn": 51200, "homing": True}
    step = 0.01 / 51200

    def near(device: Any, comes: bool) -> None:
        device.handlers()["reference"](*([] if comes else ["off"]))

    def truth(device: Any) -> tuple[float, float]:
        return device.motors[0].count * step, device.motors[0].mover.velocity * step

    return joined(Tmcl, {"axis": [axis]}, lambda clock: tmcl.Module(clock=clock), truth, step, 5e-6, near)


def odrive_drive() -> Drive:
    axis = {**X, "number": 0, "homing": True, "force_max": 400.0, "acceleration_max": 0.5}

    def truth(device: Any) -> tuple[float, float]:
        return device.axes[0].position * 0.01, device.axes[0].velocity * 0.01

    def near(device: Any, comes: bool) -> None:
        device.handlers()["reference"](*([] if comes else ["off"]))

    return joined(
        Odrive, {"axis": [axis]}, lambda clock: odrive.Board(clock=clock), truth, 1e-5, 2e-4, near
    )  # its standstill is 0.02 turns/s


def dynamixel_drive() -> Drive:
    axis = {**X, "id": 1, "mode": "extended_position", "travel_per_turn": 0.05, "velocity_max": 0.07}
    step = 0.05 / 4096

    def truth(device: Any) -> tuple[float, float]:
        mover = device.servos[1].mover
        return mover.position * step, mover.velocity * step

    keys = {"axis": [axis], "quick_stop": "hold"}
    return joined(Dynamixel, keys, lambda clock: dynamixel.Bus([1], clock=clock), truth, step, 2e-4, None)


def grbl_drive() -> Drive:
    axis = {"name": "x", "letter": "X", **LIMITS, "acceleration_max": 0.5}

    def truth(device: Any) -> tuple[float, float]:
        return device.planner.position[0] * 1e-3, device.planner.speed * 1e-3

    keys = {"axis": [axis], "quick_stop": "cancel"}
    return joined(Grbl, keys, lambda clock: grbl.Controller(homing=False, clock=clock), truth, 2e-6, 1e-3, None)


class StatusBehind(leadshine.Drive):
    """A drive whose status lies behind its position, far enough for a message of its own, and that tells no speed."""

    AT = 0x1100

    def read(self, function: int, address: int, count: int) -> Any:
        return super().read(function, 0x1003 if address == self.AT else address, count)


def status_behind_rig() -> Rig:
    over = {"signals": {"status": {"address": StatusBehind.AT}}}
    table = MODBUS_LIMITS | {"travel_per_turn": 0.01, "homing": True, "velocity_by": "path", "override": over}
    rig = Rig("leadshine", StatusBehind, table)
    rig.unit._axis = msgspec.structs.replace(rig.unit._axis, velocity=None)
    return rig


def modbus_drive(make: Callable[..., Any], step: float) -> Drive:
    rig = make()

    def poll(pause_s: float) -> None:
        rig.bus.now_s += pause_s
        rig.poll()

    def near(comes: bool) -> None:
        rig.drive.mover.origin = 4000.0 if comes else rig.drive.mover.origin  # where the machine has its zero

    def truth() -> tuple[float, float]:
        state = rig.drive.state()
        return state["feedback"] * step, state["velocity"] * step

    return Drive(poll, rig.bank, rig.bus.clock_ns, truth, step, 1e-5, near)


DRIVES: dict[str, Callable[[], Drive]] = {
    "tmcl": tmcl_drive, "odrive": odrive_drive, "dynamixel": dynamixel_drive, "grbl": grbl_drive,
    "status behind": lambda: modbus_drive(status_behind_rig, 1e-6),
    "leadshine": lambda: modbus_drive(leadshine_rig, 1e-6), "oriental_az": lambda: modbus_drive(az_rig, 1e-5),
}  # fmt: skip


def write(drive: Drive, **fields: Any) -> None:
    record = drive_rig.np.zeros(1, drive_rig.numpy_dtype(drive_rig.NodeClass.AXIS))
    for name, value in fields.items():
        record[name] = value
    drive.bank.append(record, [0], drive.now_ns(), replace=True)


def check(drive: Drive, when: str) -> None:
    """Where the axis is told at rest, hold it against the device as it is now."""
    rows = drive.bank.rows
    assert abs(rows["velocity"][0]) <= 1.5 * LIMITS["velocity_max"], f"{when}: {rows['velocity'][0]:g} m/s was told"
    if rows["in_motion"][0] or rows["buffered"][0]:
        return
    place, speed = drive.truth()
    told = float(rows["position"][0]) - float(drive.bank._offset[0])
    assert abs(speed) <= drive.crawl, f"{when}: told at rest, it moves at {speed:g} m/s"
    assert abs(told - place) <= 1.01 * drive.count, f"{when}: told at {told:g}, it is at {place:g} m"


def run(drive: Drive, seconds: float, when: str, chance: random.Random) -> None:
    """Poll for a time, at least until the axis is told at rest."""
    end_ns = drive.now_ns() + int(seconds * 1e9)
    latest_ns = end_ns + 30_000_000_000
    while drive.now_ns() < end_ns or (drive.bank.rows["in_motion"][0] and not when.startswith("during")):
        drive.poll(chance.uniform(0.004, 0.02))
        check(drive, when)
        assert drive.now_ns() < latest_ns, f"{when}: never at rest"


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("family", DRIVES)
def test_what_is_told_at_rest_stands_where_it_is_told(family: str, seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(drive_rig, "CHARACTER_S", 10 / (SLOW_LINE_BAUD if family == "tmcl" else 115200))
    chance, drive = random.Random(seed), DRIVES[family]()
    run(drive, 0.2, "opened", chance)
    told = []
    for _ in range(12):
        what = chance.choice(["move", "turn", "stop", "run", "over", "emergency stop", "home", "calibrate"])
        told.append(what)
        begin(drive, what, chance)
        run(drive, 0.1, f"after {', '.join(told)}", chance)
        if drive.bank.is_latched(0):
            assert not drive.bank.is_in_fault(0), drive.bank.fault_text(0)
            drive.bank.reset([0])


def begin(drive: Drive, what: str, chance: random.Random) -> None:
    way = -1.0 if drive.bank.rows["position"][0] > 0 else 1.0
    speed = way * chance.uniform(0.01, 0.06)
    if what == "home":
        if drive.near is not None:
            drive.near(True)
            drive.bank.home([0], drive.now_ns())
            run(drive, 0.1, "after a homing", chance)
            drive.near(False)
        return
    if what == "calibrate":
        drive.bank.calibrate([0], [chance.uniform(-0.01, 0.01)])
        return
    if what in ("move", "turn"):
        write(drive, control_mode=int(ControlMode.POSITION), position=way * chance.uniform(1e-5, 0.02))
        if what == "turn":
            run(drive, chance.uniform(0.0, 0.2), "during a move", chance)
            write(drive, control_mode=int(ControlMode.POSITION), position=-way * chance.uniform(1e-5, 0.02))
        return
    runs = drive.bank.settings[0].modes & ControlMode.VELOCITY
    if runs:
        write(drive, control_mode=int(ControlMode.VELOCITY), velocity=speed)
    else:
        write(drive, control_mode=int(ControlMode.POSITION), position=way * 0.1)
    run(drive, chance.uniform(0.0, 0.3), "during a run", chance)
    if what == "emergency stop":
        drive.bank.emergency_stop([0], drive.now_ns())
    elif what == "over":
        write(drive, control_mode=int(ControlMode.POSITION), position=-way * chance.uniform(1e-5, 0.02))
    elif what == "stop" or not runs:
        drive.bank.stop([0], drive.now_ns())
    else:
        write(drive, control_mode=int(ControlMode.VELOCITY), velocity=0.0)
        run(drive, 0.3, "during a run to 0", chance)
        drive.bank.stop([0], drive.now_ns())


def test_a_homing_ends_homed() -> None:
    for family, make in DRIVES.items():
        drive, chance = make(), random.Random(1)
        if drive.near is None:
            continue
        run(drive, 0.2, family, chance)
        begin(drive, "home", chance)
        run(drive, 0.1, family, chance)
        assert drive.bank.rows["status"][0] & AxisStatus.HOMED, family
