"""Motion against facts that the planner does not use: closed durations, energy, no overshoot, no drift."""

import math

import numpy as np
import pytest
from motion_rig import MODE, Rig, axis

from sioms.motion.commands import Command
from sioms.motion.profile import Bounds, Planner

TIMED = MODE.POSITION | MODE.SPECIFIED_TIME
REST = (0.0, 0.0, 0.0)


def move(distance, v, a, j=math.inf, state=REST, **fields):
    command = Command._make([0] * len(Command._fields))
    command = command._replace(control_mode=int(MODE.POSITION), position=distance, **fields)
    return Planner().plan(command, state, Bounds(v, a, j, -math.inf, math.inf))


@pytest.mark.parametrize(("d", "v", "a"), [(1.0, 0.5, 2.0), (1.0, 5.0, 2.0), (1e-4, 1.0, 10.0), (30.0, 0.1, 0.5)])
def test_trapezoid_durations(d, v, a):
    """Time-optimal under v and a: d/v + v/a when v is reached, else 2 sqrt(d/a)."""
    expected = d / v + v / a if d >= v * v / a else 2 * math.sqrt(d / a)
    assert move(d, v, a).duration == pytest.approx(expected, rel=1e-9)
    assert move(-d, v, a).duration == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("d", [1e-5, 1e-3, 0.05, 0.4, 3.0])
def test_s_curve_durations(d):
    """Rest to rest under v, a, j: the three closed cases (jerk only; with constant a; with constant v)."""
    v, a, j = 1.0, 5.0, 50.0
    if d <= 2 * a**3 / j**2 and 4 * (d / (2 * j)) ** (1 / 3) <= 4 * a / j:
        expected = 4 * (d / (2 * j)) ** (1 / 3)
    elif d <= v * (a / j + v / a):
        expected = a / j + math.sqrt((a / j) ** 2 + 4 * d / a)
    else:
        expected = d / v + v / a + a / j
    assert move(d, v, a, j).duration == pytest.approx(expected, rel=1e-7)


@pytest.mark.parametrize("a", [0.1, 0.5, 1.0, 2.0, 3.0, 5.0, 10.0])
@pytest.mark.parametrize("j", [10.0, 20.0, 50.0, 100.0, 1000.0])
@pytest.mark.parametrize("start", [0.0, 0.25])
def test_the_longest_move_that_only_jerk_bounds(a, j, start):
    """2 a^3/j^2 from rest to rest takes 4 a/j: there the phase of constant acceleration has just no length."""
    d = 2 * a**3 / j**2
    for by in (d, -d):
        plan = move(start + by, 2.0 * a * a / j, a, j, state=(start, 0.0, 0.0))
        assert plan.duration == pytest.approx(4 * a / j, rel=1e-5)


def test_faster_is_not_possible():
    """A timed move in the closed shortest time is accepted, 0.1 % less is refused."""
    shortest = 1.0 / 2.0 + 2.0 / 5.0 + 5.0 / 100.0
    rig = Rig([axis()])
    with pytest.raises(Exception, match="too short"):
        rig.write(mode=TIMED, position=1.0, time=shortest * 0.999)
    rig.write(mode=TIMED, position=1.0, time=shortest * (1 + 1e-9))
    assert rig.run() == pytest.approx(shortest, abs=1.1e-3)


def test_limits_and_jerk_hold_along_the_sampled_set_points():
    rig = Rig([axis()])
    rig.write(mode=MODE.POSITION, position=2.5)
    rig.run()
    p = rig.trace("commanded_position")
    h = 1e-3
    for order, limit in ((1, 2.0), (2, 5.0), (3, 100.0)):
        rate = np.diff(p, order) / h**order  # an n-th difference is a mean of the n-th derivative
        assert np.abs(rate).max() <= limit * (1 + 1e-5)
        assert np.abs(rate).max() > 0.99 * limit
    assert p.max() <= 2.5 + 1e-12


def test_work_of_the_set_point_is_zero_from_rest_to_rest():
    """The integral of a v dt is the change of v^2 / 2: nothing is lost between segments."""
    rig = Rig([axis()], tick_ns=100_000)
    rig.write(mode=MODE.POSITION, position=1.5)
    rig.run()
    v = rig.trace("commanded_velocity")
    assert v.max() == pytest.approx(2.0, rel=1e-9)
    # velocity is the derivative of position: its integral is the distance
    assert 1e-4 * v.sum() == pytest.approx(1.5, abs=1e-7)


def test_thousand_pieces_of_a_third_of_a_tick_do_not_drift():
    """Pieces of T = 1/3 ms against ticks of 1 ms: the end of the last is n T, to the tick."""
    rig = Rig([axis(position_min=None, position_max=None, acceleration_max=1e4, jerk_max=None)])
    n, piece = 3000, 0.001 / 3
    t = piece * np.arange(1, n + 1)
    w = 2 * np.pi * 2.0
    passing = MODE.POSITION | MODE.VELOCITY | MODE.SPECIFIED_TIME
    rig.write(mode=[passing] * n, position=0.1 * (1 - np.cos(w * t)), velocity=0.1 * w * np.sin(w * t), time=piece)
    begin = rig.now_ns
    while not rig.bank.is_idle([0]) and rig.now_ns - begin < 2 * 10**9:
        rig.tick()
        s = (rig.now_ns - begin) * 1e-9
        if s < n * piece - 1e-3:
            assert rig.field("commanded_position") == pytest.approx(0.1 * (1 - math.cos(w * s)), abs=2e-8)
    assert rig.now_ns - begin == pytest.approx(n * piece * 1e9, abs=1.01e6)


def test_passes_of_a_sampled_curve_keep_its_acceleration():
    """Pieces of 20 ms of a sine without commanded acceleration follow its true one: -w^2 times the position."""
    rig = Rig([axis(position_min=None, position_max=None)])
    n, piece, w, amplitude = 100, 0.02, 3.0, 0.2
    t = piece * np.arange(1, n + 1)
    passing = MODE.POSITION | MODE.VELOCITY | MODE.SPECIFIED_TIME
    rig.write(
        mode=[passing] * n,
        position=amplitude * (t - np.sin(w * t) / w),
        velocity=amplitude * (1 - np.cos(w * t)),
        time=piece,
    )
    rig.tick(1900)
    p = rig.trace("commanded_position")[1:]
    s = 1e-3 * np.arange(1, len(p) + 1)
    acceleration = np.diff(p, 2) / 1e-6
    true = amplitude * w * np.sin(w * s[1:-1])
    assert np.abs(acceleration - true)[50:-50].max() < 0.02 * amplitude * w
    assert np.abs(p - amplitude * (s - np.sin(w * s) / w)).max() < 1e-7


def test_servo_on_a_mass_follows_and_settles_without_overshoot():
    """Mass m under the law with k and kb: m x'' = k (r - x) + kb x' is a damped oscillator; at critical
    damping (kb^2 = 4 k m) a smooth profile is followed and the end is reached from one side."""
    m, k = 2.0, 800.0
    kb = -2 * math.sqrt(k * m)
    state = {"v": 0.0}

    def plant(output, dt):
        x = rig.raw
        for _ in range(10):
            state["v"] += output[0] / m * dt / 10
            x = x + state["v"] * dt / 10
        return x

    rig = Rig([axis(k=k, kb=kb, force_max=200.0)])
    rig.plant = plant
    rig.write(mode=MODE.POSITION, position=0.5)
    rig.run()
    rig.tick(600)
    x = rig.trace("position")
    assert x[-1] == pytest.approx(0.5, abs=1e-5)
    assert x.max() < 0.5 + 1e-4
    # a constant velocity v is followed |kb| v / k behind
    rig.write(mode=MODE.VELOCITY, velocity=0.2)
    rig.tick(1500)
    assert rig.field("following_error") == pytest.approx(-kb * 0.2 / k, rel=2e-2)


def test_force_on_a_free_mass_gives_its_acceleration():
    m, state = 2.0, {"v": 0.0}

    def plant(output, dt):
        state["v"] += output[0] / m * dt
        return rig.raw + state["v"] * dt

    rig = Rig([axis()])
    rig.plant = plant
    rig.write(mode=MODE.FORCE | MODE.SPECIFIED_TIME, force=1.5, time=1.0)
    rig.tick(1000)
    assert state["v"] == pytest.approx(1.5 / m * 1.0, rel=2e-3)
