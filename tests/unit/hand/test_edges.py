"""The detector of faces and vertices, on rolls made by the rolling formula; its noise is that of the finger."""

from __future__ import annotations

import math

import numpy as np
import pytest

from sioms.hand.edges import Edge, EdgeDetector
from sioms.hand.rolling import place_rate

DEG = math.pi / 180
DEVIATION = 0.1 * DEG


def rolled(radii_m: list[float], turn: float, spin: float, sign: float) -> tuple[list[Edge], int]:
    """Roll over arcs of these radii by `turn` each; return what is said at each frame, and frames an arc."""
    random, detector = np.random.default_rng(1), EdgeDetector()
    step = 0.0125 * DEG  # 5 degrees a second at 400 Hz
    count, link, place, told = round(turn / step), 0.0, 80 * DEG, []
    for radius in radii_m:
        for _ in range(count):
            link += sign * step
            place += step * place_rate(sign, sign * spin, radius)
            told.append(detector.see(link, place + float(random.normal(0.0, DEVIATION)), math.nan))
    return told, count


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("spin", [0.0, -0.3])
def test_faces_and_vertices_are_told_within_a_few_degrees(sign: float, spin: float) -> None:
    told, count = rolled([math.inf, 0.0, math.inf], 15 * DEG, spin, sign)
    late = round(3 * DEG / (0.0125 * DEG))
    assert all(edge is Edge.FACE for edge in told[late : count + late // 3])
    assert all(edge is Edge.VERTEX for edge in told[count + late : 2 * count + late // 3])
    assert all(edge is Edge.FACE for edge in told[2 * count + late :])


def test_before_the_link_turns_the_radius_decides() -> None:
    assert EdgeDetector().see(0.0, 1.4, math.nan) is Edge.UNKNOWN
    assert EdgeDetector().see(0.0, 1.4, 2e-3) is Edge.VERTEX
    assert EdgeDetector().see(0.0, 1.4, 12e-3) is Edge.FACE


def test_a_link_that_stands_decides_nothing_new() -> None:
    told, _ = rolled([math.inf], 10 * DEG, 0.0, 1.0)
    detector = EdgeDetector()
    for i in range(800):
        detector.see(i * 0.0125 * DEG, -i * 0.0125 * DEG, math.nan)
    assert told[-1] is Edge.FACE
    assert {detector.see(800 * 0.0125 * DEG, -10 * DEG, math.nan) for _ in range(2000)} == {Edge.FACE}
