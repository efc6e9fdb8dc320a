"""What touches all round an object let expect."""

from __future__ import annotations

import math

import numpy as np
import pytest

from sioms.hand.around import Around, met, sides_through
from sioms.hand.experiments.planning import feel_round
from sioms.hand.seeking import Seeking
from sioms.hand.shape import Parallel, Touch
from sioms.hand.trials import FAMILIES, draw

DEG, MM = math.pi / 180, 1e-3


def touch(x_mm: float, y_mm: float, normal_deg: float) -> Touch:
    return Touch((x_mm * MM, y_mm * MM), normal_deg * DEG, math.inf, math.inf)


def rounded_square(half_mm: float, radius_mm: float) -> list[Touch]:
    """Return two touches of a corner and one of each side."""
    inner = half_mm - radius_mm
    corner = [
        touch(inner + radius_mm * math.cos(a * DEG), inner + radius_mm * math.sin(a * DEG), a) for a in (25.0, 65.0)
    ]
    sides = [(half_mm, 3.0, 0.0), (-2.0, half_mm, 90.0), (-half_mm, 1.0, 180.0), (4.0, -half_mm, 270.0)]
    return [*corner, *(touch(*one) for one in sides)]


def test_two_touches_of_a_corner_tell_its_radius_and_all_touches_the_sides() -> None:
    sides = sides_through(rounded_square(20.0, 2.0))
    assert sides.corner_m == pytest.approx(2 * MM, abs=1e-6)
    far = np.abs(sides.corners).max(axis=1)
    assert far == pytest.approx(np.full(len(far), 18 * MM), abs=1e-6)
    assert all(sides.owners)


def test_a_side_and_what_faces_it_are_held_across_the_side() -> None:
    around = Around()
    for one in rounded_square(20.0, 2.0):
        around.add([one], 0.0, 0.0, one.normal)
    found = around.next(10 * DEG)
    assert found is not None and not around.smooth
    assert math.remainder(found.direction, 0.5 * math.pi) == pytest.approx(0.0, abs=0.01 * DEG)
    assert found.apart_m == pytest.approx(40 * MM, abs=0.01 * MM)


def test_a_finger_meets_sides_and_corners_where_it_comes_along_a_line() -> None:
    square = np.array([(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)]) * 10 * MM
    assert met(square, 5 * MM, np.array([0.0, 3 * MM]), 0.0) == pytest.approx(0.0)
    beside = met(square, 5 * MM, np.array([0.0, 13 * MM]), 0.0)  # 3 of 5 mm beside the corner
    assert beside == pytest.approx(math.asin(0.6))
    assert met(square, 5 * MM, np.array([0.0, 16 * MM]), 0.0) is None


def test_an_older_touch_that_no_convex_object_has_beside_a_newer_one_is_forgotten() -> None:
    around = Around()
    around.add([touch(20.0, 0.0, 0.0)], 0.0, 0.0, 0.0)
    around.add([touch(19.9, 5.0, 0.0), touch(-20.0, 0.0, 180.0)], 0.0, 0.0, 0.0)
    assert around.size_m == pytest.approx(math.hypot(39.9, 5.0) * MM, rel=0.01)  # 0.1 mm: noise
    around.add([touch(15.0, 5.0, 0.0)], 0.0, 0.0, 0.0)
    assert around.size_m == pytest.approx(math.hypot(35.0, 5.0) * MM)


def test_lines_to_be_touched_next_are_met_by_both_fingers() -> None:
    for number in range(12):
        assert math.isfinite(feel_round(draw(number, 41, FAMILIES), 3)[0])


@pytest.mark.parametrize("family", ["polygon", "hull", "spline"])
def test_feeling_round_finds_a_parallel_grasp_of_what_two_touches_do_not_tell(family: str) -> None:
    found = [feel_round(draw(number, 42, [family]), 14) for number in range(12)]
    within = sum(eta <= 1.0 * DEG for eta, _ in found)
    assert within >= 11, [round(eta / DEG, 2) for eta, _ in found]


def test_how_far_touches_are_from_the_ends_of_their_sides() -> None:
    around = Around()
    around.add(rounded_square(20.0, 2.0), 0.0, 0.0, 0.0)
    low, high = touch(20.0, -17.0, 0.0), touch(-20.0, 15.0, 180.0)
    around.add([low], 0.0, 0.0, 0.0)
    around.add([high], 0.0, 0.0, 0.0)
    assert around.spare([low]).room_m == pytest.approx(1 * MM, abs=1e-6)  # of the straight part, up to 18 mm
    assert around.spare([high]).room_m == pytest.approx(3 * MM, abs=1e-6)
    assert around.spare([low, high]) == (pytest.approx(1 * MM, abs=1e-6), None) and around.spare([]).room_m == math.inf


def test_a_side_is_known_no_farther_than_it_was_touched() -> None:
    """Nobody has met what ends the right side above: it was believed to go on as far as anything might."""
    around = Around()
    first, low, second = touch(20.0, 4.0, 0.0), touch(20.0, -6.0, 0.0), touch(-20.0, 0.0, 180.0)
    below = touch(3.0, -20.0, -90.0)
    around.add([first, second, low, below], 0.0, 0.0, 0.0)
    assert around.spare([first]) == (pytest.approx(0.0), pytest.approx((0.0, 1.0)))
    around.add([touch(20.0, 9.0, 0.0)], 0.0, 0.0, 0.0)
    assert around.spare([first]).room_m == pytest.approx(5 * MM)


def test_a_grasp_at_what_may_be_an_end_is_felt_farther_along_first() -> None:
    for corner, done in ((18.0, True), (1.0, False)):  # the right side goes on, or ends a millimetre above
        around = Around()
        around.add([touch(0.0, -20.0, -90.0), touch(20.0, -15.0, 0.0)], 0.0, -15.0, 0.0)
        seeking, one = Seeking(around), Parallel(0.0, 0.0, 0.0, 40 * MM, 0.0)
        pair = [touch(-20.0, 0.0, 180.0), touch(20.0, 0.0, 0.0)]
        around.add([touch(-20.0, 15.0, 180.0), touch(-20.0, -15.0, 180.0)], 0.0, 0.0, 0.0)
        around.add(pair, 0.0, 0.0, 0.0)
        assert not seeking.is_done(pair, one)
        beyond = seeking.next(0.0)
        assert beyond is not None and (beyond.x, beyond.y) == pytest.approx((0.0, 1.7 * MM), abs=1e-6)
        normal = 0.0 if corner > 1.7 else 45.0
        further = [touch(-20.0, 1.7, 180.0), touch(20.0 if corner > 1.7 else 19.8, 1.7, normal)]
        around.add(further, 0.0, beyond.y, 0.0)
        assert seeking.is_done(further, beyond) is done


@pytest.mark.parametrize("half_mm", [-10.0, 0.1, 0.6], ids=["moved by the first touch", "a foil", "a sheet"])
def test_touches_that_leave_nothing_between_them_are_no_error(half_mm: float) -> None:
    around = Around()
    for x_mm in (-5.0, 0.0, 5.0):
        around.add([touch(x_mm, half_mm, 90.0), touch(x_mm, -half_mm, -90.0)], 1e-3 * x_mm, 0.0, 0.5 * math.pi)
        assert around.next(0.5 * math.pi) is None or around.size_m < 0.05
