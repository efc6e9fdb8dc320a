"""What touches left out of a calibration tell: deviations that cover their errors, and doubts where these are too
large.
"""

from __future__ import annotations

import math

import msgspec
import numpy as np
import pytest

from sioms.tactile import held_out
from sioms.tactile.estimator import Estimator
from sioms.tactile.finger import Finger, Systematic, from_toml, to_toml
from sioms.tactile.held_out import Estimates
from sioms.tactile.touches import Touches

STATED = np.array([1e-3, 0.01, 0.05])
OWN = np.array([2e-3, 0.03, 0.0])


def drawn(count: int, own: np.ndarray, seed: int = 1, edge: bool = False) -> Estimates:
    random = np.random.default_rng(seed)
    error = np.hypot(STATED, own) * random.normal(size=(count, 3))
    none = np.zeros(count, dtype=np.bool_)
    return Estimates(error, np.tile(STATED, (count, 1)), none, none | edge)


def test_the_deviations_found_cover_the_errors() -> None:
    beside = held_out.systematic(drawn(2000, OWN))
    assert (beside.place_rad, beside.load) == pytest.approx(OWN[:2], rel=0.1)
    assert beside.radius < 0.02
    assert not held_out.doubts(drawn(2000, OWN), beside)


def test_many_edges_do_not_hide_what_the_others_show() -> None:
    edges, rounds = drawn(1000, np.zeros(3), edge=True), drawn(60, OWN, 2)
    beside = held_out.systematic(held_out.joined([edges, rounds]))
    assert beside.load == pytest.approx(0.03, rel=0.4)


def test_few_errors_and_doubtful_ones_tell_nothing() -> None:
    few = drawn(held_out.FEWEST - 1, 100.0 * OWN)
    assert held_out.systematic(few) == Systematic()
    silent = drawn(50, OWN)
    silent.error[:] = np.nan
    assert held_out.systematic(silent) == Systematic()


@pytest.mark.parametrize(
    "own, words",
    [
        ([0.02, 0.0, 0.0], "tells the places of touches left out of it no better than to 1"),
        ([0.0, 0.08, 0.0], "tells the loads of touches left out of it no better than to"),
        ([0.0, 0.0, 0.5], "tells the R of touches left out of it"),
    ],
)
def test_a_finger_that_does_not_find_them_is_doubted(own: list[float], words: str) -> None:
    found = drawn(3000, np.array(own))
    (doubt,) = held_out.doubts(found, held_out.systematic(found))
    assert words in doubt
    found.doubtful[::2] = True
    assert "50 % of the touches left out of it are doubtful" in held_out.doubts(found, Systematic())[0]


def test_estimates_are_those_of_heavy_touches_inside(nominal: Finger, touch) -> None:  # type: ignore[no-untyped-def]
    """Errors and stated deviations relative to the truth; an edge has no R, a light touch and one outside do not
    count.
    """
    places = np.radians([60.0, 75.3, 90.0, 100.0, 2.0])
    loads, radii = np.array([200.0, 150.0, 50.0, 200.0, 200.0]), np.array([6e-3, 12e-3, 6e-3, 0.0, 6e-3])
    strains = np.array([touch(*one) for one in zip(places, loads, radii, strict=True)])
    recorded = Touches(-strains, places, loads, radii, loads, np.full(16, 1e-3))
    found = held_out.estimates(nominal, recorded, loads * np.array([1.0, 1.1, 1.0, 1.0, 1.0]))
    assert found.edge.tolist() == [False, False, True] and not found.doubtful.any()
    assert np.abs(found.error[:, 0]).max() < 1e-3
    assert found.error[0, 1] == pytest.approx(0.0, abs=5e-3)
    assert found.error[1, 1] == pytest.approx(1.0 / 1.1 - 1.0, abs=5e-3)
    assert np.isfinite(found.error[:2, 2]).all() and np.isnan(found.error[2, 2])


def test_what_a_finger_carries_is_in_its_estimates(nominal: Finger, touch) -> None:  # type: ignore[no-untyped-def]
    finger = msgspec.structs.replace(nominal, systematic=Systematic(2e-3, 0.03, 0.1))
    assert from_toml(to_toml(finger)).systematic == finger.systematic
    strains = touch(math.radians(75.0), 200.0, 6e-3)
    plain, carrying = (Estimator(f).frame(strains) for f in (nominal, finger))
    assert carrying.angle_rad == plain.angle_rad and carrying.load_n_per_m == plain.load_n_per_m
    added = np.sqrt(np.array(carrying.deviations) ** 2 - np.array(plain.deviations) ** 2)
    assert added == pytest.approx([2e-3, 0.03 * plain.load_n_per_m, 0.1 * plain.equivalent_radius_m], rel=1e-6)
    with pytest.raises(ValueError, match=r"systematic load is -0\.1; need 0 or more"):
        msgspec.structs.replace(nominal, systematic=Systematic(load=-0.1))
