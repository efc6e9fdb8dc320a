"""What a set-point becomes for the hand's node."""

from __future__ import annotations

import math

import pytest

from sioms.hand.follow import D, Follower
from sioms.hand.touch import Setpoint

HERE = (0.0, 0.0, 0.0, 0.1, 1.5, 1.5)


def test_no_order_is_faster_than_the_node_takes() -> None:
    """One record beyond a limit has all six refused, and the hand is not told to stand."""
    goal = (0.1, -0.2, 1.0, 0.1, 1.5, -1.5)
    most = (0.3, 0.3, 2.0, 0.4, 2.0, 2.0)
    free = Follower().orders(Setpoint(goal, (0.0,) * 6, 0.0), HERE, 0.0, 2.5e-3)
    assert any(abs(value) > limit for (_, _, value), limit in zip(free, most, strict=True))
    bounded = Follower(most=most).orders(Setpoint(goal, (0.0,) * 6, 0.0), HERE, 0.0, 2.5e-3)
    for (axis, presses, value), (_, _, wanted), limit in zip(bounded, free, most, strict=True):
        assert not presses and abs(value) <= limit
        assert value == pytest.approx(wanted if abs(wanted) <= limit else math.copysign(limit, wanted)), axis


def test_a_force_is_not_bounded_by_a_velocity() -> None:
    follower = Follower(most=(0.1,) * 6)
    for _ in range(200):
        orders = follower.orders(Setpoint(HERE, (0.0,) * 6, 2.0), HERE, 1.0, 2.5e-3)
    assert orders[D] == (D, True, 2.0)
