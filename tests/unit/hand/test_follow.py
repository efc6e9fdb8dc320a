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


def test_small_errors_of_what_is_held_are_let_be() -> None:
    """What comes of it shows tests/physics/test_hand_hunting.py."""
    goal = (HERE[0] + 2e-4, HERE[1] - 1e-3, HERE[2] + 0.009, HERE[3], HERE[4] - 0.02, HERE[5])
    free, held = (Follower().orders(Setpoint(goal, (0.0,) * 6, 1.0), HERE, force, 2.5e-3) for force in (0.0, 1.0))
    rates = {axis: rate for axis, presses, rate in held if not presses}
    assert rates == pytest.approx({0: 0.0, 1: -5.0 * 7e-4, 2: 0.0, 4: -5.0 * 0.01, 5: 0.0})
    assert [rate for axis, _, rate in free if axis != D] == pytest.approx([1e-3, -5e-3, 0.045, -0.1, 0.0])
