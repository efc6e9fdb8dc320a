"""What touches tell of an outline: ellipses, triangles and rectangles, whose parallel grasps are known by geometry."""

from __future__ import annotations

import math

import numpy as np
import pytest

from sioms.hand.contacts import Grasp, grasp_of
from sioms.hand.shape import Shape, Touch, across_sides, expected, fitted_oval, with_corners

A, B = 0.035, 0.022
FINGER = 12.7e-3


def on_ellipse(normal: float, radius_deviation_m: float = 1e-3) -> Touch:
    """Touch an ellipse with axes along x and y where its outward normal is this [rad]."""
    c, s = math.cos(normal), math.sin(normal)
    h = math.hypot(A * c, B * s)
    return Touch((A * A * c / h, B * B * s / h), normal, A * A * B * B / h**3, radius_deviation_m)


def held(one: Touch, two: Touch) -> Grasp:
    """Return the grasp by two fingers that touch there."""
    centres = [
        (touch.point[0] + FINGER * math.cos(touch.normal), touch.point[1] + FINGER * math.sin(touch.normal))
        for touch in (one, two)
    ]
    return grasp_of(centres[0], centres[1], one.normal + math.pi, two.normal + math.pi)


@pytest.mark.parametrize("turn", [0.0, 0.7, 2.0])
@pytest.mark.parametrize("at", [20.0, 40.0, 70.0])
def test_four_touches_of_an_ellipse_tell_an_axis(turn: float, at: float) -> None:
    angles = [math.radians(one) for one in (at, at + 170.0, 0.5 * at, 0.5 * at + 184.0)]
    touches = []
    for one in map(on_ellipse, angles):
        x, y = one.point
        c, s = math.cos(turn), math.sin(turn)
        touches.append(Touch((c * x - s * y + 0.1, s * x + c * y), one.normal + turn, one.radius_m, 1e-3))
    found = min(Shape(touches).parallels(turn + angles[2]), key=lambda one: one.deviation)
    nearest = 0.5 * math.pi * round((found.direction - turn) / (0.5 * math.pi))
    wrong = found.direction - turn - nearest
    size = B if round(nearest / (0.5 * math.pi)) % 2 else A
    # its friction angle there, from the ellipse itself: eta = w'/w of w = 2 sqrt(a^2 cos^2 + b^2 sin^2)
    assert abs((A**2 - B**2) * math.sin(wrong) / size**2) < 2.0 * found.deviation < math.radians(6.0)
    assert found.apart_m == pytest.approx(2.0 * size, abs=0.5e-3)
    assert (found.x, found.y) == pytest.approx((0.1, 0.0), abs=0.5e-3)


def test_what_is_expected_has_its_uncertainty() -> None:
    far = [on_ellipse(math.radians(one)) for one in (40.0, 215.0)]
    near = [on_ellipse(math.radians(one)) for one in (88.0, 271.0)]
    one, two = (
        min(Shape(known).parallels(0.5 * math.pi), key=lambda p: abs(p.direction - 0.5 * math.pi))
        for known in (far, far + near)
    )
    assert two.deviation < 0.3 * one.deviation
    assert abs(two.direction - 0.5 * math.pi) < math.radians(1.0)


def sides(points: np.ndarray, shares: list[float]) -> list[Touch]:
    """Touch the sides of a polygon, anti-clockwise, each at a share of its length."""
    touched = []
    for point, after, share in zip(points, np.roll(points, -1, axis=0), shares, strict=True):
        way = after - point
        x, y = point + share * way
        touched.append(Touch((float(x), float(y)), math.atan2(-way[0], way[1]), 10.0, 1.0))
    return touched


def test_a_triangle_is_held_across_a_height() -> None:
    points = np.array([[0.0, 0.0], [0.05, 0.0], [0.02, 0.04]])
    sharp = Touch((0.05, 0.0), 0.0, 1e-6, 1e-6)
    found = across_sides([*sides(points, [0.3, 0.5, 0.6]), sharp], math.radians(-90.0))[0]
    assert math.remainder(found.direction + 0.5 * math.pi, math.pi) == pytest.approx(0.0, abs=1e-9)
    assert (found.x, found.y) == pytest.approx((0.02, 0.02), abs=1e-5)
    assert found.apart_m == pytest.approx(0.04, abs=1e-5)


def test_a_corner_that_nobody_has_touched_is_not_relied_on() -> None:
    points = np.array([[0.0, 0.0], [0.05, 0.0], [0.02, 0.04]])
    assert across_sides(sides(points, [0.3, 0.5, 0.6])[:2], 0.0) == []


def test_parallel_sides_are_held_in_the_middle_of_where_they_were_touched() -> None:
    one = Touch((0.0, 0.01), math.pi, 10.0, 1.0)
    two = Touch((0.03, -0.02), math.radians(0.2), 10.0, 1.0)
    found = expected([one, two], held(one, two))[0]
    assert (found.x, found.y) == pytest.approx((0.015, -0.005))
    assert math.remainder(found.direction, math.tau) == pytest.approx(math.radians(0.1))
    assert found.apart_m == pytest.approx(0.03, abs=1e-4)


def test_a_side_and_a_corner_are_held_along_the_normal_of_the_side() -> None:
    side, corner = Touch((0.0, 0.01), math.pi, 10.0, 1.0), Touch((0.03, -0.005), math.radians(10.0), 1e-3, 1e-3)
    found = expected([side, corner], held(side, corner))[0]
    assert found.direction == pytest.approx(0.0, abs=math.radians(0.2))
    assert found.y == pytest.approx(corner.point[1] - 1e-3 * math.sin(corner.normal), abs=1e-4)


def test_two_sides_that_form_a_wedge_are_touched_next_towards_its_thick_end() -> None:
    tilt = math.radians(10.0)  # x from 0 on the left, and 0.03 + y tan(10 degrees) on the right
    left, right = Touch((0.0, 0.0), math.pi, 10.0, 1.0), Touch((0.03, 0.0), -tilt, 10.0, 1.0)
    found = expected([left, right], held(left, right))[0]
    assert found.y > 0.005


def on_corner(centre: tuple[float, float], radius: float, normal: float, felt: float) -> Touch:
    """Touch a rounded corner, that is felt with another radius than it has."""
    point = centre[0] + radius * math.cos(normal), centre[1] + radius * math.sin(normal)
    return Touch(point, normal, felt, 1e-3)


def test_two_touches_of_a_corner_tell_its_radius() -> None:
    centre, radius = (0.03, 0.004), 2.5e-3
    touches = [on_corner(centre, radius, math.radians(at), felt) for at, felt in ((10.0, 0.8e-3), (50.0, 6e-3))]
    assert [touch.radius_m for touch in with_corners(touches)] == pytest.approx([radius, radius])
    side = Touch((0.0, 0.0), math.pi, 10.0, 1.0)
    apart = Touch((-0.02, 0.02), math.radians(100.0), 2e-3, 1e-3)  # another corner
    assert with_corners([side, apart, touches[0]]) == [side, apart, touches[0]]


def test_a_side_and_a_corner_that_has_been_touched_twice() -> None:
    centre, radius = (0.03, 0.004), 3e-3
    side = Touch((0.0, 0.01), math.pi, 0.9, 0.5)  # no side is felt quite straight
    first, second = (on_corner(centre, radius, math.radians(at), 1e-3) for at in (70.0, 20.0))
    found = expected([side, first, side, second], held(side, second))[0]
    assert found.direction == pytest.approx(0.0, abs=1e-4)
    assert (found.x, found.y) == pytest.approx((0.0165, 0.004), abs=1e-5) and found.apart_m == pytest.approx(
        0.033, abs=1e-5
    )


def test_sides_meet_in_the_middle_of_a_rounded_corner() -> None:
    sharp = np.array([[0.0, 0.0], [0.06, 0.0], [0.01, 0.04]])
    rounded = 2e-3
    corner = Touch((0.06, 0.0), 0.0, rounded, 1e-4)  # its radius counts, not its place
    found = across_sides([*sides(sharp, [0.3, 0.5, 0.6]), corner], math.radians(-90.0))[0]
    n1, n2 = (np.array([0.04, 0.05]) / math.hypot(0.04, 0.05), np.array([-0.04, 0.01]) / math.hypot(0.04, 0.01))
    # where the sides that meet opposite the first, each moved in by the radius, cross
    centre = np.linalg.solve(np.array([n1, n2]), np.array([n1 @ sharp[2], n2 @ sharp[2]]) - rounded)
    assert found.x == pytest.approx(centre[0], abs=1e-6)
    assert found.apart_m == pytest.approx(centre[1] + rounded, abs=1e-6)


@pytest.mark.parametrize("at", [25.0, 50.0, 80.0])
@pytest.mark.parametrize("turn", [0.0, 0.6, 2.1])
def test_two_touches_tell_an_ellipse(turn: float, at: float) -> None:
    touches = []
    for one in (on_ellipse(math.radians(at), 2e-4), on_ellipse(math.radians(at + 165.0), 2e-4)):
        (x, y), c, s = one.point, math.cos(turn), math.sin(turn)
        touches.append(Touch((c * x - s * y + 0.1, s * x + c * y - 0.05), one.normal + turn, one.radius_m, 2e-4))
    found = fitted_oval(touches)
    assert found is not None
    first, second = sorted(found.parallels(turn + 0.1), key=lambda one: -one.apart_m)
    assert (first.apart_m, second.apart_m) == pytest.approx((2 * A, 2 * B), rel=1e-4)
    assert (first.x, first.y) == pytest.approx((0.1, -0.05), abs=1e-6)
    assert math.sin(first.direction - turn) == pytest.approx(0.0, abs=1e-4)
    assert expected(touches, held(*touches))[0].deviation == 0.0


def test_what_is_no_ellipse_is_not_taken_for_one() -> None:
    # a quarter of a disk's width between two arcs of 40 mm: a lens
    lens = [Touch((0.0, 10e-3), 0.5 * math.pi, 40e-3, 4e-4), Touch((0.0, -10e-3), -0.5 * math.pi, 40e-3, 4e-4)]
    aside = Touch((8e-3, 3e-3), 0.2, 25e-3, 4e-4)
    assert fitted_oval([*lens, aside]) is None
    side = Touch((0.0, 10e-3), 0.5 * math.pi, 10.0, 1.0)
    assert fitted_oval([side, lens[1]]) is None


def test_where_sides_end_under_both_fingers_the_side_that_is_known_is_held() -> None:
    # a bar of 50 mm, its sides along y, touched once on a side at y = 30 mm, then at both of its ends
    side = Touch((25e-3, 30e-3), 0.0, 10.0, 1.0)
    ends = Touch((-25e-3, 2e-3), math.pi + 0.06, 12e-3, 1e-3), Touch((25e-3, 0.0), -0.06, 12e-3, 1e-3)
    (found,) = expected([Touch((-25e-3, 1e-3), math.pi, 3e-3, 1e-3), side, *ends], held(*ends))
    assert math.sin(found.direction) == pytest.approx(0.0, abs=1e-9)
    assert found.y == pytest.approx(15.5e-3, abs=1e-6) and found.apart_m == pytest.approx(50e-3)
