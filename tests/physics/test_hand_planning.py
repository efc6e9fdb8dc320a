"""What the plans of regrasps come to on objects that stay where they are; no world moves."""

from __future__ import annotations

import math

from sioms.hand.experiments.planning import Planned, plan_regrasps
from sioms.hand.trials import SHAPES, WITHIN_RAD, draw

SEED = 77


def planned(shape: str, count: int) -> list[Planned]:
    first = SHAPES.index(shape)
    return [plan_regrasps(draw(number, SEED)) for number in range(first, first + 5 * count, 5)]


def test_disks_and_rectangles_are_parallel_after_two_regrasps() -> None:
    for shape in ("disk", "rectangle"):
        found = planned(shape, 10)
        assert sum(one.etas[-1] <= WITHIN_RAD for one in found) >= 9


def test_polygons_are_parallel_after_two_regrasps_or_would_be_rolled_two_times_in_five() -> None:
    found = planned("polygon", 30)
    assert sum(one.etas[-1] <= WITHIN_RAD or one.rolls for one in found) >= 12


def test_the_same_noise_makes_the_same_plans() -> None:
    assert planned("spline", 1) == planned("spline", 1)
    assert all(math.isfinite(eta) for eta in planned("spline", 1)[0].etas)
