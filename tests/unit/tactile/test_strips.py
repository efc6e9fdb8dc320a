"""Strips in the layer are found by the ripple of touches over the place, and taken into account by the estimator."""

from __future__ import annotations

import math

import msgspec
import numpy as np
import pytest

from sioms.tactile import emap, series
from sioms.tactile.closedform import equivalent_radius
from sioms.tactile.cylinder import FINGER_B
from sioms.tactile.estimator import Estimator
from sioms.tactile.finger import Finger, from_toml, to_toml
from sioms.tactile.model import pressed
from sioms.tactile.strips import Strips, find_strips

STRIPS = Strips(math.radians(10.0), 0.06, 0.7, 0.08, -1.2)


@pytest.fixture
def striped(nominal: Finger) -> Finger:
    return msgspec.structs.replace(nominal, strips=STRIPS)


def test_estimates_are_those_of_the_touch_that_was_changed(nominal: Finger, striped: Finger) -> None:
    """Without the strips in the finger's file load and R are off by the ripple."""
    matrix = emap.e_map(FINGER_B, np.array(nominal.angles_rad), 10.3e-3, 100)[:, :201]
    knows, ignores = Estimator(striped), Estimator(nominal)
    off = []
    for degrees, load, rc in (
        (40.0, 200.0, 6e-3),
        (63.3, 120.0, 25e-3),
        (87.1, 300.0, 4e-3),
        (110.9, 150.0, np.inf),
    ):
        t, radius = math.radians(degrees), equivalent_radius(FINGER_B, rc)
        half = nominal.width_table().half_width(load * radius) * float(STRIPS.width_factor(t))
        spectrum = pressed(FINGER_B, 100)(half)
        strains = float(STRIPS.strain_factor(t)) * (matrix @ series.spread(FINGER_B, -load, spectrum, t))
        shape = knows.frame(strains)
        assert shape.load_n_per_m == pytest.approx(load, rel=2e-3)
        assert shape.equivalent_radius_m == pytest.approx(radius, rel=1e-2)
        assert math.degrees(shape.angle_rad) == pytest.approx(degrees, abs=0.01)
        off.append(ignores.frame(strains).load_n_per_m / load - 1.0)
    assert np.abs(off).max() > 0.03


def test_slopes_of_the_table_are_those_of_its_values(striped: Finger) -> None:
    nodes, b = striped.strain_table().nodes, striped.strain_table().half_widths ** 2
    largest = np.abs(nodes).max(axis=(0, 1, 3))
    for value, slope in ((0, 1), (2, 3)):
        f = nodes[:, :, value]
        found = (8.0 * (f[:, 3:-1] - f[:, 1:-3]) - (f[:, 4:] - f[:, :-4])) / 12.0
        assert np.abs(found - nodes[:, 2:-2, slope]).max() < 0.02 * largest[slope]
    f, rise = nodes[10:31, :, 0], nodes[10:31, :, 2]
    widths = np.diff(b[10:31])[:, None, None]
    assert np.abs(np.diff(f, axis=0) / widths - 0.5 * (rise[1:] + rise[:-1])).max() < 0.01 * largest[2]


def test_strips_come_back_from_the_file(striped: Finger) -> None:
    assert from_toml(to_toml(striped)).strips == STRIPS
    with pytest.raises(ValueError, match=r"period_rad is 0\.0; need a positive, finite angle"):
        from_toml(to_toml(striped).replace(f"period_rad = {STRIPS.period_rad!r}", "period_rad = 0.0"))


def test_ripple_is_found_under_scattered_loads_and_none_where_there_is_none() -> None:
    random = np.random.default_rng(9)
    place = np.radians(np.concatenate([np.arange(0.0, 148.0), np.arange(10.0, 140.0, 3.3)]))
    elements = np.radians(143.0 - 9.22 * np.arange(16))
    away = place[:, None] - elements
    model, widening = (
        np.exp(-((away / 0.12) ** 2)),
        np.where(np.abs(away) < 0.1, -0.3, 0.1) * np.exp(-((away / 0.2) ** 2)),
    )
    widening[:148] = 0.0  # edges
    load = 1.0 + 0.015 * random.normal(size=place.size)
    noise = 0.004 * random.normal(size=model.shape)
    even = load[:, None] * model + noise
    assert find_strips(even - model, model, widening, place) is None
    few = place < np.radians(70.0)  # as few as these explain a fifth of their scatter by some sine
    assert find_strips((even - model)[few], model[few], widening[few], place[few]) is None
    change = (STRIPS.strain_factor(place) - 1.0)[:, None] * model
    change = change + (STRIPS.width_factor(place) - 1.0)[:, None] * widening
    found = find_strips(even + change - model, model, widening, place)
    assert found is not None
    assert found.period_rad == pytest.approx(STRIPS.period_rad, rel=2e-3)
    assert found.gain == pytest.approx(STRIPS.gain, abs=0.005) and found.width == pytest.approx(STRIPS.width, abs=0.02)
    assert found.strain_factor(place) == pytest.approx(STRIPS.strain_factor(place), abs=0.01)
    assert found.width_factor(place) == pytest.approx(STRIPS.width_factor(place), abs=0.03)
    assert find_strips(even[:8] - model[:8], model[:8], widening[:8], place[:8]) is None
