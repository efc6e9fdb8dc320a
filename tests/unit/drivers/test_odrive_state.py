"""ODrive: what the board keeps when one would rather that it did not, and a driver that reckons with it."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from drive_rig import LIMITS, Joined

from sioms.drivers.odrive import simulator as odrive
from sioms.drivers.odrive.driver import Odrive
from sioms.drivers.odrive.simulated.axis import HOMING
from sioms.drivers.odrive.simulator import CLOSED_LOOP, IDLE
from sioms.motion import ActionKind, DriveAction
from sioms.protocol.flags import AxisStatus
from sioms.sdk.exchange import DeviceError, LinkError, StateLost

ACTION = DriveAction(ActionKind.START, 0, None, 0.1, 0.5)
TURN = 0.01
"""Travel of a turn [m]."""


def board(**keys: Any) -> Joined:
    axis = {"name": "x", "number": 0, "travel_per_turn": TURN, "force_max": 400.0, **LIMITS}
    return Joined(Odrive, {"axis": [axis], **keys}, lambda clock: odrive.Board(clock=clock))


def opened(**keys: Any) -> tuple[Joined, odrive.Axis]:
    rig = board(**keys)
    rig.do(rig.unit.open())
    poll(rig, 3)
    return rig, rig.device.axes[0]


def poll(rig: Joined, times: int) -> None:
    for _ in range(times):
        rig.do(rig.unit.poll())
        rig.wait(0.005)


def run(rig: Joined, seconds: float, look: Any = lambda: None) -> None:
    """Let time pass, polled 50 times a second."""
    until_s = rig.now_s + seconds
    while rig.now_s < until_s:
        rig.do(rig.unit.poll(), look)
        rig.wait(0.01, look)


def poll_until(rig: Joined, what: str, times: int = 40) -> None:
    """Poll until the driver says that the state of the board is lost."""
    with pytest.raises(StateLost, match=what):
        poll(rig, times)


class Farthest:
    """Notes the highest speed and the farthest places of a rotor."""

    def __init__(self, axis: odrive.Axis) -> None:
        self._axis = axis
        self.speed, self.low, self.high = 0.0, axis.place, axis.place

    def __call__(self) -> None:
        axis = self._axis
        self.speed = max(self.speed, abs(axis.velocity))
        self.low, self.high = min(self.low, axis.place), max(self.high, axis.place)


def rest(rig: Joined, axis: odrive.Axis) -> None:
    while abs(axis.velocity) > 1e-3:
        rig.wait(0.1)


# --- what the board does ----------------------------------------------------------------------------


def test_the_board_keeps_its_inputs_over_idle_and_obeys_them_when_its_loop_is_closed() -> None:
    rig = board()
    device, axis = rig.device, rig.device.axes[0]
    assert device.take(b"w axis0.controller.config.input_mode 1\nv 0 5\nw axis0.requested_state 8\n") == []
    rig.wait(0.3)
    assert axis.velocity == pytest.approx(5.0, abs=0.1)
    device.take(b"w axis0.requested_state 1\n")
    rig.wait(0.01)
    assert axis.p["current_state"] == IDLE and axis.p["controller.input_vel"] == 5
    rest(rig, axis)
    device.take(b"w axis0.requested_state 8\n")
    rig.wait(0.3)
    assert axis.velocity == pytest.approx(5.0, abs=0.1)


def test_the_board_plans_from_its_set_point_and_only_the_setter_of_the_mode_moves_it() -> None:
    rig = board()
    device, axis = rig.device, rig.device.axes[0]
    device.take(b"w axis0.requested_state 8\nw axis0.controller.config.vel_ramp_rate 100\n")
    device.take(b"w axis0.controller.config.input_mode 2\nv 0 5\n")
    rig.wait(2.0)
    device.take(b"v 0 0\n")
    rig.wait(1.0)
    place = axis.position
    assert place > 8 and axis.p["controller.pos_setpoint"] == 0
    watch = Farthest(axis)
    device.take(b"t 0 %f\n" % (place + 1))
    rig.wait(5.0, watch)
    assert watch.low < 1.0, "it runs back to where the velocity run began"
    device.take(b"v 0 0\n")
    rig.wait(1.0)
    device.take(b"w axis0.controller.config.control_mode 3\n")
    assert axis.p["controller.pos_setpoint"] == axis.p["controller.input_pos"] == axis.position


def test_a_restart_leaves_the_watchdog_off_and_counts_from_where_the_rotor_is() -> None:
    rig, axis = opened()
    rig.do(rig.unit.start_position(0, 0.02, 0.1, ACTION))
    run(rig, 1.0)
    assert axis.p["config.enable_watchdog"] == 1 and axis.position == pytest.approx(2.0, abs=0.01)
    rig.device.power_cycle("0.05")
    assert rig.device.take(b"r vbus_voltage\n") == []
    rig.wait(0.06)
    assert axis.p["config.enable_watchdog"] == 0 and axis.p["config.watchdog_timeout"] == 0
    assert axis.position == pytest.approx(0.0, abs=0.05) and axis.p["current_state"] == IDLE
    assert rig.device.take(b"r system_stats.uptime\n")[0] in {b"%d\r\n" % ms for ms in range(20)}


def test_an_overspeed_and_a_watchdog_are_errors_of_an_idle_axis_too() -> None:
    rig = board()
    axis = rig.device.axes[0]
    rig.device.take(b"w axis0.requested_state 8\n")  # before, the controller's inputs are not connected
    rig.wait(0.01)
    rig.device.take(b"w axis0.requested_state 1\n")
    rig.wait(0.01)
    axis.shoved = 25.0  # 1.2 times 20 turns/s
    rig.wait(0.01)
    assert axis.p["error"] == 1 << 9 and axis.p["controller.error"] == 1
    axis.shoved = axis.velocity = 0.0
    rig.device.take(b"sc\nw axis0.config.watchdog_timeout 0.1\nw axis0.config.enable_watchdog 1\n")
    rig.wait(0.01)
    assert axis.p["error"] == 1 << 11, "the new time-out counts from the next feeding on"


# --- what the driver does ---------------------------------------------------------------------------


@pytest.mark.parametrize("command", ["velocity", "torque", "position"])
@pytest.mark.parametrize("closed_by", ["new process", "reset", "replugging", "command"])
def test_nothing_that_was_left_in_the_board_moves_it(command: str, closed_by: str) -> None:
    rig, axis = opened()
    if command == "velocity":
        rig.do(rig.unit.start_velocity(0, 0.05, ACTION))
    elif command == "torque":
        rig.do(rig.unit.start_force(0, 300.0, ACTION))
    else:
        rig.do(rig.unit.start_position(0, 5.0, 0.05, ACTION))
    rig.wait(0.3)
    assert axis.velocity > 0.5
    rig.wait(0.5)  # the cable is out: the watchdog lets go
    assert axis.p["error"] == 1 << 11 and axis.p["current_state"] == IDLE
    rest(rig, axis)
    watch = Farthest(axis)
    match closed_by:
        case "new process":
            rig.begin()
            rig.do(rig.unit.open(), watch)
        case "reset":
            rig.do(rig.unit.reset(0), watch)
        case "replugging":
            rig.do(rig.unit.open(), watch)
        case _:
            rig.device.take(b"u 0\nsc\n")
            rig.unit._may_hold[0] = False
            rig.do(rig.unit.start_velocity(0, 0.0, ACTION), watch)
    for _ in range(50):
        rig.do(rig.unit.poll(), watch)
    assert axis.p["current_state"] == CLOSED_LOOP
    assert watch.speed < 0.05 and watch.high - watch.low < 1e-3


@pytest.mark.parametrize("latch", ["stop", "fault"])
def test_nothing_is_switched_on_while_a_stop_is_latched(latch: str) -> None:
    rig = board()
    bank, axis = rig.unit.bank, rig.device.axes[0]
    if latch == "stop":
        bank.emergency_stop(np.array([0]), 0)
    else:
        bank.fault([0], "the link was lost", 0)
    states: set[float] = set()
    look = lambda: states.add(axis.p["current_state"])  # noqa: E731
    rig.do(rig.unit.open(), look)
    rig.do(rig.unit.poll(), look)
    if latch == "stop":
        rig.do(rig.unit.reset(0), look)  # a reset that a stop has overtaken
    assert states == {IDLE} and axis.p["config.enable_watchdog"] == 1
    bank.reset(np.array([0]))
    rig.do(rig.unit.start_velocity(0, 0.0, ACTION))
    assert axis.p["current_state"] == CLOSED_LOOP


@pytest.mark.parametrize("steps_before", range(1, 12))
def test_a_stop_that_overtakes_the_closing_of_the_loop_leaves_it_open(steps_before: int) -> None:
    rig = board()
    rig.do(rig.unit.open())
    rig.do(rig.unit.halt(0, fastest=True))
    axis = rig.device.axes[0]
    stop = DriveAction(ActionKind.QUICK_STOP, 0, None, 0.1, 1.0)
    closing, count = rig.unit.reset(0), 0

    def some(steps: Any = closing, limit: int = steps_before) -> Any:
        nonlocal count
        value: Any = None
        while True:
            try:
                step = steps.send(value)
            except StopIteration:
                return
            value = yield step
            count += 1
            if count == limit:
                rig.unit.bank.emergency_stop(np.array([0]), 0)
                rig.do(rig.unit.act(stop))

    rig.do(some())
    rig.wait(0.1)
    assert axis.p["current_state"] == (IDLE if count >= steps_before else CLOSED_LOOP), steps_before


@pytest.mark.parametrize("before", ["velocity", "torque", "move", "hold"])
def test_a_move_begins_where_the_axis_is(before: str) -> None:
    rig, axis = opened()
    if before == "velocity":
        rig.do(rig.unit.start_velocity(0, 0.05, ACTION))
    elif before == "torque":
        rig.do(rig.unit.start_force(0, 400.0, ACTION))
    elif before == "move":
        rig.do(rig.unit.start_position(0, 1.0, 0.05, ACTION))
    run(rig, 1.0)
    place, speed = axis.place, axis.velocity
    watch = Farthest(axis)
    rig.do(rig.unit.start_position(0, (place + 5) * TURN, 0.05, ACTION), watch)
    run(rig, 3.0, watch)
    assert axis.position == pytest.approx(place + 5, abs=0.01)
    assert watch.low > place - 1e-3 and watch.high < place + 5.05
    assert watch.speed < max(5.3, speed + 0.3), "the speed of the move, or that before it"


@pytest.mark.parametrize("before", ["torque", "move", "hold"])
def test_a_velocity_begins_at_the_present_speed(before: str) -> None:
    rig, axis = opened()
    if before == "torque":
        rig.do(rig.unit.start_force(0, 400.0, ACTION))
    elif before == "move":
        rig.do(rig.unit.start_position(0, 1.0, 0.05, ACTION))
    run(rig, 0.4)
    speed, greatest, last = axis.velocity, 0.0, axis.velocity

    def look() -> None:
        nonlocal greatest, last
        greatest, last = max(greatest, abs(axis.velocity - last)), axis.velocity

    rig.do(rig.unit.start_velocity(0, 0.09, ACTION), look)
    run(rig, 1.0, look)
    assert axis.velocity == pytest.approx(9.0, abs=0.1) and (before == "hold") == (abs(speed) < 0.01)
    assert greatest < 0.3, "turns/s in a millisecond; the ramp has 0.05"


def test_a_lost_line_of_the_setter_is_seen_before_the_axis_has_run_back() -> None:
    rig, axis = opened()
    rig.do(rig.unit.start_velocity(0, 0.08, ACTION))
    run(rig, 1.5)
    place, heard = axis.place, rig.device.take
    watch = Farthest(axis)
    rig.device.take = lambda data: heard(
        b"".join(line + b"\n" for line in data.split(b"\n")[:-1] if b"control_mode 3" not in line)
    )
    with pytest.raises(DeviceError, match=r"pos_setpoint reads .* while the axis is at"):
        rig.do(rig.unit.start_position(0, (place + 3) * TURN, 0.05, ACTION), watch)
    rig.wait(0.2, watch)
    assert axis.p["current_state"] == IDLE and watch.low >= place - 0.05


@pytest.mark.parametrize("off_s", [0.02, 0.3])
def test_a_restart_is_noticed_by_the_next_poll_and_everything_is_set_again(off_s: float) -> None:
    rig, axis = opened()
    rig.wait(0.4)
    poll(rig, 2)
    rig.device.power_cycle(str(off_s))
    rig.wait(off_s + 0.01)
    poll_until(rig, "restarted, its place is lost", 1)
    rig.do(rig.unit.open())  # as the kit does
    assert axis.p["config.enable_watchdog"] == 1 and axis.p["config.watchdog_timeout"] == 0.5
    assert axis.p["current_state"] == IDLE, "a fault is latched"
    latched = rig.unit.bank._queue.latched[0]
    assert latched & AxisStatus.POSITION_LOST and latched & AxisStatus.FAULT
    rig.unit.bank.reset(np.array([0]))
    assert rig.unit.bank._queue.latched[0] & AxisStatus.POSITION_LOST


@pytest.mark.parametrize(
    ("line", "told"),
    [
        (b"w axis0.config.enable_watchdog 0\n", "enable_watchdog reads 0, but 1 was set"),
        (b"w axis0.config.watchdog_timeout 9\n", "watchdog_timeout reads 9, but 0.5 was set"),
        (b"w axis0.controller.config.vel_limit 90\n", "vel_limit reads 90, but 20 was set"),
        (b"w axis0.motor.config.torque_lim 90\n", "torque_lim reads 90, but 10 was set"),
        (b"v 0 0.5\n", "control_mode reads 2, but 3 was set|input_vel reads 0.5"),
        (b"c 0 0.01\n", "control_mode reads 1, but 3 was set|input_torque reads 0.01"),
        (b"w axis0.controller.config.input_mode 2\n", "input_mode reads 2, but 1 was set"),
    ],
)
def test_what_somebody_else_sets_is_seen(line: bytes, told: str) -> None:
    rig, _ = opened()
    poll(rig, 10)
    rig.device.take(line)
    poll_until(rig, told, 10)


def test_a_force_that_the_board_would_cut_is_refused() -> None:
    rig = board()
    rig.device.axes[0].p["motor.config.torque_lim"] = 0.5
    with pytest.raises(
        DeviceError,
        match=r"force_max is 0.6366\d N m, but axis0.motor.config.torque_lim is 0.5; want at most",
    ):
        rig.do(rig.unit.open())
    rig.device.axes[0].p["motor.config.torque_lim"] = math.inf  # as it ships
    rig.do(rig.unit.open())
    poll(rig, 20)


def test_an_axis_that_somebody_else_switches_on_is_seen() -> None:
    rig, _ = opened()
    rig.do(rig.unit.halt(0, fastest=True))
    poll(rig, 3)
    rig.device.take(b"w axis0.requested_state 8\n")
    rig.wait(0.01)
    poll_until(rig, "current_state reads 8, but the axis was left idle", 1)


def test_a_dead_man_that_is_not_taken_is_no_opening() -> None:
    rig = board()
    heard = rig.device.take
    rig.device.take = lambda data: heard(data.replace(b"enable_watchdog 1", b"enable_watchdog_1"))
    with pytest.raises(LinkError, match="enable_watchdog reads 0 afterwards; 1 was sent"):
        rig.do(rig.unit.open())


def test_a_stop_whose_first_lines_are_refused_lets_go_all_the_same() -> None:
    rig, axis = opened()
    rig.do(rig.unit.start_velocity(0, 0.05, ACTION))
    rig.device.handlers()["refuse"]("3")
    rig.do(rig.unit.halt(0, fastest=True))
    rig.wait(0.01)
    assert axis.p["current_state"] == IDLE and axis.p["controller.input_vel"] == 0


def test_a_stop_behind_stray_bytes_and_half_lines_is_heard() -> None:
    for stray in (b"\x00", b"v 0 9", b"w axis0.controller.", b"*", b"x" * 200):
        rig, axis = opened()
        rig.do(rig.unit.start_velocity(0, 0.05, ACTION))
        rig.device.take(stray)
        rig.do(rig.unit.halt(0, fastest=True))
        rig.wait(0.01)
        assert axis.p["current_state"] == IDLE, stray


def test_what_others_left_running_is_ended_by_the_opening() -> None:
    for kind, value in (("velocity", "5"), ("torque", "0.5"), ("position", "30")):
        rig = board()
        axis = rig.device.axes[0]
        rig.device.foreign(kind, value)
        rig.wait(0.5)
        assert axis.velocity > 1
        rig.do(rig.unit.open())
        poll(rig, 100)
        assert abs(axis.velocity) < 0.01 and axis.p["current_state"] == CLOSED_LOOP, kind


def test_a_restart_while_the_link_is_lost_is_noticed_by_the_opening() -> None:
    rig, axis = opened()
    rig.wait(0.4)
    rig.device.power_cycle("1.5")
    rig.wait(1.6)
    rig.do(rig.unit.open())
    assert rig.unit.bank._queue.latched[0] & AxisStatus.POSITION_LOST
    assert axis.p["current_state"] == IDLE
    run(rig, 1.0)  # and is not told again


def homing_rig(torque: float = 10.0, **keys: Any) -> Joined:
    axis = {"name": "x", "number": 0, "travel_per_turn": TURN, "force_max": 400.0, "homing": True, **LIMITS}
    rig = Joined(Odrive, {"axis": [axis], **keys}, lambda clock: odrive.Board(clock=clock))
    rig.device.axes[0].p["motor.config.torque_lim"] = torque
    rig.do(rig.unit.open())
    return rig


@pytest.mark.parametrize("state", [IDLE, CLOSED_LOOP])
def test_a_homing_that_another_master_ends_is_no_home(state: int) -> None:
    """The board leaves the state without an error, also when an earlier homing has succeeded."""
    rig = homing_rig()
    rotor = rig.device.axes[0]
    rotor.p["is_homed"] = 1
    rig.device.handlers()["switch"]("-2")
    rig.do(rig.unit.home(0))
    run(rig, 0.3)
    assert rotor.p["current_state"] == HOMING and rotor.place < -0.01
    rotor.p["requested_state"] = state
    run(rig, 1.0)
    assert "broken off" in rig.unit._faults[0]
    rig.unit.bank._queue.latched[0] = 0  # as the kit does first
    rig.do(rig.unit.reset(0))
    run(rig, 0.1)
    assert not rig.unit._faults[0] and rotor.p["current_state"] == CLOSED_LOOP


def test_homing_turns_back_from_the_switch_and_holds() -> None:
    rig = homing_rig()
    rotor = rig.device.axes[0]
    rig.device.handlers()["switch"]("-2")
    rig.do(rig.unit.home(0))
    watch = Farthest(rotor)
    run(rig, 6.0, watch)
    assert rotor.p["is_homed"] and rotor.p["current_state"] == CLOSED_LOOP
    assert rotor.place == pytest.approx(-1.75, abs=0.02), "by the offset away from the switch"
    assert rotor.position == pytest.approx(0.0, abs=0.02)
    assert watch.low > -2.1 and watch.high < 0.01 and watch.speed < 2.5


def let_go_in_motion(torque: float = 10.0, **keys: Any) -> tuple[Joined, odrive.Axis]:
    """Return a board whose homing ends in motion: its trajectory back from the switch is over before the rotor is."""
    rig = homing_rig(torque, **keys)
    rotor = rig.device.axes[0]
    for name in ("accel", "decel"):
        rotor.p[f"trap_traj.config.{name}_limit"] = 50.0
    rotor.p["trap_traj.config.vel_limit"] = 10.0
    rotor.p["controller.config.vel_ramp_rate"] = 50.0
    rig.device.handlers()["switch"]("-2")
    rig.poll(2)
    return rig, rotor


@pytest.mark.parametrize("phase_us", range(0, 12000, 1000))
def test_a_homing_ends_once_the_loop_is_closed_and_the_axis_stands(phase_us: int) -> None:
    """The board lets go when its homing ends, and is idle and homed a turn of its loop before its estimate counts from
    the new zero. The turn is of 4 ms here, so that the lines of a poll fall into it on a slow line, too.
    """
    rig, rotor = let_go_in_motion()
    step, late, ran_on = rotor.step, iter(range(4)), [0.0]

    def stepped(dt: float, powered: bool = True) -> None:
        old = rotor.p["encoder.pos_estimate"]
        step(dt, powered)
        if rotor.p["is_homed"]:
            ran_on[0] = max(ran_on[0], abs(rotor.position))
            if next(late, None) is not None:
                rotor.p["encoder.pos_estimate"] = old

    rotor.step = stepped
    rig.wait(1e-6 * phase_us)
    rig.unit.bank.home([0], rig.unit.clock())
    rig._act()
    for _ in range(300):
        rig.poll()
        if not rig.unit.bank.rows["in_motion"][0]:
            break
    assert rotor.p["current_state"] == CLOSED_LOOP and abs(rotor.velocity) < 0.02
    assert ran_on[0] > 0.1, "a homing that ends at rest shows nothing"
    assert rig.unit.bank.rows["position"][0] == pytest.approx(rotor.position * TURN, abs=2e-5)
    assert rig.unit.bank.rows["status"][0] & AxisStatus.HOMED
    stood = rotor.place
    rig.poll(50)
    assert rotor.place == pytest.approx(stood, abs=2e-3)


def test_a_stop_while_a_homed_axis_runs_on_brakes_it() -> None:
    rig, rotor = let_go_in_motion(quick_stop="hold")
    rig.unit.bank.home([0], rig.unit.clock())
    rig._act()
    while not rig.unit._has_homed[0]:
        rig.poll()
    rig.unit.bank.stop([0], rig.unit.clock())
    rig.poll(30)
    assert rotor.p["current_state"] == CLOSED_LOOP and abs(rotor.velocity) < 0.02
    assert not rig.unit.bank.rows["in_motion"][0]
    assert not rig.unit.bank.rows["status"][0] & (AxisStatus.HOMED | AxisStatus.FAULT)


def test_an_error_during_a_homing_is_no_rest() -> None:
    rig, rotor = let_go_in_motion()
    rig.unit.bank.home([0], rig.unit.clock())
    rig._act()
    rig.poll(10)
    rotor.fail(0x40)
    while abs(rotor.velocity) > 0.03:
        assert rig.unit.bank.rows["in_motion"][0]
        rig.poll()
    assert rig.unit.bank.rows["status"][0] & AxisStatus.FAULT
    assert not rig.unit.bank.rows["status"][0] & AxisStatus.HOMED


def until_the_switch(phase: int) -> tuple[Joined, odrive.Axis]:
    """Return a board that homes, polled, and that has met its switch a millisecond ago, between two polls."""
    rig, rotor = let_go_in_motion()
    rig.wait(0.001 * phase)
    rig.unit.bank.home([0], rig.unit.clock())
    rig._act()
    while not rotor._homes_back:
        rig.do(rig.unit.poll())
        for _ in range(40):
            if not rotor._homes_back:
                rig.wait(0.001)
    return rig, rotor


def test_a_homing_stopped_at_the_switch_sets_a_zero_there_and_the_place_is_lost() -> None:
    """axis.cpp, run_homing: ``done`` is true yet when the second loop ends before its first look."""
    rig, rotor = next(
        (rig, rotor) for rig, rotor in map(until_the_switch, range(0, 60, 7)) if rotor._done and rotor._arms
    )
    assert not rotor.p["is_homed"]
    rig.unit.bank.stop([0], rig.unit.clock())
    rig.device.take(b"w axis0.requested_state 1\n")  # as the stop does, in this very turn
    rig._act()
    rig.poll(3)
    assert rotor.p["is_homed"] and abs(rotor.p["encoder.pos_estimate"]) < 1
    status = rig.unit.bank.rows["status"][0]
    assert status & AxisStatus.POSITION_LOST and not status & AxisStatus.HOMED
    assert "stopped while the board set its zero" in rig.unit.bank.fault_text(0)


@pytest.mark.parametrize("stopped", [False, True])
def test_a_zero_that_another_master_makes_at_the_switch_is_not_believed(stopped: bool) -> None:
    """Its request of idle comes in the half millisecond in which the board closes its loop there."""
    rig, rotor = next(
        (rig, rotor) for rig, rotor in map(until_the_switch, range(0, 60, 7)) if rotor._done and rotor._arms
    )
    rig.device.take(b"w axis0.requested_state 1\n")
    while stopped and not rig.unit._has_homed[0]:
        rig.poll()
    if stopped:
        rig.unit.bank.stop([0], rig.unit.clock())
    rig.poll(60)
    assert rotor.p["is_homed"] and abs(rotor.p["encoder.pos_estimate"]) < 1
    status = rig.unit.bank.rows["status"][0]
    assert status & AxisStatus.POSITION_LOST and not status & AxisStatus.HOMED
    assert "ended on the switch" in rig.unit.bank.fault_text(0)


def test_a_homing_that_ends_on_its_switch_is_not_believed() -> None:
    """Its trajectory off the switch ends by time while the rotor still runs into it, for want of torque."""
    rig, rotor = let_go_in_motion(torque=1.0)
    rig.unit.bank.home([0], rig.unit.clock())
    rig.poll(150)
    assert rotor.p["is_homed"] and rotor.origin < -2.3, "where -1.75 is asked for"
    status = rig.unit.bank.rows["status"][0]
    assert status & AxisStatus.POSITION_LOST and not status & AxisStatus.HOMED
    assert "ended on the switch" in rig.unit.bank.fault_text(0)
