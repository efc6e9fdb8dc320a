"""What touches can know of polygons, against outlines whose parallel grasps are known by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest

from sioms.hand.experiments.certainty import Polygon, bound
from sioms.plant.outline import polygon, rectangle

MM = 1e-3


def kinds(outline: Polygon) -> dict[str, int]:
    """Return how many parallel grasps there are of each kind."""
    names = ["-".join(sorted(kind for kind, _ in pair)) for pair in outline.pairs]
    return {name: names.count(name) for name in set(names)}


def test_parallel_grasps_are_the_double_normals() -> None:
    """An acute triangle has three heights and three lengths of its sides, an obtuse one one of each; a slanted box has
    two pairs of sides and both diagonals.
    """
    triangle = Polygon(polygon([(0.0, 0.0), (60 * MM, 0.0), (25 * MM, 50 * MM)], 1 * MM))
    assert len(triangle) == 3 and kinds(triangle) == {"corner-side": 3, "corner-corner": 3}
    obtuse = Polygon(polygon([(0.0, 0.0), (60 * MM, 0.0), (30 * MM, 12 * MM)], 1 * MM))
    assert kinds(obtuse) == {"corner-side": 1, "corner-corner": 1}
    slanted = Polygon(polygon([(0.0, 0.0), (60 * MM, 0.0), (65 * MM, 40 * MM), (5 * MM, 40 * MM)], 1 * MM))
    assert kinds(slanted) == {"side-side": 2, "corner-corner": 2}


def test_fingers_meet_what_lies_on_their_line() -> None:
    bar = Polygon(rectangle(60 * MM, 40 * MM, 2 * MM))
    met = bar.close(np.array([5 * MM, 0.0]), 0.5 * math.pi)
    assert met is not None
    held, features = met
    assert {kind for kind, _ in features} == {"side"} and held.quality == pytest.approx(0.0, abs=1e-9)
    assert held.apart_m == pytest.approx(40 * MM) and held.contact1 == pytest.approx((5 * MM, -20 * MM))
    met = bar.close(np.array([31 * MM, 0.0]), 0.5 * math.pi)  # beside the sides, on two corners
    assert met is not None and {kind for kind, _ in met[1]} == {"corner"}
    assert met[0].quality == pytest.approx(math.asin(3.0 / (2.0 + 12.7)), rel=1e-6)
    assert bar.close(np.array([60 * MM, 0.0]), 0.5 * math.pi) is None


def test_a_pair_is_known_by_both_features_or_inferred_from_neighbours() -> None:
    triangle = Polygon(polygon([(0.0, 0.0), (60 * MM, 0.0), (25 * MM, 50 * MM)], 1 * MM))
    pair = next(pair for pair in triangle.pairs if pair[0] == ("side", 0))
    assert triangle.knows(pair, False) and not triangle.knows(pair[:1], False)
    sides = [("side", i) for i in range(3)]
    assert triangle.knows(sides, True) and not triangle.knows(sides, False)


def test_more_is_known_with_what_is_inferred_and_by_who_chooses() -> None:
    plain, more = bound(12, seed=3), bound(12, seed=3, inferred=True)
    assert plain.count == more.count > 8
    assert plain.touched <= plain.chosen and plain.best <= more.best
