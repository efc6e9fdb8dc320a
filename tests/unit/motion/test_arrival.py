"""Point moves arrive: from one side, after settling, near enough or with a flag; stops are final."""

import errno

import numpy as np
import pytest
from motion_rig import MODE, Rig, axis

from sioms.motion import Arrival, AxisKind, Backlash, CommandError, EventKind, Restore, Watch
from sioms.protocol.flags import AxisStatus as S

D = 0.1
PLUS = axis(backlash=Backlash(D, velocity=0.5, acceleration=2.0))
TOLERANCE = 1e-3


def stepper(**changes):
    loose = Watch(tolerance=1.0)  # what slips here does so at once
    return axis(**{"kind": AxisKind.STEPPER, "k": None, "watch": loose, **changes})


def slipping(*losses):
    """Return a plant whose encoder stays behind the output by the next of the losses at each reversal to rest."""
    left, state = list(losses), {"last": 0.0, "lost": 0.0, "moved": False}

    def plant(output, dt):
        moved = abs(output[0] - state["last"]) > 1e-9
        if state["moved"] and not moved and left:
            state["lost"] += left.pop(0)
        state["last"], state["moved"] = output[0], moved
        return output - state["lost"]

    return plant


def tries(rig):
    """Return how often axis 0 tried its last point move again."""
    return rig.bank.diagnostics([0])["retries"][0]


def last_turn(p, v):
    """Return the position at which the motion last changed its direction."""
    moving = np.flatnonzero(np.abs(v) > 1e-9)
    signs = np.sign(v[moving])
    turns = np.flatnonzero(signs[1:] != signs[:-1])
    return p[moving[turns[-1]]] if turns.size else p[moving[0]]


@pytest.mark.parametrize("distance", [D, -D])
@pytest.mark.parametrize("start", [-1.0, 1.0])
def test_a_place_is_reached_from_one_side_whatever_side_the_move_comes_from(distance, start):
    rig = Rig([axis(backlash=Backlash(distance))], start=[start])
    rig.write(mode=MODE.POSITION, position=0.2)
    rig.run()
    p, v = rig.trace("commanded_position"), rig.trace("commanded_velocity")
    assert p[-1] == pytest.approx(0.2, abs=1e-9)
    assert np.sign(v[np.abs(v) > 1e-9][-1]) == np.sign(distance)
    comes_right = (0.2 - start) * distance > 0
    assert last_turn(p, v) == pytest.approx(start if comes_right else 0.2 - distance, abs=1e-3)


def test_a_move_that_comes_from_the_right_side_is_not_longer_than_without_a_take_up():
    times = []
    for settings in (axis(), PLUS):
        rig = Rig([settings])
        rig.write(mode=MODE.POSITION, position=0.5)
        times.append(rig.run())
    assert times[0] == times[1]


def test_a_move_too_fast_to_stop_at_its_new_target_comes_back_to_it_from_its_side():
    rig = Rig([PLUS])
    rig.write(mode=MODE.VELOCITY, velocity=2.0)
    rig.tick(600)
    here = rig.field("commanded_position")
    target = here + 1.5 * D  # more than the take-up ahead, and less than the way to a stop
    rig.write(mode=MODE.POSITION, position=target, replace=True)
    rig.run()
    p, v = rig.trace("commanded_position"), rig.trace("commanded_velocity")
    assert p.max() > target + D and p[-1] == pytest.approx(target)
    assert last_turn(p, v) == pytest.approx(target - D, abs=1e-3)


def test_the_take_up_has_its_own_velocity_and_acceleration():
    rig = Rig([PLUS], start=[1.0])
    rig.write(mode=MODE.POSITION, position=0.0)
    rig.run()
    v = rig.trace("commanded_velocity")
    assert v.min() < -1.5 and 0.3 < v.max() <= 0.5
    forwards = v > 1e-9
    assert np.abs(np.diff(v[forwards])).max() <= 2.0 * 1e-3 * 1.001


def test_small_steps_onwards_do_not_go_back():
    rig = Rig([PLUS], start=[1.0])
    rig.write(mode=MODE.POSITION, position=0.0)
    rig.run()
    begin = len(rig.history)
    for _ in range(5):
        rig.write(mode=MODE.POSITION | MODE.RELATIVE, position=0.01)
        rig.run()
    assert rig.trace("commanded_velocity")[begin:].min() >= -1e-12
    assert rig.field("commanded_position") == pytest.approx(0.05)


@pytest.mark.parametrize("way", [{"mode": MODE.VELOCITY | MODE.SPECIFIED_TIME, "velocity": 0.5, "time": 0.2},
                                 {"mode": MODE.POSITION | MODE.SPECIFIED_TIME, "position": 0.05, "time": 1.0}])  # fmt: skip  # noqa: E501
def test_after_any_other_motion_a_small_step_takes_up_again(way):
    rig = Rig([PLUS])
    rig.write(mode=MODE.POSITION, position=0.2)
    rig.run()
    rig.write(**way)
    rig.run()
    here, begin = rig.field("commanded_position"), len(rig.history)
    rig.write(mode=MODE.POSITION, position=here + 0.01)
    rig.run()
    assert rig.trace("commanded_position")[begin:].min() == pytest.approx(here + 0.01 - D, abs=1e-3)


def test_trajectories_go_where_they_are_told():
    rig = Rig([axis(backlash=Backlash(D), arrival=Arrival(settle_s=0.5))], start=[1.0])
    rig.write(mode=[MODE.POSITION | MODE.VELOCITY, MODE.POSITION | MODE.SPECIFIED_TIME], position=[0.5, 0.0],
              velocity=-0.5, time=1.5)  # fmt: skip
    rig.run()
    assert rig.trace("commanded_velocity").max() <= 1e-9
    assert rig.field("commanded_position") == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("verb", ["stop", "emergency_stop"])
@pytest.mark.parametrize("ticks", [100, 600, 900])
def test_a_stop_in_the_middle_is_final(verb, ticks):
    rig = Rig([PLUS], start=[1.0])
    rig.write(mode=[MODE.POSITION, MODE.POSITION], position=[0.0, 0.5])
    rig.tick(ticks)
    v = rig.field("commanded_velocity")
    assert abs(v) > 0.05
    begin = len(rig.history) - 1
    getattr(rig.bank, verb)([0], rig.now_ns)
    rig.tick(2000)
    after = rig.trace("commanded_velocity")[begin:]
    assert (after * np.sign(v) >= -1e-12).all(), "brakes, and does not turn round"
    assert rig.bank.is_idle([0]) and rig.field("commanded_velocity") == 0.0


def test_the_take_up_stays_inside_the_soft_limits():
    rig = Rig([PLUS])
    for position in (-3.0, -3.0 + 0.9 * D):
        with pytest.raises(CommandError) as caught:
            rig.write(mode=MODE.POSITION, position=position)
        assert caught.value.errno == errno.ERANGE
        assert "-2.9 to 3 m" in str(caught.value) and "0.1 left for the take-up" in str(caught.value)
    with pytest.raises(CommandError):
        rig.write(mode=MODE.POSITION | MODE.RELATIVE, position=-3.0)
    rig.write(mode=MODE.POSITION | MODE.SPECIFIED_TIME, position=-3.0, time=5.0)
    rig.run()
    rig.write(mode=MODE.POSITION, position=-3.0 + D)
    rig.run()
    assert rig.trace("commanded_position").min() == pytest.approx(-3.0)


def test_the_command_ends_after_it_has_settled_and_a_stop_then_ends_at_once():
    rig = Rig([axis(arrival=Arrival(settle_s=0.25))])
    token = rig.markers.reserve(3)
    rig.write(mode=MODE.POSITION | MODE.SPECIFIED_SIGNAL_MARKER, position=0.5, signal_marker_number=token)
    begin = rig.now_ns
    plain = Rig([axis()])
    plain.write(mode=MODE.POSITION, position=0.5)
    expected = plain.run() + 0.25
    assert rig.run() == pytest.approx(expected, abs=2e-3)
    assert (rig.markers.signals[0][1] - begin) * 1e-9 == pytest.approx(expected, abs=2e-3)
    rig.write(mode=MODE.POSITION, position=0.0)
    rig.tick(round(expected * 1000) - 100)
    assert rig.field("in_motion") and rig.field("commanded_velocity") == 0.0, "settles"
    rig.bank.stop([0], rig.now_ns)
    rig.tick(2)
    assert rig.bank.is_idle([0]) and not rig.field("in_motion")


def test_a_stepper_tries_again_until_its_encoder_says_that_it_is_there():
    rig = Rig([stepper(arrival=Arrival(0.01, TOLERANCE, retries=3))], plant=slipping(0.02, -0.01))
    rig.write(mode=MODE.POSITION, position=0.5)
    rig.run()
    assert rig.field("position") == pytest.approx(0.5, abs=TOLERANCE)
    assert rig.field("commanded_position") == pytest.approx(0.5, abs=TOLERANCE)
    assert tries(rig) == 2
    assert not rig.field("status") & S.MISSED_TARGET
    assert rig.kinds().count(EventKind.ENDED) == 1 and rig.kinds().count(EventKind.IDLE) == 1
    rig.write(mode=MODE.POSITION, position=0.6)
    rig.run()
    assert tries(rig) == 0, "of this move"


@pytest.mark.parametrize("retries", [0, 2])
def test_retries_are_bounded_and_a_miss_is_told(retries):
    rig = Rig([stepper(arrival=Arrival(0.01, TOLERANCE, retries))], plant=slipping(*[0.02] * 50))
    rig.write(mode=MODE.POSITION, position=0.5)
    rig.run()
    assert tries(rig) == retries
    assert rig.field("status") & S.MISSED_TARGET
    assert rig.field("position") == pytest.approx(0.48)
    rig.write(mode=MODE.POSITION | MODE.SPECIFIED_TIME, position=0.5, time=1.0)
    rig.tick(2)
    assert not rig.field("status") & S.MISSED_TARGET, "cleared by the next command"


def test_the_same_target_again_corrects_what_has_slipped_at_rest():
    slip = [0.0]
    rig = Rig([stepper(arrival=Arrival(0.0, TOLERANCE, retries=1))], plant=lambda output, dt: output - slip[0])
    rig.write(mode=MODE.POSITION, position=0.5)
    rig.run()
    slip[0] = 0.05
    rig.tick(3)
    rig.write(mode=MODE.POSITION, position=0.5)
    rig.run()
    assert rig.field("position") == pytest.approx(0.5, abs=TOLERANCE)


def test_a_retry_also_comes_from_the_right_side():
    settings = stepper(arrival=Arrival(0.01, TOLERANCE, retries=3), backlash=Backlash(D))
    rig = Rig([settings], start=[1.0], plant=slipping(-0.03))
    rig.write(mode=MODE.POSITION, position=0.5)
    rig.run()
    assert rig.field("position") == pytest.approx(0.5, abs=TOLERANCE)
    v = np.diff(rig.trace("position"))
    assert v[np.abs(v) > 1e-7][-1] > 0


def test_a_stop_in_a_retry_is_final():
    rig = Rig([stepper(arrival=Arrival(0.01, TOLERANCE, retries=50))], plant=slipping(*[0.3] * 50))
    rig.write(mode=MODE.POSITION, position=1.5)
    while not tries(rig):
        rig.tick()
    rig.tick(20)
    rig.bank.stop([0], rig.now_ns)
    rig.tick(1500)
    place, tried = rig.field("commanded_position"), tries(rig)
    rig.tick(500)
    assert rig.bank.is_idle([0]) and rig.field("commanded_position") == place and tries(rig) == tried


def test_a_servo_that_is_held_off_says_so_and_goes_on():
    rig = Rig([axis(arrival=Arrival(0.05, TOLERANCE))], plant=lambda output, dt: np.array([0.3]), start=[0.3])
    rig.write(mode=[MODE.POSITION, MODE.POSITION], position=[0.31, 0.3])
    rig.run()
    assert not rig.field("status") & S.MISSED_TARGET, "the last one has arrived"
    assert rig.bank.diagnostics([0])["misses"] == [1]
    rig.write(mode=MODE.POSITION, position=0.31)
    rig.run()
    assert rig.field("status") & S.MISSED_TARGET and not rig.field("status") & S.FAULT


def test_many_axes_settle_and_try_again_each_for_itself():
    n, missing = 40, 7
    lost = np.zeros(n)
    lost[::missing] = 0.01
    rig = Rig(
        [stepper(arrival=Arrival(0.02, TOLERANCE, 2)) for _ in range(n)],
        plant=lambda output, dt: output - lost,
    )
    rig.tick(2)
    rig.write(mode=[MODE.POSITION] * n, axis=list(range(n)), position=np.linspace(-1, 1, n))
    rig.run()
    assert np.abs(rig.bank.rows["position"] - np.linspace(-1, 1, n)).max() < TOLERANCE
    assert rig.bank.diagnostics(range(n))["retries"] == [int(i % missing == 0) for i in range(n)]


def test_a_step_below_the_deadband_is_not_carried_out_and_ends_at_once():
    rig = Rig([axis(deadband=0.01)])
    rig.write(mode=[MODE.POSITION] * 2, position=[0.009, -0.009])
    rig.tick(3)
    assert rig.bank.is_idle([0]) and rig.trace("commanded_position").tolist() == [0.0] * len(rig.history)
    assert rig.kinds().count(EventKind.ENDED) == 2
    rig.write(mode=MODE.POSITION, position=0.011)
    rig.run()
    assert rig.field("commanded_position") == pytest.approx(0.011)


def test_a_jog_takes_its_own_acceleration_and_leaves_that_of_the_axis():
    rig = Rig([axis(jerk_max=None)])
    rig.write(mode=MODE.VELOCITY | MODE.ACCELERATION, velocity=-0.5, acceleration=1.0)
    rig.tick(600)
    v = rig.trace("commanded_velocity")
    assert v[-1] == pytest.approx(-0.5) and np.interp(0.25, -v, np.arange(len(v)) * 1e-3) == pytest.approx(
        0.25, abs=3e-3
    )
    rig.write(mode=MODE.VELOCITY, velocity=0.5)
    rig.tick(300)
    assert np.diff(rig.trace("commanded_velocity")).max() == pytest.approx(5e-3, rel=1e-3)
    with pytest.raises(CommandError) as caught:
        rig.write(mode=MODE.VELOCITY | MODE.ACCELERATION, velocity=0.5, acceleration=-1.0)
    assert caught.value.errno == errno.ERANGE and "above 0" in str(caught.value)


def test_a_stepper_takes_its_start_velocity_at_once_and_no_more():
    jump = 0.2
    plain, quick = Rig([stepper(jerk_max=None)]), Rig([stepper(jerk_max=None, start_velocity=jump)])
    for rig in (plain, quick):
        rig.write(mode=MODE.POSITION, position=0.5)
    times = [plain.run(), quick.run()]
    # d = v^2/a from 0, and (v^2 - v0^2)/a from v0: both come to v = sqrt(a d + v0^2)
    top = np.sqrt(5.0 * 0.5 + jump**2)
    assert times[1] == pytest.approx(2 * (top - jump) / 5.0, abs=3e-3) and times[1] < times[0]
    p, v = quick.trace("commanded_position"), np.diff(quick.trace("commanded_position")) * 1e3
    assert p[-1] == pytest.approx(0.5, abs=1e-12) and p.max() <= 0.5 + 1e-9
    assert v.max() == pytest.approx(top, rel=1e-2)
    steps = np.abs(np.diff(v))
    assert steps.max() <= jump + 2 * 5.0 * 1e-3
    assert (np.minimum(np.abs(v[1:]), np.abs(v[:-1]))[steps > 0.02] <= jump + 0.02).all(), "jumps only from or to slow"
    assert not any(int(h["status"][0]) & S.SATURATED for h in quick.history)


def test_a_stepper_jogs_below_its_start_velocity_without_a_ramp():
    rig = Rig([stepper(start_velocity=0.3)])
    rig.write(mode=MODE.VELOCITY, velocity=-0.1)
    rig.tick(101)
    assert rig.field("commanded_position") == pytest.approx(-0.0101, abs=2e-4)
    rig.write(mode=MODE.VELOCITY, velocity=0.25, replace=True)
    rig.tick(100)
    assert rig.field("commanded_position") == pytest.approx(0.015, abs=1e-3)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        (lambda: Backlash(0.0), "distance 0"),
        (lambda: Backlash(1.0, velocity=-1.0), "velocity -1"),
        (lambda: axis(backlash=Backlash(7.0)), "distance 7 does not fit between"),
        (lambda: Arrival(settle_s=-1.0), "settle_s -1"),
        (lambda: Arrival(retries=2), "without a tolerance"),
        (lambda: Arrival(tolerance=0.0), "tolerance 0"),
        (lambda: axis(arrival=Arrival(0.0, 1e-3, 2)), "the loop of a servo"),
        (lambda: axis(start_velocity=0.1), "only a stepper"),
        (lambda: axis(deadband=-1.0), "deadband -1"),
        (lambda: axis(ki=-1.0), "ki -1"),
        (lambda: stepper(ki=1.0), "goes where it is told"),
        (lambda: Restore("perhaps"), "when = 'perhaps'"),
        (lambda: Restore("matching", -1.0), "tolerance -1"),
    ],
)
def test_settings_that_cannot_be_are_refused(settings, words):
    with pytest.raises(ValueError, match=words):
        settings()
