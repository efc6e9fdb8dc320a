"""The friction rig: what is fitted is what the simulated rubber has, and sticking and slipping is told from sliding."""

from __future__ import annotations

import math

import numpy as np
import pytest

from sioms.hand.friction import RATE_HZ, TABLE, Drag, curvature_on_finger, drag, fit

MM = 1e-3


def test_indenters_of_a_flat_strip_are_objects_on_the_finger() -> None:
    found = [curvature_on_finger(radius) / MM for radius, _ in TABLE]
    assert found == pytest.approx([-12.7, math.inf, 3.11, 0.307], rel=2e-3)


@pytest.mark.parametrize(("radius_m", "wanted"), TABLE)
@pytest.mark.parametrize("weight_kg", [0.05, 0.5])
def test_the_coefficient_of_the_rubber_comes_back(radius_m: float, wanted: float, weight_kg: float) -> None:
    found = fit(*drag(radius_m, weight_kg, Drag(time_s=0.8), 3), 0.01)
    assert found.coefficient == pytest.approx(wanted, rel=0.02)
    assert found.sticks is math.isinf(radius_m)


def test_sticking_and_slipping_is_told_with_its_frequency() -> None:
    t = np.arange(1500) / RATE_HZ
    saw = 10.0 + 0.6 * (2.0 * ((20.0 * t) % 1.0) - 1.0)  # 20 Hz
    noise = np.random.default_rng(1).normal(0.0, 0.01, (2, t.size))
    force = np.minimum(saw, 400.0 * t) + noise[0]
    found = fit(force, 5.0 + noise[1], 0.01)
    assert found.sticks and found.cycle_hz == pytest.approx(20.0, abs=1.0)
    assert found.coefficient == pytest.approx(2.0, rel=0.01)
    even = fit(np.minimum(10.0, 400.0 * t) + noise[0], 5.0 + noise[1], 0.01)
    assert not even.sticks and math.isnan(even.cycle_hz)


def test_a_run_that_only_sticks_is_refused() -> None:
    t = np.arange(1000) / RATE_HZ
    with pytest.raises(ValueError, match="want a run that slides"):
        fit(10.0 * t, np.full(t.size, 5.0), 0.01)
