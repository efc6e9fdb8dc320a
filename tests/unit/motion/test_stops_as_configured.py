"""Stops of axes whose gains, or greatest force, a command has set: they brake and hold with what is configured.

The plants are Newton's law and nothing else; what the tests ask for follows from it.
"""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import Phase, example, given, settings
from hypothesis import strategies as st

from sioms.motion import AxisKind, CommandError, EventKind, Homing
from sioms.motion.force_end import BACK_NS, ForceEnds
from sioms.motion.settings import SWITCH_HOME, Watch
from sioms.protocol.flags import AxisStatus, ControlMode

from ...motion_rig import Rig, axis
from .test_behind import Mass

TIME = ControlMode.SPECIFIED_TIME
POSITION, VELOCITY, FORCE = ControlMode.POSITION, ControlMode.VELOCITY, ControlMode.FORCE
GAINS, MAX_FORCE = ControlMode.SPECIFIED_GAINS, ControlMode.SPECIFIED_MAX_FORCE
CONFIGURED = {"k": 400.0, "kb": -40.0, "following_error_max": np.inf, "acceleration_max": 5.0, "jerk_max": None,
              "watch": Watch(uncommanded=False)}  # fmt: skip
HARMFUL = [
    {"k": 0.0},
    {"k": 1e-6},
    {"k": -100.0},
    {"kb": 30.0},
    {"k": 1.0, "kz": -1.0},
    {"k": 0.0, "kp": 0.99},
]
STOPS = ("stop", "emergency_stop", "late", "abandon")


def rig_of(plant: Mass, **changes: float) -> Rig:
    return Rig([axis(**{**CONFIGURED, **changes})], plant=plant)


def end_by(rig: Rig, how: str) -> None:
    if how == "late":
        rig.now_ns += 60_000_000
    elif how == "abandon":
        rig.bank.abandon(rig.axes, rig.now_ns, 32, "its client has died")
    else:
        getattr(rig.bank, how)(rig.axes, rig.now_ns)


@pytest.mark.parametrize("stop", STOPS)
@pytest.mark.parametrize("gains", HARMFUL, ids=str)
def test_an_axis_that_its_own_gains_do_not_brake_is_braked(gains: dict[str, float], stop: str) -> None:
    plant = Mass(viscous=0.0)
    rig = rig_of(plant)
    rig.write(mode=VELOCITY, velocity=0.3)
    rig.tick(500)
    rig.write(mode=VELOCITY | GAINS, velocity=0.3, replace=True, **gains)
    rig.tick(20)
    place, speed = plant.position, plant.velocity
    end_by(rig, stop)
    coasts = speed * 0.061 if stop == "late" else 0.0
    rig.tick(1)
    fastest, farthest = 0.0, 0.0
    for _ in range(2000):
        rig.tick()
        fastest, farthest = max(fastest, abs(plant.velocity)), max(farthest, plant.position)
    assert fastest <= abs(speed) + 0.01
    assert farthest - place <= speed**2 / (2 * 5.0) + 40.0 / 400.0 * abs(speed) + coasts + 0.01
    assert abs(plant.velocity) < 1e-3
    assert rig.bank.is_idle(rig.axes)
    assert rig.field("k") == 400.0 and rig.field("kb") == -40.0


@pytest.mark.parametrize("stop", ("stop", "emergency_stop"))
def test_an_axis_at_rest_that_nothing_holds_is_held(stop: str) -> None:
    plant = Mass(viscous=0.0, pull=-2.0)  # a weight
    rig = rig_of(plant)
    rig.write(mode=POSITION, position=0.5)
    rig.run()
    rig.tick(500)
    rig.write(mode=POSITION | GAINS, position=0.5, k=0.0)
    rig.tick(100)
    assert rig.bank.is_idle(rig.axes) and plant.velocity < -0.1  # it falls
    place = plant.position
    getattr(rig.bank, stop)(rig.axes, rig.now_ns)
    rig.tick(1500)
    assert abs(plant.velocity) < 1e-3
    assert place - plant.position < 0.05


@pytest.mark.parametrize("stop", ("stop", "emergency_stop"))
@pytest.mark.parametrize("pull", (-3.0, 3.0))
def test_a_soft_axis_that_is_pressed_away_does_not_leap(pull: float, stop: str) -> None:
    plant = Mass(viscous=5.0)
    rig = rig_of(plant)
    rig.write(mode=POSITION | GAINS, position=0.5, k=10.0, kb=-6.0)
    rig.run()
    plant.pull = pull
    rig.tick(5000)
    assert abs(plant.position - 0.5 - pull / 10.0) < 0.01  # so far it has yielded
    place = plant.position
    getattr(rig.bank, stop)(rig.axes, rig.now_ns)
    places = []
    for _ in range(1000):
        rig.tick()
        places.append(plant.position)
        assert abs(rig.field("force") + pull) < 0.5  # it goes on holding against what presses
    assert np.abs(np.array(places) - place).max() < 1e-3


def test_homing_does_not_leap_either() -> None:
    plant = Mass(viscous=5.0)
    homing = Homing(velocity=0.1, slow_velocity=0.02, offset=0.0, travel=2.0)
    rig = rig_of(plant, homing=homing)
    rig.switches = lambda raw: (raw < -0.2) * SWITCH_HOME
    rig.write(mode=POSITION | GAINS, position=0.5, k=10.0, kb=-6.0)
    rig.run()
    plant.pull = 3.0
    rig.tick(5000)
    before = plant.position
    rig.bank.home(rig.axes, rig.now_ns)
    rig.tick(100)
    assert abs(plant.position - before) < 0.1 * 0.1 + 0.005
    assert rig.trace("velocity")[-100:].min() > -0.15


@pytest.mark.parametrize("stop", STOPS)
def test_a_small_force_of_a_command_does_not_bound_the_brakes(stop: str) -> None:
    plant = Mass(viscous=0.0)
    rig = rig_of(plant)
    rig.write(mode=VELOCITY, velocity=0.5)
    rig.tick(500)
    rig.write(mode=VELOCITY | MAX_FORCE, velocity=0.5, max_force=0.01, replace=True)
    rig.tick(20)
    place = plant.position
    end_by(rig, stop)
    rig.tick(2000)
    assert abs(plant.velocity) < 1e-3
    assert plant.position - place < 0.5**2 / 10 + 0.1 * 0.5 + (0.031 if stop == "late" else 0.0) + 0.01


@pytest.mark.parametrize("stop", ("stop", "emergency_stop"))
@pytest.mark.parametrize("way", (0.0, 0.002, 0.02))
def test_what_was_to_press_gently_does_not_press_harder_for_a_stop(way: float, stop: str) -> None:
    plant = Mass(viscous=0.0, wall=0.3)
    rig = rig_of(plant)
    rig.write(mode=POSITION | MAX_FORCE, position=1.0, max_force=2.0, max_velocity=0.2)
    for _ in range(5000):
        if plant.position >= 0.3 - way:
            break
        rig.tick()
    getattr(rig.bank, stop)(rig.axes, rig.now_ns)
    rig.tick(2000)
    assert rig.trace("force")[-2000:].max() <= 2.0 + 1e-9
    assert rig.bank.is_idle(rig.axes) and plant.velocity == pytest.approx(0.0, abs=1e-3)


@pytest.mark.parametrize("stop", ("stop", "emergency_stop"))
@pytest.mark.parametrize(("most", "pull"), ((0.5, -1.0), (0.5, -3.0), (2.0, -2.2)))
def test_a_load_that_the_allowed_force_does_not_carry_is_held(most: float, pull: float, stop: str) -> None:
    """It goes up when it is stopped, and comes down at once."""
    plant = Mass(viscous=0.0)
    rig = rig_of(plant)
    rig.write(mode=VELOCITY, velocity=0.3)
    rig.tick(300)
    plant.pull = pull
    rig.write(mode=VELOCITY | MAX_FORCE, velocity=0.3, max_force=most, replace=True)
    rig.tick(5)
    getattr(rig.bank, stop)(rig.axes, rig.now_ns)
    rig.tick(1500)
    place = plant.position
    rig.tick(1000)
    assert abs(plant.velocity) < 1e-3
    assert abs(plant.position - place) < 1e-3


def test_a_long_brake_of_an_axis_that_is_held_back_goes_on_to_its_end() -> None:
    plant = Mass(viscous=0.0)
    rig = rig_of(plant, acceleration_max=0.5, position_min=None, position_max=None)
    rig.write(mode=VELOCITY, velocity=1.5)
    rig.tick(3500)
    rig.write(mode=VELOCITY | MAX_FORCE, velocity=1.5, max_force=5.0, replace=True)
    rig.tick(20)
    place, before = plant.position, len(rig.history)
    rig.bank.stop(rig.axes, rig.now_ns)
    rig.tick(5000)
    assert plant.position - place == pytest.approx(1.5**2 / (2 * 0.5) + 1.5 * 40 / 400, abs=0.05)
    assert np.abs(rig.trace("force")[before:]).max() < 1.0  # of 1 kg that is braked with 0.5 m/s^2


@pytest.mark.parametrize("after", ({}, {"k": 3000.0, "kb": -90.0}, {"k": 20.0, "kb": -20.0}), ids=str)
@pytest.mark.parametrize("gains", ({"k": 4000.0, "kb": -100.0}, {"k": 20.0, "kb": -20.0}), ids=str)
def test_the_next_command_does_not_leap_with_what_the_axis_carries(
    gains: dict[str, float], after: dict[str, float]
) -> None:
    plant = Mass(viscous=10.0, pull=-5.0)  # a weight
    rig = rig_of(plant, force_max=100.0)
    rig.write(mode=POSITION | GAINS, position=0.1, **gains)
    rig.tick(6000)
    rig.bank.stop(rig.axes, rig.now_ns)
    rig.tick(800)
    place, before = plant.position, len(rig.history)
    rig.write(mode=VELOCITY | (GAINS if after else 0), velocity=0.0, **after)
    rig.tick(800)
    assert rig.field("k") == {**gains, **after}["k"]
    assert abs(plant.position - place) < 1e-4
    assert np.abs(rig.trace("force")[before:] - 5.0).max() < 0.05


@pytest.mark.parametrize("gains", ({"k": 4000.0, "kb": -100.0}, {"k": 20.0, "kb": -20.0}), ids=str)
def test_an_integral_carries_on_what_the_axis_held(gains: dict[str, float]) -> None:
    plant = Mass(viscous=10.0, pull=-5.0)
    rig = rig_of(plant, k=2000.0, kb=-80.0, ki=300.0, force_max=100.0)
    rig.tick(3000)
    rig.write(mode=POSITION | GAINS, position=plant.position, **gains)
    rig.tick(3000)
    for after in ({}, {"k": 100.0, "kb": -30.0}):
        place = plant.position
        rig.bank.stop(rig.axes, rig.now_ns)
        rig.tick(1500)
        rig.write(mode=VELOCITY | (GAINS if after else 0), velocity=0.0, **after)
        rig.tick(1500)
        assert abs(plant.position - place) < 1e-3


@pytest.mark.parametrize("ki", (0.0, 300.0))
@pytest.mark.parametrize(
    "gains",
    ({"k": 1e-12, "kb": -5.0}, {"k": 1e308, "kz": 10.0}, {"k": 1e-308, "kz": -0.5}, {"k": 1.0, "kb": 1e308}),
    ids=str,
)
def test_gains_that_carry_nothing_leave_the_set_point(gains: dict[str, float], ki: float) -> None:
    plant = Mass(viscous=10.0, pull=-2.0)
    rig = rig_of(plant, position_min=None, position_max=None, ki=ki)
    rig.write(mode=VELOCITY | GAINS, velocity=0.0, **gains)
    rig.tick(10)
    rig.bank.stop(rig.axes, rig.now_ns)
    rig.tick(1000)
    rig.write(mode=VELOCITY, velocity=0.0)
    rig.tick(5)
    assert abs(rig.field("commanded_position") - plant.position) < 0.1
    rig.bank.stop(rig.axes, rig.now_ns)
    rig.tick(3000)
    assert np.isfinite(rig.trace("force")).all()
    assert abs(plant.velocity) < 0.01


def test_a_command_that_was_possible_where_the_set_point_was_is_carried_out() -> None:
    plant = Mass(viscous=10.0, pull=-5.0)
    rig = rig_of(plant)
    rig.write(mode=POSITION | GAINS, position=0.1, k=20.0, kb=-20.0)
    rig.tick(6000)
    rig.bank.stop(rig.axes, rig.now_ns)
    rig.tick(800)
    rig.write(mode=POSITION | TIME, position=rig.field("commanded_position") - 0.2, time=0.4001)  # 2 sqrt(0.2 / 5)
    rig.tick(800)
    assert rig.kinds().count(EventKind.STARTED) == 2
    assert rig.bank.fault_text(0) == ""


def test_a_force_that_ends_by_itself_is_braked_whatever_the_gains() -> None:
    plant = Mass(viscous=0.0)
    rig = rig_of(plant)
    rig.write(mode=FORCE | TIME | GAINS, force=1.0, time=0.3, k=0.0)
    rig.tick(290)
    speed, place = plant.velocity, plant.position
    rig.tick(600)
    assert abs(plant.velocity) < 1e-3
    assert plant.position - place < speed**2 / 10 + 0.1 * speed + 0.01


def test_an_axis_whose_next_command_is_not_possible_is_braked() -> None:
    plant = Mass(viscous=0.0)
    rig = rig_of(plant)
    rig.write(mode=VELOCITY, velocity=0.3)
    rig.tick(500)
    rig.write(mode=VELOCITY | GAINS, velocity=0.3, replace=True, k=0.0)
    rig.tick(20)
    place = plant.position
    rig.write(mode=POSITION | TIME, position=2.5, time=0.05, replace=True)
    rig.tick(1000)
    assert "too short" in rig.bank.fault_text(0)
    assert abs(plant.velocity) < 1e-3 and rig.bank.is_idle(rig.axes)
    assert plant.position - place < 0.3**2 / 10 + 0.1 * 0.3 + 0.01


@pytest.mark.parametrize("sign", (1.0, -1.0))
def test_an_axis_with_gains_of_a_command_keeps_its_soft_limits(sign: float) -> None:
    """The configured gains follow 30 mm late, which is the set-point's lead when they come into force."""
    for ends_by_itself in (True, False):
        plant = Mass(viscous=0.0)
        rig = rig_of(plant, position_max=0.3, position_min=-0.3)
        rig.write(mode=VELOCITY | GAINS, velocity=0.3 * sign, k=825043.0, kz=-0.914)
        for _ in range(3000):
            if abs(plant.position) > 0.285 and not ends_by_itself:
                rig.bank.stop(rig.axes, rig.now_ns + 300_000)
            rig.tick()
        assert np.abs(rig.trace("position")).max() < 0.3 + 1e-3
        assert abs(plant.position) > 0.28 and rig.bank.is_idle(rig.axes)


def test_a_tuned_axis_that_was_let_go_is_held_without_a_kick() -> None:
    peaks = []
    for mode in (POSITION, POSITION | MAX_FORCE):
        plant = Mass(viscous=50.0, pull=-5.0)
        rig = rig_of(plant, k=825043.0, kz=-0.914, kb=0.0, force_max=100.0, force_offset=5.0)
        rig.write(mode=mode, position=0.1, max_force=50.0)
        rig.run()
        rig.tick(200)
        rig.bank.let_go(rig.axes)
        rig.tick(3)
        rig.bank.reset(rig.axes)
        rig.tick(600)
        peaks.append(np.abs(rig.trace("force")[-600:]).max())
    assert peaks[1] == pytest.approx(peaks[0])


def test_a_stepper_with_narrowed_acceleration_does_not_swing_back() -> None:
    rig = Rig([axis(kind=AxisKind.STEPPER, k=None)], plant=lambda output, dt: output.copy())
    rig.bank.set_limits(rig.axes, acceleration_max=0.5)
    rig.write(mode=VELOCITY, velocity=0.5)
    rig.tick(2000)
    rig.write(mode=VELOCITY | GAINS, velocity=0.5, replace=True, k=900.0)
    rig.tick(50)
    rig.bank.stop(rig.axes, rig.now_ns)
    rig.tick(4000)
    assert rig.field("position") >= rig.trace("position").max() - 1e-6


def test_an_axis_that_turns_at_once_is_held_back_as_long_as_others() -> None:
    ends, limit = ForceEnds(1), np.array([1.0])
    ends.hold_back(0, 1.0, 0.5)
    ends.look(np.array([-0.2]), limit, 10**12)
    assert ends.is_bound(np.array([0])).all()
    ends.look(np.array([-0.2]), limit, 10**12 + BACK_NS + 1)
    assert not ends.is_bound(np.array([0])).any()


@pytest.mark.parametrize("mode", (VELOCITY, VELOCITY | MAX_FORCE, VELOCITY | GAINS, FORCE), ids=str)
def test_a_stop_between_ticks_is_no_kick(mode: int) -> None:
    """The readings are those of the last tick, and the axis has gone on since."""
    peaks = []
    for since_ns in (0, 500_000, 990_000):
        plant = Mass(viscous=10.0)
        rig = rig_of(plant, k=825043.0, kz=-0.914, kb=0.0, force_max=100.0)
        rig.write(mode=mode, velocity=0.5, force=5.0, max_force=90.0, k=700000.0, kz=-0.9)
        rig.tick(400)
        before = len(rig.history)
        rig.bank.stop(rig.axes, rig.now_ns + since_ns)
        rig.tick(400)
        peaks.append(np.abs(rig.trace("force")[before:]).max())
    assert peaks == pytest.approx([peaks[0]] * 3, abs=2.0)


@pytest.mark.parametrize(
    "gains", ({"k": 0.0}, {"k": -500.0}, {"k": 1000.0, "kb": 3.0}, {"k": 900.0, "kp": -0.99}), ids=str
)
def test_a_stepper_stops_whatever_its_gains(gains: dict[str, float]) -> None:
    rig = Rig([axis(kind=AxisKind.STEPPER, k=None)], plant=lambda output, dt: output.copy())
    rig.write(mode=VELOCITY, velocity=0.5)
    rig.tick(300)
    rig.write(mode=VELOCITY | GAINS, velocity=0.5, replace=True, **gains)
    rig.tick(5)
    place, speed = rig.field("position"), abs(rig.field("velocity"))
    rig.bank.emergency_stop(rig.axes, rig.now_ns)
    rig.tick(1000)
    assert abs(rig.field("position") - place) <= speed**2 / 10 + 0.01
    assert rig.field("position") == rig.trace("position")[-10]
    assert rig.bank.is_idle(rig.axes)


@pytest.mark.parametrize("others", (0, 7))
def test_the_next_command_has_its_gains_again(others: int) -> None:
    """However many axes begin at once: a few go a way of their own."""
    plant = Mass()
    idle = [axis(**CONFIGURED) for _ in range(others)]
    rig = Rig([axis(**CONFIGURED), *idle], plant=lambda force, dt: np.append(plant(force, dt), np.zeros(others)))
    rig.write(mode=POSITION | GAINS | MAX_FORCE, position=0.5, k=50.0, kb=-15.0, max_force=3.0)
    rig.tick(200)
    assert rig.field("k") == 50.0
    rig.bank.stop(rig.axes, rig.now_ns)
    rig.tick(1500)
    assert rig.field("k") == 400.0
    rig.write(mode=POSITION, position=np.zeros(others + 1), axis=np.arange(others + 1))
    rig.tick(1)
    assert (rig.field("k"), rig.field("kb")) == (50.0, -15.0)
    rig.tick(200)
    assert rig.trace("force").max() <= 3.0
    rig.write(mode=FORCE, force=9.0, replace=True)  # what a command has allowed bounds the next ones
    rig.tick(300)
    assert rig.trace("force").max() <= 3.0


@pytest.mark.parametrize("stop", ("stop", "emergency_stop"))
def test_a_narrowed_acceleration_does_not_lengthen_the_end_of_a_force(stop: str) -> None:
    plant = Mass(viscous=0.0)
    rig = rig_of(plant, position_min=None, position_max=None)
    rig.bank.set_limits(rig.axes, acceleration_max=1e-3)
    rig.write(mode=FORCE, force=9.0)
    while plant.velocity < 0.2:
        rig.tick()
    place, speed = plant.position, plant.velocity
    getattr(rig.bank, stop)(rig.axes, rig.now_ns)
    rig.tick(2000)
    assert abs(plant.velocity) < 0.01 * 2.0  # an emergency stop lets go at this speed
    assert plant.position - place < speed**2 / 10 + 0.1 * speed + 0.01


@pytest.mark.parametrize("pull", (0.0, -2.0))
def test_an_axis_that_gains_of_a_command_had_lag_behind_is_braked_for_the_fault(pull: float) -> None:
    plant = Mass(viscous=0.2)
    rig = rig_of(plant, following_error_max=0.1)
    rig.write(mode=VELOCITY, velocity=0.5)
    rig.tick(400)
    plant.pull = pull
    rig.write(mode=VELOCITY | GAINS, velocity=0.7, k=0.0, replace=True)
    while not int(rig.field("status")) & AxisStatus.FOLLOWING_ERROR:
        rig.tick()
    place, speed = plant.position, abs(plant.velocity)
    rig.tick(2000)
    assert abs(plant.velocity) < 1e-3
    assert abs(plant.position - place) < speed**2 / 10 + 0.1 * speed + 0.02
    with pytest.raises(CommandError, match="fault"):
        rig.write(mode=POSITION, position=0.0)


def test_an_axis_that_sinks_for_gains_of_a_command_is_held_in_fault() -> None:
    plant = Mass(viscous=0.0, pull=-2.0)
    rig = rig_of(plant, watch=Watch())
    rig.write(mode=POSITION, position=0.5)
    rig.run()
    rig.tick(500)
    rig.write(mode=POSITION | GAINS, position=0.5, k=0.0)
    rig.tick(2000)
    assert int(rig.field("status")) & AxisStatus.FAULT
    assert abs(plant.velocity) < 1e-3
    assert plant.position > 0.3


def test_a_loop_that_its_configured_gains_do_not_close_is_let_go() -> None:
    """Its motor has come off: what a command has set was not what was wrong."""
    plant = Mass(viscous=1.0)
    motor = [1.0]
    rig = Rig([axis(**{**CONFIGURED, "following_error_max": 0.1})], plant=lambda force, dt: plant(force * motor[0], dt))
    rig.write(mode=VELOCITY | GAINS, velocity=0.5, k=200.0, kz=0.0, kp=0.0, kb=-40.0)
    rig.tick(400)
    motor[0] = -1.0
    rig.tick(1500)
    assert int(rig.field("status")) & AxisStatus.FAULT
    assert rig.field("force") == 0.0
    assert np.abs(rig.trace("velocity")).max() < 2.0


def test_what_commands_have_set_ends_with_their_client() -> None:
    plant = Mass()
    rig = rig_of(plant)
    mode = POSITION | GAINS | MAX_FORCE | ControlMode.SPECIFIED_MAX_VEL_ACC
    rig.write(mode=mode, position=0.5, k=0.0, max_force=3.0, max_velocity=0.01, max_acceleration=0.1)
    rig.tick(200)
    rig.bank.stop(rig.axes, rig.now_ns)
    rig.bank.forget_settings(rig.axes)
    rig.tick(200)
    assert rig.field("k") == 400.0
    rig.write(mode=POSITION, position=0.5)
    rig.run()
    rig.tick(500)
    assert abs(plant.position - 0.5) < 1e-2
    assert rig.trace("commanded_velocity").max() > 1.0


def test_limits_that_are_set_of_a_stopped_axis_leave_what_holds_it() -> None:
    plant = Mass(viscous=0.0, pull=-2.0)
    rig = rig_of(plant)
    rig.tick(500)
    rig.write(mode=POSITION | GAINS, position=0.0, k=0.0)
    rig.tick(50)
    rig.bank.stop(rig.axes, rig.now_ns)
    rig.tick(1500)
    place = plant.position
    rig.bank.set_limits(rig.axes, force_max=5.0)
    rig.tick(1000)
    assert abs(plant.position - place) < 1e-4


@settings(max_examples=25, deadline=None, phases=(Phase.explicit, Phase.reuse, Phase.generate))
@given(
    k=st.floats(-500, 5000), kb=st.floats(-100, 50), kz=st.floats(-2, 1), kp=st.floats(-0.99, 0.99),
    most=st.floats(0.05, 10.0), mass=st.floats(0.5, 3.0), viscous=st.floats(0, 8), pull=st.floats(-2, 2),
    before=st.integers(1, 250), also_force=st.booleans(), emergency=st.booleans(),
)  # fmt: skip
@example(k=3983.0, kb=-27.4, kz=-1.568, kp=-0.744, most=2.55, mass=0.562, viscous=2.02, pull=-1.335, before=203,
         also_force=True, emergency=True)  # fmt: skip
def test_an_axis_stands_soon_whatever_a_command_has_set(
    k: float, kb: float, kz: float, kp: float, most: float, mass: float, viscous: float, pull: float,
    before: int, also_force: bool, emergency: bool,
) -> None:  # fmt: skip
    plant = Mass(mass=mass, viscous=viscous)
    rig = rig_of(plant, position_min=None, position_max=None, acceleration_max=2.0)
    plant.pull = pull
    rig.write(mode=VELOCITY, velocity=0.3)
    rig.tick(300)
    mode = VELOCITY | GAINS | (MAX_FORCE if also_force else 0)
    rig.write(mode=mode, velocity=0.3, k=k, kb=kb, kz=kz, kp=kp, max_force=most, replace=True)
    rig.tick(before)
    place, speed, ticks = plant.position, abs(plant.velocity), len(rig.history)
    is_in_fault = int(rig.field("status")) & AxisStatus.FAULT != 0  # by those gains
    is_let_go = is_in_fault and "though" not in rig.bank.fault_text(0)  # that its loop is not to blame is not known
    (rig.bank.emergency_stop if emergency else rig.bank.stop)(rig.axes, rig.now_ns)
    rig.tick(300 if is_let_go else 3000)
    assert bool(int(rig.field("status")) & AxisStatus.EMERGENCY_STOP) == emergency
    assert bool(int(rig.field("status")) & AxisStatus.FAULT) == is_in_fault
    if is_let_go:
        assert not rig.trace("force")[ticks:].any(), "no stop puts a loop in force that is in doubt"
        assert abs(plant.velocity) < 2e-2 or int(rig.field("status")) & AxisStatus.MOVING, "it tells that it moves"
        return
    assert abs(plant.velocity) < 2e-3
    weakest = (10.0 - abs(pull)) / mass  # the motor's deceleration against what pulls
    carried = 10.0 / 400  # what keeps the output as it was, which need not be a load
    way = speed**2 / (2 * min(2.0, weakest)) + 0.1 * speed + carried + 0.01
    assert abs(plant.position - place) <= 2 * way


def test_a_command_that_waits_for_a_brake_begins_where_the_brake_yields() -> None:
    plant = Mass(viscous=0.0)
    rig = rig_of(plant, k=4e4, kz=-0.95, kb=-4.0, force_max=50.0, acceleration_max=2.0)
    rig.write(mode=FORCE, force=3.0)
    rig.tick(100)
    assert plant.velocity > 0.2
    rig.bank.stop(rig.axes, rig.now_ns)
    rig.tick(2)
    rig.write(mode=POSITION | TIME, position=plant.position - 0.05, time=0.5)
    rig.tick(2)
    assert rig.field("buffered") == 1, "it waits for the end of the brake"
    target, plant.velocity, plant.wall = plant.position - 0.05, 0.0, plant.position  # it runs into something
    rig.tick(2)
    assert rig.field("commanded_position") == pytest.approx(plant.position, abs=1e-4), "and does not press on that"
    rig.tick(600)
    assert rig.field("buffered") == 0 and rig.bank.is_idle(rig.axes)
    assert plant.position == pytest.approx(target, abs=2e-3)
