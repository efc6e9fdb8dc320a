"""Outlines: their area, inertia and widths are those of the shapes; what is not convex is refused."""

from __future__ import annotations

import math

import numpy as np
import pytest

from sioms.plant.outline import Outline, disk, ellipse, polygon, rectangle, spline


def test_area_and_gyration_are_those_of_the_shapes() -> None:
    assert disk(0.02).area == pytest.approx(math.pi * 4e-4, rel=2e-4)
    assert disk(0.02).gyration_m == pytest.approx(0.02 / math.sqrt(2), rel=1e-4)
    assert rectangle(0.03, 0.04).area == pytest.approx(1.2e-3, rel=1e-12)
    assert rectangle(0.03, 0.04).gyration_m == pytest.approx(0.05 / math.sqrt(12), rel=1e-12)
    assert ellipse(0.03, 0.02).area == pytest.approx(math.pi * 6e-4, rel=2e-4)
    assert rectangle(0.03, 0.04, 0.002).area == pytest.approx(1.2e-3 - (4 - math.pi) * 4e-6, rel=1e-5)


def test_any_convex_outline_lies_about_its_centroid() -> None:
    for outline in (polygon([(0, 0), (0.05, 0), (0.01, 0.04)]), spline([(0, 0), (0.03, 0.0), (0.04, 0.03), (0, 0.02)])):
        p, q = outline.points, np.roll(outline.points, -1, axis=0)
        cross = p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]
        assert (p + q).T @ cross == pytest.approx([0.0, 0.0], abs=1e-12)


def test_a_spline_through_points_of_a_circle_is_nearly_one() -> None:
    angle = math.tau * np.arange(12) / 12
    outline = spline(0.02 * np.stack([np.cos(angle), np.sin(angle)], axis=1))
    assert outline.width(0.3) == pytest.approx(0.04, rel=1e-3)
    assert outline.reach_m == pytest.approx(0.02, rel=1e-3)


def test_nearest_point_is_on_the_line_through_the_centre_of_a_disk() -> None:
    assert disk(0.02, 1e-9).nearest((0.1, 0.2, 1.0), 0.1, 0.3) == pytest.approx((0.1, 0.22), abs=2e-5)
    assert rectangle(0.02, 0.04).nearest((0, 0, math.pi / 2), 0.05, 0.005) == pytest.approx((0.02, 0.005))


@pytest.mark.parametrize(
    ("points", "wrong"),
    [
        ([(0, 0), (1, 0)], "three or more"),
        ([(0, 0), (0, 1), (1, 0)], "anti-clockwise"),
        ([(0, 0), (2, 0), (2, 2), (1, 0.5), (0, 2)], "not convex at"),
        ([(0, 0), (1, 0), (1, 0), (0, 1)], "coincide"),
        ([(0, 0), (1, math.nan), (0, 1)], "finite"),
        ([(math.cos(2.4 * i), math.sin(2.4 * i)) for i in range(5)], "not convex"),
    ],
)
def test_what_is_no_convex_outline_is_refused(points: list[tuple[float, float]], wrong: str) -> None:
    with pytest.raises(ValueError, match=wrong):
        Outline(np.array(points, dtype=float))


def test_sizes_and_corners_that_cannot_be_are_refused() -> None:
    with pytest.raises(ValueError, match="half_x_m"):
        disk(0.0)
    with pytest.raises(ValueError, match="nothing of a side"):
        rectangle(0.02, 0.04, 0.010)
    with pytest.raises(ValueError, match="larger tolerance"):
        disk(0.02, 1e-18)
    with pytest.raises(ValueError, match="not convex"):
        spline([(0, 0), (0.04, 0), (0.05, 0.04), (0.02, 0.01), (0, 0.04)])
