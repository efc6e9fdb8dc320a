"""Effects of springs, drives, drags and swinging loads, each by a fact that does not use its formula.

Every axis here is let go or pushed by a known force, without a controller.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import ellipk

from sioms.reconcile.effect import Array
from sioms.reconcile.model import AxisModel
from sioms.reconcile.simulate import Run, pack, released

DT, MASS = 1e-3, 2.0
AXIS = AxisModel(False, DT, MASS, 0.0, 1e-9, 0.01, 20.0, 0.3)
SPRING = AXIS.with_effect("spring", {"k": 800.0})


def moved(model: AxisModel, force: Array, x: float = 0.0, v: float = 0.0) -> Run:
    """Let an axis go from a place with a speed, under a force."""
    return released(pack(model), force, np.array([x, v, 0.0, 0.0, force[0], 0.0, 0.0]))


def crossings(x: Array) -> Array:
    """Times [s] at which a motion passes zero."""
    at = np.flatnonzero((x[1:] > 0.0) != (x[:-1] > 0.0))
    out: Array = DT * (at + x[at] / (x[at] - x[at + 1]))
    return out


def test_a_hardening_spring_swings_with_the_period_of_duffing() -> None:
    """T = 4 K(m) / sqrt(w^2 + e A^2), m = e A^2 / (2 (w^2 + e A^2)), of x'' + w^2 x + e x^3 = 0."""
    model, amplitude = SPRING.with_effect("hardening_spring", {"k3": 2e6}), 0.03
    w2, e = 800.0 / MASS, 2e6 / MASS
    stiff = w2 + e * amplitude**2
    period = 4.0 * float(ellipk(e * amplitude**2 / (2.0 * stiff))) / np.sqrt(stiff)
    x = moved(model, np.zeros(3000), amplitude).position
    assert 2.0 * np.mean(np.diff(crossings(x))) == pytest.approx(period, rel=2e-3)
    assert period < 0.7 * 2.0 * np.pi / np.sqrt(w2)


def test_an_asymmetric_spring_swings_longer_on_its_soft_side() -> None:
    x = moved(SPRING.with_effect("asymmetric_spring", {"d": 300.0}), np.zeros(3000), 0.02).position
    sides = np.diff(crossings(x))
    for side, stiffness in ((sides[0::2], 500.0), (sides[1::2], 1100.0)):  # below zero first
        assert np.mean(side) == pytest.approx(np.pi * np.sqrt(MASS / stiffness), rel=5e-3)


def test_nothing_comes_of_a_force_within_the_dead_band() -> None:
    model = AXIS.with_effect("dead_band", {"w": 3.0})
    assert np.ptp(moved(model, np.full(500, 2.9)).position) < 1e-12
    assert moved(model, np.full(500, 7.0)).v[-1] == pytest.approx(4.0 / MASS * 0.499, rel=5e-3)
    assert moved(model, np.full(500, -7.0)).v[-1] == pytest.approx(-4.0 / MASS * 0.499, rel=5e-3)


def test_a_drive_that_is_stronger_one_way_leaves_a_speed_behind() -> None:
    push = np.concatenate([np.full(200, 5.0), np.full(200, -5.0), np.zeros(100)])
    run = moved(AXIS.with_effect("gain_asymmetry", {"d": 0.1}), push)
    assert run.v[-1] == pytest.approx(5.0 * 0.2 * 0.2 / MASS, rel=5e-3)  # (1.1 - 0.9) of the momentum
    assert abs(moved(AXIS, push).v[-1]) < 1e-9


def test_a_drive_of_a_limited_rate_lacks_the_impulse_of_its_ramps() -> None:
    """Up by 5 N at 100 N/s takes 50 ms and half the impulse of these; down it has that more."""
    push = np.concatenate([np.zeros(10), np.full(200, 5.0), np.zeros(100)])
    run = moved(AXIS.with_effect("slew_limit", {"rate": 100.0}), push)
    assert run.v[209] == pytest.approx((5.0 * 0.199 - 0.5 * 5.0 * 0.05) / MASS, rel=1e-6)
    assert run.v[-1] == pytest.approx(5.0 * 0.2 / MASS, rel=1e-6)


def test_a_motor_on_a_weak_supply_runs_up_to_its_speed_without_load() -> None:
    """m dv/dt = F0 (1 - v/v0): an exponential, whatever is commanded beyond; slowing down it has the whole force."""
    model = AXIS.with_effect("supply_limit", {"F0": 5.0, "v0": 0.2})
    t, run = DT * np.arange(1000), moved(model, np.full(1000, 50.0))
    np.testing.assert_allclose(run.v, 0.2 * -np.expm1(-t * 5.0 / (0.2 * MASS)), atol=1e-5)
    slowed = moved(model, np.full(20, -5.0), v=0.1).v
    assert (slowed[-1] - slowed[0]) / (19 * DT) == pytest.approx(-5.0 / MASS, rel=1e-6)


@pytest.mark.parametrize("n", [0.5, 1.5, 2.5])
def test_a_coast_under_a_power_of_the_speed(n: float) -> None:
    """v^(1-n) = v0^(1-n) - (1-n) c t / m."""
    c, v0 = 3.0, 0.25
    run = moved(AXIS.with_effect("power_drag", {"c": c, "n": n}), np.zeros(200), v=v0)
    wanted = (v0 ** (1.0 - n) - (1.0 - n) * c * DT * 199 / MASS) ** (1.0 / (1.0 - n))
    assert run.v[-1] == pytest.approx(wanted, rel=2e-3)
    assert run.v[-1] < 0.97 * v0


def test_quadratic_drag_that_differs_by_direction_on_two_coasts() -> None:
    """1/v grows by c t / m: with the sum of the coefficients forward, with their difference backward."""
    model = AXIS.with_effect("quadratic_drag", {"c": 40.0}).with_effect("quadratic_direction", {"c": 15.0})
    for v0, c in ((0.25, 55.0), (-0.25, 25.0)):
        v = moved(model, np.zeros(400), v=v0).v
        assert 1.0 / abs(v[-1]) - 4.0 == pytest.approx(c * DT * 399 / MASS, rel=2e-3)


@pytest.mark.parametrize("force", [4.0, 8.0])
def test_friction_with_the_square_of_the_load(force: float) -> None:
    """Driving loses g u^2, braking gains it: the two accelerations differ by twice that."""
    model = AXIS.with_effect("load_square_friction", {"g": 0.02})
    driven, braked = (moved(model, np.full(50, f), v=0.3) for f in (force, -force))
    gained = (driven.v[-1] - driven.v[0]) + (braked.v[-1] - braked.v[0])
    assert -gained * MASS / (2.0 * 49 * DT) == pytest.approx(0.02 * force**2, rel=5e-3)


def test_friction_that_warms_up_with_motion() -> None:
    """On a long way at one speed the loss comes up to its last value with the time constant."""
    heavy = replace(AXIS, inertia=1e4).with_effect("warming_friction", {"g": 10.0, "tau": 0.5})
    speed = moved(heavy, np.zeros(3000), v=0.2).v
    loss = -1e4 * np.gradient(speed, DT)
    assert loss[-200:].mean() == pytest.approx(10.0 * 0.2, rel=0.02)
    assert loss[490:510].mean() == pytest.approx(2.0 * (1.0 - np.exp(-1.0)), rel=0.02)


def test_a_swinging_load_goes_on_after_a_push_and_keeps_the_momentum() -> None:
    values = {"f_res": 1.0, "load_fraction": 0.3, "zeta": 0.0}
    push = np.concatenate([np.full(100, 5.0), np.zeros(3900)])
    v = moved(AXIS.with_effect("swinging_load", values), push).v[100:]
    mean = 5.0 * 0.1 / MASS
    assert v[:3000].mean() == pytest.approx(mean, rel=0.01)  # over three whole periods
    passing = np.flatnonzero((v[1:] > mean) != (v[:-1] > mean)) * DT
    assert np.mean(np.diff(passing)) == pytest.approx(0.5, rel=0.01)
    assert np.ptp(v) > 0.3 * mean


def test_a_law_of_place_is_the_straight_line_through_its_values() -> None:
    """A force from a law over nine places, against scipy's interpolation; a constant is none of it."""
    from sioms.reconcile.effects import known

    law = known()["term_law_of_place"]
    values = {p.symbol: 1.0 + i for i, p in enumerate(law.parameters)} | {"middle": 0.05, "step": 0.01}
    x = np.linspace(-0.1, 0.2, 200)
    nothing = np.zeros_like(x)
    found = law.evaluate(x, nothing, nothing, nothing, law.row(law.values(values), 0.01))
    wanted = np.interp(x, 0.05 + 0.01 * np.arange(-4, 5), [1.0, 2.0, 3.0, 4.0, 0.0, 5.0, 6.0, 7.0, 8.0])
    np.testing.assert_allclose(found, wanted, atol=1e-12)
