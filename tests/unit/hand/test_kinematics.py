"""The maps of the hand: inverse of each other, of matching derivatives, and of one power."""

from __future__ import annotations

import math
import random

import numpy as np
import pytest

from sioms.hand.kinematics import Hand, wrap
from sioms.hand.statics import damper_factor, damper_limit

HAND = Hand(0.140, 0.150)


def poses(count: int) -> list[tuple[float, ...]]:
    draw = random.Random(1).uniform
    return [
        (draw(-0.4, 0.4), draw(-0.6, 0.6), draw(-3.1, 3.1), draw(0.01, 0.3), draw(-3.1, 3.1), draw(-3.1, 3.1))
        for _ in range(count)
    ]


def test_ten_thousand_poses_come_back() -> None:
    worst = 0.0
    for pose in poses(10_000):
        back = HAND.forward(HAND.inverse(pose))
        worst = max(worst, max(abs(a - b) for a, b in zip(back, pose, strict=True)))
    assert worst < 1e-12


def test_rates_are_derivatives_of_the_maps() -> None:
    h = 1e-6
    for number, pose in enumerate(poses(50)):
        rates = random.Random(number).choices([-0.1, 0.05, 0.2], k=6)
        after, before = ([q + s * h * v for q, v in zip(pose, rates, strict=True)] for s in (1, -1))
        numeric = [(a - b) / (2 * h) for a, b in zip(HAND.inverse(after), HAND.inverse(before), strict=True)]
        assert HAND.joint_rates(pose, rates) == pytest.approx(numeric, abs=1e-9)
        assert HAND.hand_rates(HAND.inverse(pose), HAND.joint_rates(pose, rates)) == pytest.approx(rates, abs=1e-12)


def test_forces_do_the_same_work_in_joints_as_in_hand_coordinates() -> None:
    pose, rates, forces = poses(1)[0], (0.1, -0.2, 0.3, 0.05, -0.4, 0.2), np.array([1.0, -2.0, 0.1, 0.5, 3.0, -0.2])
    work = forces @ np.array(HAND.joint_rates(pose, rates))
    assert HAND.jacobian(pose).T @ forces @ np.array(rates) == pytest.approx(work, rel=1e-12)


def test_a_squeeze_bends_the_soft_axis_where_the_link_is_across() -> None:
    hand = Hand()
    across = hand.jacobian((0, 0, 0.3, 0.06, math.pi / 2, math.pi / 2))
    force = 1.0  # N along d: what the joints bear is the transpose of d joints'/d hand, inverted
    joints = np.linalg.solve(across.T, [0, 0, 0, force, 0, 0])
    assert abs(joints[2]) == pytest.approx(0.140, rel=1e-9) and abs(joints[5]) == pytest.approx(0.140, rel=1e-9)
    along = hand.jacobian((0, 0, 0.3, 0.06, 0.0, 0.0))
    assert np.linalg.solve(along.T, [0, 0, 0, force, 0, 0])[[2, 5]] == pytest.approx([0.0, 0.0], abs=1e-12)


@pytest.mark.parametrize("d", [0.0, -0.01, math.nan])
def test_fingers_in_one_place_are_refused(d: float) -> None:
    with pytest.raises(ValueError, match="no direction at 0"):
        HAND.inverse((0, 0, 0, d, 1, 1))
    with pytest.raises(ValueError, match="link1_m"):
        Hand(d)


def test_wrap_keeps_half_a_turn_positive() -> None:
    assert wrap(math.pi) == wrap(-math.pi) == wrap(3 * math.pi) == math.pi
    assert wrap(-3.5) == pytest.approx(math.tau - 3.5)


def test_twenty_hertz_limits_the_range_of_the_gains() -> None:
    assert damper_limit(7.0, 0.05) == pytest.approx(5.7, abs=0.02)
    assert damper_limit(8500.0, 0.05) == pytest.approx(4.7e-3, abs=1e-4)
    assert damper_limit(7.0, 0.05, late=1) == pytest.approx(damper_limit(7.0, 0.05) / 2)


@pytest.mark.parametrize("late", [0, 1, 2, 5])
def test_the_loop_is_stable_just_below_its_limit(late: int) -> None:
    limit = damper_limit(7.0, 0.05, late)
    for share, stable in ((0.5, True), (0.99, True), (1.01, False)):
        force = [0.0] * (late + 1)  # the loop itself, sample by sample
        for _ in range(6000):
            force.append(force[-1] + share * limit * 7.0 * 0.05 * (1.0 - force[-1 - late]))
        assert (abs(force[-1] - 1.0) < 1.0) is stable
        assert (damper_factor(share * limit, 7.0, 0.05, late) < 1.0) is stable
