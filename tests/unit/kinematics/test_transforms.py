"""Maps: inverse and forward agree, rates are those of differences, forces do the same work."""

from __future__ import annotations

import math

import pytest

from sioms.kinematics import Joint, Reach, Transform, forces
from sioms.kinematics.arm import Arm
from sioms.kinematics.gantry import Gantry
from sioms.kinematics.mill import Mill
from sioms.kinematics.slits import Slits

MAPS = [
    (Gantry(0.8, 0.02), [0.1, 0.2, 0.013]), (Slits(0.0), [0.01, 0.004]),
    (Arm(0.3, 0.25), [0.2, 0.3, 0.1, 0.4]), (Mill((0.0, 0.1, -0.3), (0.01, 0.05), 0.08), [0.05, 0.02, 0.03, 0.4, 1.0]),
]  # fmt: skip


@pytest.mark.parametrize(("transform", "at"), MAPS)
def test_forward_is_the_inverse_of_inverse(transform: Transform, at: list[float]) -> None:
    assert list(transform.forward(transform.inverse(at))) == pytest.approx(at, abs=1e-12)


@pytest.mark.parametrize(("transform", "at"), MAPS)
def test_rates_of_joints_are_those_of_differences(transform: Transform, at: list[float]) -> None:
    rates, step = [0.3, -0.2, 0.05, 0.4, -0.1][: len(at)], 1e-6
    ends = [
        transform.inverse([here + sign * step * rate for here, rate in zip(at, rates, strict=True)])
        for sign in (-1.0, 1.0)
    ]
    expected = [(after - before) / (2.0 * step) for before, after in zip(*ends, strict=True)]
    assert list(transform.joint_rates(at, rates)) == pytest.approx(expected, rel=1e-6, abs=1e-9)


@pytest.mark.parametrize(("transform", "at"), MAPS)
def test_forces_do_the_same_work(transform: Transform, at: list[float]) -> None:
    pushes, rates = [3.0, -1.0, 2.0, 0.5, -0.7][: len(at)], [0.3, -0.2, 0.05, 0.4, -0.1][: len(at)]
    below = sum(push * rate for push, rate in zip(pushes, transform.joint_rates(at, rates), strict=True))
    above = sum(push * rate for push, rate in zip(forces(transform, at, pushes), rates, strict=True))
    assert above == pytest.approx(below, rel=1e-9)


def test_a_bridge_that_is_skewed_too_far_would_jam() -> None:
    gantry = Gantry(1.0, 0.01)
    assert gantry.inverse([0.0, 0.0, 0.01])[1] == pytest.approx(-0.5 * math.tan(0.01))
    with pytest.raises(ValueError, match="jam"):
        gantry.inverse([0.0, 0.0, 0.011])


def test_blades_do_not_pass_each_other() -> None:
    slits = Slits(1e-3)
    assert slits.inverse([0.0, 2e-3]) == pytest.approx((-1e-3, 1e-3))
    with pytest.raises(ValueError, match="gap"):
        slits.inverse([0.0, 0.5e-3])


def test_a_joint_beyond_its_limit_may_come_back_and_go_no_farther() -> None:
    reach = Reach(Slits(0.0), [Joint("a", minimum=-1.0, maximum=1.0), Joint("b", minimum=-1.0, maximum=1.0)])
    here = list(reach.transform.inverse([1.1, 0.1]))
    reach.check([1.0, 0.1], [1.1, 0.1], here)
    with pytest.raises(ValueError, match=r"axis [ab] would be at"):
        reach.check([1.2, 0.1], [1.1, 0.1], here)


def test_the_slowest_joint_slows_all_alike() -> None:
    reach = Reach(Gantry(1.0, 0.01), [Joint("x", velocity=0.1), Joint("y1", velocity=1.0), Joint("y2", velocity=1.0)])
    rates, share = reach.rates([0.0, 0.0, 0.0], [0.2, 0.2, 0.0])
    assert share == pytest.approx(0.5)
    assert rates == pytest.approx([0.1, 0.1, 0.1])


def test_rates_that_are_scaled_down_stay_within_the_limits() -> None:
    joints = [Joint("x", "m", velocity=3.0), Joint("y1", "m", velocity=0.7), Joint("y2", "m", velocity=0.7)]
    reach = Reach(Gantry(1.0), joints)
    for i in range(1, 2000):  # rounding would take some of them beyond
        rates, _ = reach.rates([0.0, 0.0, 0.0], [3.0 + 0.001 * i, 0.7 + 0.013 * i, 0.0])
        assert abs(rates[0]) <= 3.0 and max(map(abs, rates[1:])) <= 0.7


@pytest.mark.parametrize(
    ("transform", "inside", "beyond"),
    [
        (Gantry(1.0, 0.01), [0.0, 0.0, 0.0], [0.0, 0.0, 0.0100001]),
        (Gantry(1.0, 0.01), [0.0, 0.0, 0.0], [0.0, 0.0, -0.2]),
        (Arm(0.3, 0.25), [0.4, 0.1, 0.0, 0.0], [0.55, 0.0, 0.0, 0.0]),
        (Arm(0.3, 0.25), [0.3, 0.1, 0.0, 0.0], [0.05, 0.0, 0.0, 0.0]),
    ],
)  # fmt: skip
def test_what_is_found_beyond_its_reach_may_come_back_and_go_no_farther(
    transform: Transform, inside: list[float], beyond: list[float]
) -> None:
    joints = [Joint(str(i)) for i in range(len(inside))]
    reach, here = Reach(transform, joints), list(transform.inverse(inside))
    way = [to - at for to, at in zip(inside, beyond, strict=True)]
    reach.check(inside, beyond, here)
    reach.check(beyond, beyond, here)
    reach.check([at + 0.001 * by for at, by in zip(beyond, way, strict=True)], beyond, here)
    for share in (0.001, 0.1):
        with pytest.raises(ValueError, match="want"):
            reach.check([at - share * by for at, by in zip(beyond, way, strict=True)], beyond, here)
