"""Fingers that yield: by the velocities of their centres, worked out here on their own."""

from __future__ import annotations

import math

import pytest

from sioms.hand.kinematics import Hand
from sioms.hand.yielding import Push, push_of, yielded

AT = (0.01, -0.02, 0.4, 0.09, 1.4, 1.7)
RATES = (0.004, 0.002, 0.05, -0.02, 0.1, -0.2)


def centres(rates: object) -> list[tuple[float, float]]:
    """Return the velocities of both fingers' centres, by differences of the inverse map."""
    hand, step = Hand(), 1e-7
    found = []
    for i in (0, 3):
        ends = []
        for sign in (-1.0, 1.0):
            joints = hand.inverse(tuple(q + sign * step * r for q, r in zip(AT, rates, strict=True)))  # type: ignore[call-overload]
            x, y, th = joints[i : i + 3]
            ends.append((x + hand.link1_m * math.cos(th), y + hand.link1_m * math.sin(th)))
        found.append(tuple((b - a) / (2 * step) for a, b in zip(*ends, strict=True)))
    return found  # type: ignore[return-value]


def links(rates: object) -> list[float]:
    _, _, psi, _, phi1, phi2 = rates  # type: ignore[misc]
    return [psi - phi1, psi - phi2]


@pytest.mark.parametrize("angle", [0.4, 1.3, -0.7])
@pytest.mark.parametrize("force", [0.0, 0.04, 0.3])
def test_a_finger_goes_into_what_it_feels_no_faster_than_the_law_and_nothing_else_changes(
    angle: float, force: float
) -> None:
    found = yielded(RATES, AT, (Push(force, angle), None), 0.06, 0.2, 0.4)
    n, before, after = (math.cos(angle), math.sin(angle)), centres(RATES), centres(found)
    speed = before[0][0] * n[0] + before[0][1] * n[1]
    most = 0.2 * (0.06 - force)
    into, across = (after[0][0] * n[0] + after[0][1] * n[1], after[0][1] * n[0] - after[0][0] * n[1])
    assert into == pytest.approx(min(speed, most), abs=1e-8)
    assert across == pytest.approx(before[0][1] * n[0] - before[0][0] * n[1], abs=1e-8)
    assert after[1] == pytest.approx(before[1], abs=1e-8)
    assert links(found) == pytest.approx(links(RATES), abs=1e-12)


def test_both_fingers_yield_each_by_itself() -> None:
    pushes = Push(0.1, AT[2]), Push(0.2, AT[2] + math.pi)
    after = centres(yielded(RATES, AT, pushes, 0.06, 0.2, 0.4))
    for (vx, vy), push in zip(after, pushes, strict=True):
        into = vx * math.cos(push.angle) + vy * math.sin(push.angle)
        assert into == pytest.approx(0.2 * (0.06 - push.force), abs=1e-8)


def test_a_finger_retreats_no_faster_than_it_may() -> None:
    (vx, vy), _ = centres(yielded(RATES, AT, (Push(50.0, AT[2]), None), 0.06, 0.2, 0.1))
    assert vx * math.cos(AT[2]) + vy * math.sin(AT[2]) == pytest.approx(-0.1, abs=1e-8)


def test_what_goes_away_from_a_contact_is_let_go_as_it_is() -> None:
    opening = (0.0, 0.0, 0.0, 0.05, 0.0, 0.0)
    assert yielded(opening, AT, (Push(0.05, AT[2]), Push(0.05, AT[2] + math.pi)), 0.06, 0.2, 0.4) == opening


def test_an_object_acts_against_the_push() -> None:
    assert push_of(-0.3, 0.4) == pytest.approx((0.5, math.atan2(-0.4, 0.3)))
