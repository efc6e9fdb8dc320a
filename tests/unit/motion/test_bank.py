"""The bank's verbs and buffer semantics (specification 3.3 to 3.5), on an invented clock."""

import errno
from collections.abc import Callable

import numpy as np
import pytest
from motion_rig import MODE, TICK_NS, Rig, axis

from sioms.motion import SWITCH_HOME, SWITCH_MINUS, SWITCH_PLUS, AxisKind, CommandError, EventKind, Homing
from sioms.protocol.flags import AxisStatus as S

TIMED = MODE.POSITION | MODE.SPECIFIED_TIME


def dropped(rig):
    return [(e.axes, e.errno) for e in rig.events if e.kind is EventKind.DROPPED]


def test_fields_are_one_block_and_integers_are_int64():
    rig = Rig([axis(), axis()])
    assert rig.bank.fields.flags.c_contiguous
    rig.write(mode=[MODE.POSITION] * 3, position=[0.1, 0.2, 0.3])
    rig.tick()
    assert rig.field("buffered") == 2 and rig.field("in_motion") == 1 and rig.field("in_motion", 1) == 0
    assert rig.field("status") & S.MOVING


def test_a_field_of_the_loop_with_the_name_of_a_column_is_that_column():
    """A column that every tick works out anew is declared, and filled in the steps; nothing between hands it on."""
    bank = Rig([axis(), axis()]).bank
    shared = [name for name in bank.rows if name in bank.arrays]
    assert {"position", "velocity", "force", "k", "kz", "kp", "kb", "status", "buffered"} <= set(shared)
    assert all(np.shares_memory(bank.arrays[name], bank.rows[name]) for name in shared)


def test_velocity_lasts_until_the_next_command_which_starts_without_a_jump():
    rig = Rig([axis()])
    rig.write(mode=MODE.VELOCITY, velocity=0.5)
    rig.tick(1500)
    assert rig.field("commanded_velocity") == pytest.approx(0.5)
    assert not rig.bank.is_idle([0])
    rig.write(mode=MODE.POSITION, position=0.2)
    rig.run()
    assert rig.field("commanded_position") == pytest.approx(0.2, abs=1e-9)
    v = rig.trace("commanded_velocity")
    assert np.abs(np.diff(v)).max() <= 5.0 * 1e-3 * (1 + 1e-6)


def test_timed_velocity_that_nothing_follows_stops_at_maximum_deceleration():
    rig = Rig([axis()])
    rig.write(mode=MODE.VELOCITY | MODE.SPECIFIED_TIME, velocity=1.0, time=1.0)
    rig.run()
    # 1 m/s is reached with jerk 100: 0.05 + 0.15 + 0.05 s, half the way; then it stops within v^2 / 2a.
    assert rig.field("commanded_position") == pytest.approx(1.0 * (1.0 - 0.125) + 1.0 / 10.0, abs=1e-9)


def test_timed_force_ends_in_holding_where_the_axis_is():
    rig = Rig([axis()], start=[0.25], plant=lambda output, dt: np.array([0.25]))
    rig.tick(5)
    rig.write(mode=MODE.FORCE | MODE.SPECIFIED_TIME, force=3.0, time=0.1)
    rig.tick(50)
    assert rig.field("force") == 3.0
    assert rig.field("status") & S.FORCE_MODE
    rig.tick(60)
    assert rig.bank.is_idle([0])
    assert rig.field("force") == 0.0
    assert rig.field("commanded_position") == 0.25


def test_force_velocity_ramps_and_saturates():
    rig = Rig([axis(k=0.0)], plant=lambda output, dt: np.zeros(1))
    rig.write(mode=MODE.FORCE | MODE.SPECIFIED_TIME, force=2.0, time=0.1)
    rig.write(mode=MODE.FORCE_VELOCITY, force_velocity=20.0)
    rig.tick(300)
    assert rig.field("force") == pytest.approx(2.0 + 20.0 * 0.2, abs=1e-9)
    rig.tick(1000)
    assert rig.field("force") == 10.0


def test_specified_settings_persist_and_are_published():
    rig = Rig([axis()])
    rig.write(
        mode=[MODE.POSITION | MODE.SPECIFIED_GAINS | MODE.SPECIFIED_MAX_VEL_ACC, MODE.POSITION],
        position=[0.5, 0.0], k=7.0, kz=-0.5, kp=0.1, kb=-2.0, max_velocity=0.25, max_acceleration=1.0,
    )  # fmt: skip
    rig.run()
    assert [rig.field(f) for f in ("k", "kz", "kp", "kb")] == [7.0, -0.5, 0.1, -2.0]
    assert np.abs(rig.trace("commanded_velocity")).max() == pytest.approx(0.25, rel=1e-6)


def test_marker_holds_and_signal_fires_in_the_tick_of_the_end():
    rig = Rig([axis(), axis()])
    token = rig.markers.reserve(9)
    rig.write(
        mode=[TIMED | MODE.SPECIFIED_SIGNAL_MARKER, MODE.POSITION | MODE.SPECIFIED_WAIT_MARKER],
        axis=[0, 1], position=[0.1, 0.2], time=0.5, signal_marker_number=token, wait_marker_number=9,
    )  # fmt: skip
    begin = rig.now_ns
    rig.tick(499)
    assert not rig.markers.signals
    assert rig.field("status", 1) & S.WAITING_MARKER and rig.field("commanded_position", 1) == 0.0
    rig.tick(1)
    assert rig.markers.signals == [(9, begin + 500 * TICK_NS)]
    rig.tick(2)
    assert not rig.field("status", 1) & S.WAITING_MARKER
    rig.run()
    assert rig.field("commanded_position", 1) == pytest.approx(0.2)


def test_freed_marker_drops_the_buffer_with_epipe():
    rig = Rig([axis()])
    rig.markers.reserve(9)
    rig.write(mode=[MODE.POSITION | MODE.SPECIFIED_WAIT_MARKER, MODE.POSITION], position=[1.0, 2.0],
              wait_marker_number=9)  # fmt: skip
    rig.tick(3)
    rig.markers.table.free(9)
    rig.markers.reserve(9)
    rig.tick(3)
    assert dropped(rig) == [((0,), errno.EPIPE)]
    assert rig.bank.is_idle([0]) and rig.field("buffered") == 0


def test_synch_starts_all_at_the_same_exact_instant():
    rig, other = Rig([axis(), axis()]), Rig([axis()], tick_ns=700_000)
    for r in (rig, other):
        r.write(mode=[MODE.POSITION | MODE.WAIT_FOR_EXTERNAL_SYNCH] * len(r.axes), axis=r.axes, position=1.0)
        r.tick(5)
        assert r.field("status") & S.WAITING_SYNCH
    start = max(rig.now_ns, other.now_ns) + 3_141_592
    for r in (rig, other):
        assert r.bank.synch(r.axes, start, r.now_ns) == tuple(r.axes)
    tau = 0.04  # in the first jerk phase p = j t^3 / 6
    for r in (rig, other):
        while r.now_ns + r.tick_ns <= start + tau * 1e9:
            r.tick()
        t = (r.now_ns - start) * 1e-9
        for i in r.axes:
            assert r.field("commanded_position", i) == pytest.approx(100 * t**3 / 6, rel=1e-6)


def test_synch_leaves_axes_that_wait_for_nothing():
    rig = Rig([axis(), axis()])
    rig.write(mode=TIMED, axis=1, position=0.5, time=1.0)
    rig.write(mode=MODE.POSITION | MODE.WAIT_FOR_EXTERNAL_SYNCH, axis=1, position=0.0)
    rig.tick(2)
    assert rig.bank.synch([0, 1], rig.now_ns + 10**6, rig.now_ns) == ()
    rig.tick(1500)
    assert rig.field("status", 1) & S.WAITING_SYNCH


def test_late_synch_stops_instead_of_hurrying():
    rig = Rig([axis()])
    rig.write(mode=MODE.POSITION | MODE.WAIT_FOR_EXTERNAL_SYNCH, position=1.0)
    rig.tick(2)
    assert rig.bank.synch([0], rig.now_ns - 5 * TICK_NS, rig.now_ns) == ()
    rig.tick(2)
    assert dropped(rig) == [((0,), errno.ETIME)]
    assert rig.field("commanded_position") == 0.0


def test_replace_empties_the_buffer_and_replans_without_a_jump():
    rig = Rig([axis()])
    rig.write(mode=[MODE.POSITION] * 3, position=[1.0, 2.0, 3.0])
    rig.tick(400)
    rig.write(replace=True, mode=MODE.POSITION, position=0.1)
    assert rig.field("buffered") <= 2
    rig.run()
    assert rig.field("commanded_position") == pytest.approx(0.1, abs=1e-9)
    v = rig.trace("commanded_velocity")
    assert np.abs(np.diff(v)).max() <= 5.0e-3 * (1 + 1e-6)
    assert rig.trace("commanded_position").max() < 1.0


def test_stop_halts_within_v_over_a_and_empties_the_buffer():
    rig = Rig([axis()])
    rig.write(mode=[MODE.VELOCITY, MODE.POSITION | MODE.WAIT_FOR_EXTERNAL_SYNCH], velocity=2.0, position=1.0)
    rig.tick(800)
    place = rig.field("commanded_position")
    rig.bank.stop([0], rig.now_ns)
    rig.tick(1)
    assert rig.field("status") & S.STOPPING and rig.field("buffered") == 0
    took = rig.run()
    assert took == pytest.approx(2.0 / 5.0, abs=2e-3)
    assert rig.field("commanded_position") == pytest.approx(place + 2.0**2 / 10.0, abs=1e-6)


def test_emergency_stop_latches_and_nothing_resumes():
    rig = Rig([axis(), axis()], plant=lambda output, dt: np.zeros(2))
    rig.write(mode=MODE.FORCE, axis=1, force=5.0)
    rig.write(mode=[MODE.POSITION] * 2, position=[1.0, 2.0])
    rig.tick(100)
    assert rig.field("force", 1) == 5.0
    rig.bank.emergency_stop([0, 1], rig.now_ns, "emergency stop by eva")
    rig.bank.emergency_stop([0, 1], rig.now_ns, "emergency stop by tom")
    rig.tick(1)
    assert rig.field("force", 1) == 0.0
    assert rig.field("status") & S.EMERGENCY_STOP
    with pytest.raises(CommandError, match="stopped: emergency stop by eva; RESET first") as caught:
        rig.write(mode=MODE.POSITION, position=0.0)
    assert caught.value.errno == errno.EPERM
    rig.tick(1000)
    assert rig.bank.is_idle([0, 1])
    assert ((0, 1), errno.ECANCELED) in dropped(rig)
    rest = rig.field("commanded_position")
    rig.bank.reset([0, 1])
    rig.tick(500)
    assert rig.field("commanded_position") == rest
    assert not rig.field("status") & S.EMERGENCY_STOP
    rig.write(mode=MODE.POSITION, position=rest)
    rig.bank.emergency_stop([0], rig.now_ns, "emergency stop by tom")
    with pytest.raises(CommandError, match="stopped: emergency stop by tom"):
        rig.write(mode=MODE.POSITION, position=0.0)


@pytest.mark.parametrize("mode", [{"mode": MODE.VELOCITY, "velocity": 1.7}, {"mode": MODE.ACCELERATION, "acceleration": 5.0},  # noqa: E501
                                  {"mode": MODE.JERK, "jerk": 80.0}])  # fmt: skip
@pytest.mark.parametrize("tick_ns", [TICK_NS, 13_000_000])
def test_soft_limit_is_reached_and_not_passed(mode, tick_ns):
    rig = Rig([axis()], tick_ns=tick_ns)
    rig.write(**mode)
    rig.run()
    assert 3.0 - 1e-6 < rig.field("commanded_position") <= 3.0
    assert rig.trace("commanded_position").max() <= 3.0
    assert rig.field("status") & S.LIMIT_PLUS
    assert dropped(rig) == [((0,), errno.ERANGE)]
    rig.write(**{k: (-v if k != "mode" else v) for k, v in mode.items()})
    rig.tick(50)
    assert rig.field("commanded_position") < 3.0 and not rig.field("status") & S.LIMIT_PLUS


def test_following_error_is_a_fault_with_zero_force():
    rig = Rig([axis(following_error_max=0.05)], plant=lambda output, dt: np.zeros(1))
    rig.write(mode=MODE.POSITION, position=1.0)
    rig.tick(1000)
    assert rig.field("status") & S.FAULT and rig.field("status") & S.FOLLOWING_ERROR
    assert rig.field("force") == 0.0
    assert "following error" in rig.bank.fault_text(0)
    assert np.abs(rig.trace("following_error")).max() < 0.05 + 2e-3
    with pytest.raises(CommandError) as caught:
        rig.write(mode=MODE.POSITION, position=0.0)
    assert caught.value.errno == errno.EIO
    rig.bank.reset([0])
    rig.tick(5)
    assert rig.field("force") == 0.0 and not rig.field("status") & S.FAULT


def test_stepper_that_loses_steps_is_stalled_and_stops():
    rig = Rig([axis(kind=AxisKind.STEPPER, k=None, following_error_max=0.01)], plant=lambda output, dt: np.zeros(1))
    rig.write(mode=MODE.POSITION, position=1.0)
    rig.tick(1500)
    assert rig.field("status") & S.STALLED
    assert rig.bank.is_idle([0])
    output = rig.bank.tick(rig.now_ns + TICK_NS, rig.raw)[0]
    rig.bank.reset([0])
    rig.tick(5)
    assert not rig.field("status") & (S.STALLED | S.FAULT)
    assert rig.field("commanded_position") == rig.field("position") == 0.0
    assert rig.bank.tick(rig.now_ns + TICK_NS, rig.raw)[0] == pytest.approx(output), "the motor stays where it is"


@pytest.mark.parametrize("value", [float("nan"), float("inf"), float("-inf")])
def test_non_finite_measurement_is_a_fault_with_zero_force(value):
    rig = Rig([axis(), axis()])
    rig.write(mode=[MODE.POSITION] * 2, axis=[0, 1], position=1.0)
    rig.tick(200)
    rig.raw = np.array([value, rig.raw[1]])
    output = rig.bank.tick(rig.now_ns + TICK_NS, rig.raw)
    assert output[0] == 0.0 and np.isfinite(output).all() and np.isfinite(rig.bank.fields[:10]).all()
    assert rig.field("status") & S.FAULT and not rig.field("status", 1) & S.FAULT


def test_late_tick_stops_from_where_it_was():
    rig = Rig([axis()])
    rig.write(mode=MODE.VELOCITY, velocity=2.0)
    rig.tick(600)
    place = rig.field("commanded_position")
    rig.now_ns += 200 * TICK_NS
    rig.tick(1)
    assert rig.field("commanded_position") == pytest.approx(place, abs=1e-2)
    assert rig.field("status") & S.FAULT
    rig.run()
    assert rig.field("commanded_position") == pytest.approx(place + 0.4, abs=1e-6)


def test_infeasible_at_planning_stops_with_a_latched_fault():
    rig = Rig([axis()])
    rig.write(mode=MODE.VELOCITY | MODE.SPECIFIED_TIME, velocity=1.0, time=0.5)
    rig.write(mode=[TIMED, MODE.POSITION], position=[-2.0, 0.0], time=0.3)  # begins in a state not known at the write
    rig.run()
    assert rig.field("status") & S.FAULT
    assert "too short" in rig.bank.fault_text(0)
    assert dropped(rig) == [((0,), errno.ERANGE)]
    assert rig.field("commanded_position") > 0.0


def test_pass_through_reaches_position_with_velocity():
    rig = Rig([axis()])
    passing = MODE.POSITION | MODE.VELOCITY
    rig.write(mode=[passing, passing | MODE.ACCELERATION, MODE.POSITION], position=[0.5, 1.0, 1.5],
              velocity=[1.0, 0.5, 0.0], acceleration=[0.0, -1.0, 0.0])  # fmt: skip
    rig.run()
    p, v = rig.trace("commanded_position"), rig.trace("commanded_velocity")
    for place, speed in ((0.5, 1.0), (1.0, 0.5)):
        assert np.interp(place, p, v) == pytest.approx(speed, abs=5e-3)
    assert rig.field("commanded_position") == pytest.approx(1.5)


def test_calibrate_moves_coordinates_not_the_axis():
    rig = Rig([axis(), axis(kind=AxisKind.STEPPER, k=None)], start=[0.7, 0.7])
    rig.bank.calibrate([0, 1], [0.1, 0.2])
    rig.tick(1)
    assert [rig.field("position", i) for i in (0, 1)] == pytest.approx([0.1, 0.2])
    assert rig.field("force") == pytest.approx(0.0, abs=1e-12)
    assert rig.bank.tick(rig.now_ns + TICK_NS, rig.raw)[1] == pytest.approx(0.7)
    rig.write(mode=MODE.POSITION, position=0.5)
    with pytest.raises(CommandError) as caught:
        rig.bank.zero([0])
    assert caught.value.errno == errno.EBUSY
    with pytest.raises(CommandError) as caught:
        rig.bank.calibrate([1], [3.5])
    assert caught.value.errno == errno.ERANGE


def test_limits_can_be_narrowed_and_restored_never_widened():
    rig = Rig([axis(), axis()])
    rig.bank.set_limits([0, 1], position_max=[0.5, 0.6], velocity_max=0.25)
    assert rig.bank.get_limits([0, 1])["position_max"] == [0.5, 0.6]
    with pytest.raises(CommandError):
        rig.write(mode=MODE.POSITION, position=0.55)
    rig.write(mode=MODE.POSITION, position=0.4)
    rig.run()
    assert rig.trace("commanded_velocity").max() == pytest.approx(0.25, rel=1e-6)
    for wrong in ({"position_max": 4.0}, {"velocity_max": -1.0}, {"nothing": 1.0}, {"position_max": 0.3}):
        with pytest.raises(CommandError):
            rig.bank.set_limits([0], **wrong)
    rig.bank.set_limits([0, 1], position_max=None, velocity_max=None)
    assert rig.bank.get_limits([0])["position_max"] == [3.0]


def test_end_switch_stops_one_way_only():
    rig = Rig([axis()])
    rig.switches = lambda raw: np.array([SWITCH_PLUS if raw[0] > 0.5 else 0])
    rig.write(mode=MODE.VELOCITY, velocity=0.3)
    rig.run()
    assert 0.5 < rig.field("commanded_position") < 0.5 + 0.3**2 / 10 + 2e-3
    assert rig.field("status") & S.SWITCH_PLUS
    rig.write(mode=MODE.POSITION, position=0.0)
    rig.run()
    assert rig.field("commanded_position") == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("start", [0.7, 0.32, 0.05])
def test_homing_finds_the_same_edge_from_everywhere(start):
    homing = Homing(velocity=0.5, slow_velocity=0.02, direction=-1, offset=0.1, required=True)
    rig = Rig([axis(homing=homing, position_min=-0.5)], start=[start])

    def switches(raw):
        home = SWITCH_HOME if 0.30 < raw[0] < 0.35 else 0
        return np.array([home | (SWITCH_MINUS if raw[0] < 0.0 else 0)])

    rig.switches = switches
    with pytest.raises(CommandError, match="home required"):
        rig.write(mode=MODE.POSITION, position=0.2)
    rig.bank.home([0], rig.now_ns)
    rig.tick(2)
    assert rig.field("status") & S.HOMING and not rig.bank.is_idle([0])
    rig.run()
    assert EventKind.HOMED in rig.kinds()
    assert rig.field("status") & S.HOMED
    # the edge at which it leaves the switch upwards lies at raw 0.35 and is position 0.1
    assert rig.raw[0] - rig.field("position") == pytest.approx(0.25, abs=0.02 * 2e-3)
    rig.write(mode=MODE.POSITION, position=0.2)
    rig.run()
    assert rig.raw[0] == pytest.approx(0.45, abs=1e-4)


def test_homing_that_finds_nothing_is_a_fault():
    rig = Rig([axis(homing=Homing(velocity=0.5, slow_velocity=0.02, travel=0.4))])
    rig.switches = lambda raw: np.zeros(1, dtype=np.int64)
    rig.bank.home([0], rig.now_ns)
    rig.tick(1500)
    assert "no home switch" in rig.bank.fault_text(0)
    assert not rig.field("status") & (S.HOMED | S.HOMING)


def test_force_mode_keeps_position_limits():
    state = {"v": 0.0}

    def mass(output, dt):
        state["v"] += output[0] / 2.0 * dt
        return rig.raw + state["v"] * dt

    rig = Rig([axis(k=400.0, kb=-20.0, position_max=0.3)])
    rig.plant = mass
    rig.write(mode=MODE.FORCE, force=2.0)
    rig.tick(6000)
    assert dropped(rig) == [((0,), errno.ERANGE)]
    assert 0.29 < rig.trace("position").max() < 0.3 + 0.01
    assert not rig.field("status") & S.FORCE_MODE


def test_a_replaced_command_does_not_signal_its_marker():
    rig = Rig([axis()])
    token = rig.markers.reserve(4)
    rig.write(mode=MODE.POSITION | MODE.SPECIFIED_SIGNAL_MARKER, position=1.0, signal_marker_number=token)
    rig.tick(100)
    rig.write(replace=True, mode=MODE.POSITION, position=0.0)
    rig.run()
    assert rig.markers.signals == []


def test_an_emptied_buffer_says_nothing_about_where_the_next_command_begins():
    rig = Rig([axis()])
    rig.write(mode=MODE.POSITION, position=2.0)
    rig.tick(300)
    rig.bank.stop([0], rig.now_ns)
    rig.write(mode=MODE.POSITION | MODE.RELATIVE, position=1.5)  # from 2.0 it would lead out of the limits
    rig.run()
    assert not rig.bank.fault_text(0)
    assert rig.field("commanded_position") < 2.5


def test_a_move_that_lasts_longer_than_can_be_planned_is_refused():
    rig = Rig([axis()])
    for mode in (MODE.POSITION, MODE.POSITION | MODE.VELOCITY):
        with pytest.raises(CommandError, match="8000 s; want more than 0 and at most 7600 s") as refused:
            rig.write(mode=mode | MODE.SPECIFIED_TIME, position=0.4, time=8000.0)
        assert refused.value.errno == errno.EINVAL
    rig.write(mode=MODE.POSITION | MODE.SPECIFIED_TIME, position=0.4, time=7599.0)
    rig.write(mode=MODE.VELOCITY | MODE.SPECIFIED_TIME, velocity=0.0, time=8000.0)
    rig.tick(5)
    assert not rig.bank.fault_text(0)


def test_flush_lets_the_running_command_end():
    rig = Rig([axis()])
    rig.write(mode=[MODE.POSITION, MODE.POSITION], position=[0.5, 1.0])
    rig.tick(100)
    rig.bank.flush([0])
    rig.run()
    assert rig.field("commanded_position") == pytest.approx(0.5)


def test_flush_of_a_waiting_axis_is_idle_at_once():
    rig = Rig([axis()])
    rig.write(mode=MODE.POSITION | MODE.WAIT_FOR_EXTERNAL_SYNCH, position=0.5)
    rig.tick(3)
    assert not rig.bank.is_idle([0])
    rig.bank.flush([0])
    assert rig.bank.is_idle([0])
    assert [e.kind for e in rig.bank.take_events()] == [EventKind.IDLE]


class Wall:
    """A mass with friction before a wall that is a spring; ``force`` is that on the wall."""

    def __init__(self, place: float, *, mass: float = 1.0, stiffness: float = 2e4, viscous: float = 2.0) -> None:
        self.place, self.mass, self.stiffness, self.viscous = place, mass, stiffness, viscous
        self.velocity = self.force = 0.0

    def before(self, rig: Rig, sign: float = 1.0) -> Callable[[np.ndarray, float], np.ndarray]:
        """Return the plant with the wall on the side that the sign says."""

        def step(output: np.ndarray, dt: float) -> np.ndarray:
            x, steps = sign * float(rig.raw[0]), 10
            for _ in range(steps):
                depth = x - self.place
                self.force = max(0.0, self.stiffness * depth + 40.0 * self.velocity) if depth > 0 else 0.0
                drive = sign * float(output[0]) - self.force - self.viscous * self.velocity
                self.velocity += drive / self.mass * dt / steps
                x += self.velocity * dt / steps
            return np.array([sign * x])

        return step


@pytest.mark.parametrize("force", [4.0, -4.0])
@pytest.mark.parametrize("way", [0.02, 0.06, 0.1, 0.25, 1.0])
@pytest.mark.parametrize("end", ["velocity", "time", "stop", "switch", "position"])
def test_what_follows_a_force_presses_no_harder_than_the_force(force: float, way: float, end: str) -> None:
    """It met nothing, or not yet: braked from there it may meet a wall, and holds there what was asked at most."""
    sign = 1.0 if force > 0 else -1.0
    limits = {"position_max": way + 0.02, "position_min": -way - 0.02} if end == "position" else {}
    gains = {"k": 4e4, "kz": -0.95, "kb": -4.0}
    rig = Rig([axis(velocity_max=0.5, acceleration_max=2.0, force_max=50.0, **gains, **limits)])
    wall = Wall(way)
    rig.plant = wall.before(rig, sign)
    timed = MODE.SPECIFIED_TIME if end == "time" else 0
    rig.write(mode=MODE.FORCE | timed, force=force, time=0.1 if timed else 0.0)
    rig.tick(110)
    if end == "stop":
        rig.bank.stop([0], rig.now_ns)
    if end == "switch":
        rig.switches = lambda raw: np.array([SWITCH_PLUS if sign > 0 else SWITCH_MINUS])
    presses, goes_back = [0.0], 0
    for _ in range(900):
        rig.tick()
        if not rig.field("status") & S.FORCE_MODE:  # in which damping comes beside the force
            presses.append(rig.field("force") * sign)
            goes_back = goes_back + 1 if rig.field("velocity") * sign < -0.005 else 0
            if goes_back:
                pressed = presses.pop()
                assert pressed <= 5.0 + 1e-6 or goes_back > 100, "thrown back it is braked with a tenth of its force"
    assert max(presses) <= abs(force) + 1e-6, "the actuator, in the direction of the force"
    assert wall.force <= abs(force) + 0.05, "the wall, when all has come to rest"
    ended = any(e.kind is EventKind.DROPPED and e.errno == errno.ERANGE for e in rig.events) and end != "switch"
    assert bool(rig.field("status") & S.FORCE_ENDED) == ended
    if ended:
        assert S(rig.field("status")).severity >= 1 and not rig.field("status") & S.FORCE_MODE
        rig.write(mode=MODE.POSITION, position=0.0)
        rig.run()
        assert not rig.field("status") & S.FORCE_ENDED
        assert abs(rig.field("position")) < 1e-3, "afterwards it has all its force again"


@pytest.mark.parametrize("way", [0.02, 0.06, 1.0])
@pytest.mark.parametrize("ticks", [110, 2000])
@pytest.mark.parametrize("stops_first", [False, True])
def test_an_emergency_stop_of_a_force_brakes_what_moves_and_then_presses_no_more(
    way: float, ticks: int, stops_first: bool
) -> None:
    """In free space there is next to no friction: nothing else would brake it."""
    rig = Rig([axis(velocity_max=0.5, acceleration_max=2.0, force_max=50.0, k=4e4, kz=-0.95, kb=-4.0)])
    wall = Wall(way, viscous=1e-3 if way == 1.0 else 5.0)
    rig.plant = wall.before(rig)
    rig.write(mode=MODE.FORCE, force=4.0)
    rig.tick(ticks if way < 1.0 else 110)
    velocity, place = rig.field("velocity"), rig.field("position")
    if stops_first:
        rig.bank.stop([0], rig.now_ns)
        rig.tick(5)
    rig.bank.emergency_stop([0], rig.now_ns)
    presses = []
    for _ in range(900):
        rig.tick()
        presses.append(rig.field("force"))
        assert presses[-1] <= (5.0 if rig.field("velocity") < -0.005 else 4.0) + 1e-6, "more only if thrown back"
    assert abs(presses[-1]) < 1e-9
    assert abs(rig.field("velocity")) < 0.005
    if way == 1.0:
        assert velocity > 0.3 and rig.field("position") - place < 1.2 * velocity**2 / (2 * 2.0)
    assert wall.force < 1e-3, "it lies at the wall at most"
    rig.bank.reset([0])
    rig.tick(100)
    assert rig.bank.is_idle([0]) and abs(rig.field("velocity")) < 0.005


def test_a_force_ends_at_the_velocity_that_its_command_allows() -> None:
    """It met nothing: so far it ran up to the limit of the axis. The next one without such a limit has that again."""
    rig = Rig([axis(velocity_max=0.5, acceleration_max=2.0, force_max=50.0, k=4e4, kz=-0.95, kb=-4.0)])
    rig.plant = Wall(9.0).before(rig)
    slow = MODE.FORCE | MODE.SPECIFIED_MAX_VEL_ACC
    for mode, fastest in ((slow, 0.05), (MODE.FORCE, 0.5), (slow, 0.05)):
        rig.write(mode=mode, force=4.0, max_velocity=0.05, max_acceleration=1.0)
        velocities = []
        for _ in range(1500):
            rig.tick()
            velocities.append(rig.field("velocity"))
        assert fastest < max(velocities) < 1.3 * fastest, mode
        assert dropped(rig)[-1] == ((0,), errno.ERANGE) and rig.field("status") & S.FORCE_ENDED
        rig.bank.set_limits([0], velocity_max=0.5)
        assert rig.bank.is_idle([0])


def test_the_bound_of_a_force_is_lifted_at_rest() -> None:
    """What is held then is held with all there is; a zero force that is stopped in motion holds, too."""
    for force in (3.0, 0.0):
        rig = Rig([axis(k=2000.0, kb=-40.0, force_max=50.0)])
        wall = Wall(9.0)
        push, plant = [0.0], wall.before(rig)
        rig.plant = lambda output, dt, plant=plant, push=push: plant(output + push[0], dt)
        rig.write(mode=MODE.FORCE, force=3.0)
        rig.tick(100)
        rig.write(mode=MODE.FORCE, force=force)
        rig.tick(10)
        rig.bank.stop([0], rig.now_ns)
        rig.tick(1500)
        held = rig.field("position")
        assert rig.bank.is_idle([0])
        push[0] = -20.0
        rig.tick(1000)
        assert abs(rig.field("position") - held) < 0.02, "it gives way by the stiffness of the law alone"
        push[0] = 20.0
        rig.tick(1000)
        assert abs(rig.field("position") - held) < 0.02


def test_what_waits_behind_a_passing_command_begins_at_rest():
    rig = Rig([axis()])
    token = rig.markers.reserve(3)
    rig.write(
        mode=[MODE.POSITION | MODE.VELOCITY, MODE.POSITION | MODE.SPECIFIED_WAIT_MARKER],
        position=[0.2, 0.3], velocity=[0.3, 0.0], wait_marker_number=[0, token],
    )  # fmt: skip
    rig.tick(1000)  # it has passed 0.2, and braked, for the marker is not signalled
    rig.markers.signal(3, rig.markers.table.generation(3), rig.now_ns)
    rig.run()
    assert rig.field("commanded_position") == pytest.approx(0.3)
    assert np.abs(np.diff(rig.trace("commanded_velocity"))).max() <= 5.0 * 1e-3 * (1 + 1e-6)
