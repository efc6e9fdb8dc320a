"""Stops of drives that move, brake or coast already, by the driver that moved them and by one that comes after its
death.
"""

from __future__ import annotations

from typing import Any

import pytest
from drive_rig import LIMITS, Joined

from sioms.drivers.dynamixel import simulator as dynamixel
from sioms.drivers.dynamixel.driver import Dynamixel
from sioms.drivers.grbl import simulator as grbl
from sioms.drivers.grbl.driver import Grbl
from sioms.drivers.odrive import simulator as odrive
from sioms.drivers.odrive.driver import Odrive
from sioms.drivers.tmcl import simulator as tmcl
from sioms.drivers.tmcl.driver import Tmcl
from sioms.motion import ActionKind, DriveAction
from sioms.sdk.exchange import DeviceError

ACTION = DriveAction(ActionKind.START, 0, None, 0.1, 1.0)


class Watch:
    """Notes where something goes, and that it never turns back."""

    def __init__(self, place: Any) -> None:
        self._place = place
        self.farthest = place()
        self.back = 0.0

    def __call__(self) -> None:
        here = self._place()
        self.farthest = max(self.farthest, here)
        self.back = max(self.back, self.farthest - here)


# --- Dynamixel ------------------------------------------------------------------------------------


def servo(mode: str = "extended_position", **keys: Any) -> Joined:
    axis = {"name": "x", "id": 1, "mode": mode, "travel_per_turn": 0.05, **LIMITS, "velocity_max": 0.07}
    return Joined(Dynamixel, {"axis": [axis], **keys}, lambda clock: dynamixel.Bus([1], clock=clock))


def moving_servo(**keys: Any) -> tuple[Joined, Any]:
    rig = servo(**keys)
    rig.do(rig.unit.open())
    rig.do(rig.unit.start_position(0, 0.045, 0.06, ACTION))
    rig.wait(0.25)
    one = rig.device.servos[1]
    assert one.mover.velocity > 4000  # 0.06 m/s are 4915 steps/s
    return rig, one


@pytest.mark.parametrize("mode", ["extended_position", "position"])
@pytest.mark.parametrize("new_process", [False, True])
def test_a_held_servo_brakes_and_does_not_come_back(mode: str, new_process: bool) -> None:
    rig, one = moving_servo(mode=mode, quick_stop="hold")
    watch = Watch(lambda: one.mover.position)
    if new_process:
        rig.begin()
    rig.do(rig.unit.open() if new_process else rig.unit.halt(0, fastest=True), watch)
    rig.wait(0.5, watch)
    assert not one.mover.busy and one.table[64] == 1
    assert watch.back <= 4


def test_a_second_stop_while_it_brakes_changes_little() -> None:
    rig, one = moving_servo(quick_stop="hold")
    watch = Watch(lambda: one.mover.position)
    rig.do(rig.unit.halt(0, fastest=False), watch)
    goal = one.get(116, 4, signed=True)
    rig.wait(0.02, watch)
    rig.do(rig.unit.halt(0, fastest=True), watch)
    rig.wait(0.5, watch)
    assert not one.mover.busy and watch.back <= 4
    assert abs(one.mover.position - goal) < 60  # of some 150


def test_a_stop_near_the_end_of_the_turn_is_one_that_the_servo_takes() -> None:
    rig = servo("position", quick_stop="hold")
    rig.do(rig.unit.open())
    rig.do(rig.unit.start_position(0, 4095 / 4096 * 0.05, 0.06, ACTION))
    one = rig.device.servos[1]
    while one.mover.position < 4020:
        rig.wait(0.001)
    one.mover.velocity = 4900.0  # it will pass the end of its turn while it brakes
    rig.do(rig.unit.halt(0, fastest=True))
    assert one.get(116, 4, signed=True) == 4095


def test_a_servo_that_coasts_is_not_turned_back_when_it_is_switched_on() -> None:
    rig, one = moving_servo(quick_stop="torque_off")
    rig.do(rig.unit.halt(0, fastest=True))
    assert one.table[64] == 0 and one.mover.velocity > 3000
    watch = Watch(lambda: one.mover.position)
    rig.do(rig.unit.open(), watch)
    rig.wait(0.5, watch)
    assert one.table[64] == 1 and not one.mover.busy and watch.back <= 4


# --- TMCL -----------------------------------------------------------------------------------------


def test_a_search_of_a_driver_that_died_is_ended() -> None:
    axis = {"name": "x", "motor": 0, "travel_per_turn": 0.01, "microsteps_per_turn": 51200, "homing": True}
    rig = Joined(Tmcl, {"axis": [{**axis, **LIMITS}]}, lambda clock: tmcl.Module(clock=clock))
    rig.do(rig.unit.open())
    rig.do(rig.unit.home(0))
    rig.wait(0.2)
    assert rig.device.motors[0].searching
    rig.begin()
    rig.sent.clear()
    rig.do(rig.unit.open())
    rig.wait(1.0)
    assert not rig.device.motors[0].searching and not rig.device.motors[0].mover.busy
    requests = [data[1:4] for data in rig.sent]  # command, type, motor
    assert requests.index(b"\x0d\x01\x00") < requests.index(b"\x03\x00\x00"), "search ended, then stop"


def test_a_motor_that_does_not_obey_keeps_no_other_from_being_stopped() -> None:
    axes = [{"name": name, "motor": motor, "travel_per_turn": 0.01, **LIMITS} for name, motor in (("x", 5), ("y", 0))]
    rig = Joined(Tmcl, {"axis": axes, "heartbeat_s": 0.0}, lambda clock: tmcl.Module(clock=clock))
    rig.device.take(bytes((1, 1, 0, 0, 0, 0, 0x40, 0, 0x42)))  # rotate motor 0 at 0x4000
    rig.wait(0.5)
    assert rig.device.motors[0].mover.velocity > 10_000
    with pytest.raises(DeviceError, match="motor 5"):
        rig.do(rig.unit.open())  # the module has one motor
    rig.wait(1.0)
    assert rig.device.motors[0].mover.velocity == 0


def running(kind: str) -> tuple[Joined, Any]:
    """Return a drive of a kind that runs at a velocity, and what tells how fast it goes [its own unit/s]."""
    x = {"name": "x", "travel_per_turn": 0.01, **LIMITS}
    rig: Joined
    if kind == "tmcl":
        rig = Joined(Tmcl, {"axis": [{**x, "motor": 0}]}, lambda clock: tmcl.Module(clock=clock))
        speed = lambda: rig.device.motors[0].mover.velocity  # noqa: E731
    elif kind == "odrive":
        table = {"axis": [{**x, "number": 0}], "watchdog_s": 0.0, "quick_stop": "hold"}
        rig = Joined(Odrive, table, lambda clock: odrive.Board(clock=clock))
        speed = lambda: rig.device.axes[0].velocity  # noqa: E731
    else:
        rig = servo("velocity", quick_stop="hold")
        speed = lambda: rig.device.servos[1].mover.velocity  # noqa: E731
    rig.do(rig.unit.open())
    rig.do(rig.unit.start_velocity(0, 0.06, DriveAction(ActionKind.START, 0, None, 0.1, 1.0)))
    rig.wait(0.3)
    return rig, speed


@pytest.mark.parametrize("fastest", [False, True])
@pytest.mark.parametrize("kind", ["tmcl", "odrive", "dynamixel"])
def test_a_slow_ramp_of_a_command_does_not_prolong_a_stop(kind: str, fastest: bool) -> None:
    rig, speed = running(kind)
    before = abs(speed())
    rig.do(rig.unit.start_velocity(0, 0.05, DriveAction(ActionKind.START, 0, None, 0.1, 0.02)))
    assert abs(speed()) > 0.9 * before
    rig.do(rig.unit.halt(0, fastest=fastest))
    rig.wait(0.06 + 0.06)  # 0.06 m/s at 1 m/s^2; with that of the command it would take 3 s
    assert abs(speed()) < 0.02 * before


# --- ODrive ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("switched_on_by", ["reset", "new process"])
def test_a_motor_that_coasts_is_not_turned_back_when_its_loop_is_closed(switched_on_by: str) -> None:
    axis = {"name": "x", "number": 0, "travel_per_turn": 0.01, **LIMITS}
    rig = Joined(Odrive, {"axis": [axis], "watchdog_s": 0.0}, lambda clock: odrive.Board(clock=clock))
    rig.do(rig.unit.open())
    motor = rig.device.axes[0]
    rig.do(rig.unit.start_position(0, 0.5, 0.1, ACTION))  # leaves the board in position mode
    rig.wait(0.4)
    assert motor.velocity > 5
    rig.do(rig.unit.halt(0, fastest=True))
    assert motor.p["current_state"] == odrive.IDLE and motor.velocity > 5
    watch = Watch(lambda: motor.position)
    if switched_on_by == "reset":
        rig.do(rig.unit.reset(0), watch)
    else:
        rig.begin()
        rig.do(rig.unit.open(), watch)
    rig.wait(0.5, watch)
    assert motor.p["current_state"] == odrive.CLOSED_LOOP and abs(motor.velocity) < 0.01
    assert watch.back < 2e-3, "turns"


def test_a_watchdog_that_runs_out_while_the_board_is_opened_leaves_no_idle_axis() -> None:
    axis = {"name": "x", "number": 0, "travel_per_turn": 0.01, **LIMITS}
    rig = Joined(Odrive, {"axis": [axis]}, lambda clock: odrive.Board(clock=clock))
    for left_s in (0.001, 0.006, 0.012, 0.018, 0.024):
        rig.begin()
        rig.do(rig.unit.open())
        rig.wait(rig.device.axes[0].left_s - left_s)
        rig.begin()
        rig.do(rig.unit.open())
        assert rig.device.axes[0].p["current_state"] == odrive.CLOSED_LOOP, left_s
        assert rig.device.axes[0].p["error"] == 0


# --- Grbl -----------------------------------------------------------------------------------------


def test_a_controller_that_brakes_long_is_opened_when_it_rests() -> None:
    axis = {"name": "x", "letter": "X", "velocity_max": 0.1, "acceleration_max": 0.1}
    rig = Joined(Grbl, {"axis": [axis]}, lambda clock: grbl.Controller(1, homing=False, clock=clock))
    rig.device.settings[120] = 100.0  # mm/s^2: 100 mm/s take a second
    rig.do(rig.unit.open())
    rig.device.take(b"$J=G91G21X500F6000\n")
    rig.wait(1.2)
    assert rig.device.planner.speed > 90
    rig.begin()
    rig.do(rig.unit.open())  # not refused with error 8
    assert rig.device.state == "Idle" and rig.device.planner.speed == 0
