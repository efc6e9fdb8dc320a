"""Arm and mill against chains of matrices that share nothing with the maps, known postures, and their ends."""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pytest

from sioms.kinematics.arm import Arm
from sioms.kinematics.mill import Mill

ARMS = [Arm(0.3, 0.25), Arm(0.3, 0.25, elbow_left=False, facing_rad=2.0), Arm(0.2, 0.4, bend_rad=0.05, facing_rad=-3.0)]
MILLS = [Mill(), Mill((0.02, -0.03, -0.3), (0.013, 0.05), 0.08, 1.2)]


def _moved(x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Any:
    found = np.eye(4)
    found[:3, 3] = x, y, z
    return found


def _turned(axis: str, angle: float) -> Any:
    """Return a rotation by the series of its generator: no sine of this module is in it."""
    generator = np.zeros((4, 4))
    i, j = {"x": (1, 2), "z": (0, 1)}[axis]
    generator[j, i], generator[i, j] = angle / 64, -angle / 64
    term, found = np.eye(4), np.eye(4)
    for k in range(1, 12):
        term = term @ generator / k
        found = found + term
    return np.linalg.matrix_power(found, 64)


def _arm_chain(arm: Arm, joints: Sequence[float]) -> Any:
    """Return the tool's frame in that of the shoulder."""
    shoulder, elbow, lift, wrist = joints
    links = _turned("z", shoulder) @ _moved(arm.upper_m) @ _turned("z", elbow) @ _moved(arm.fore_m)
    return _moved(z=lift) @ links @ _turned("z", wrist)


def _mill_chain(mill: Mill, joints: Sequence[float]) -> Any:
    """Return the frame of the tool, which the spindle carries, in that of the workpiece, which the cradle carries."""
    x, y, z, tilt, turn = joints
    spindle = _moved(x, y, z) @ _moved(z=-mill.tool_m)
    cradle = _moved(*mill.pivot_m) @ _turned("x", tilt) @ _moved(0.0, *mill.table_m) @ _turned("z", turn)
    return np.linalg.inv(cradle) @ spindle


def _postures(arm: Arm, count: int = 200) -> list[list[float]]:
    draw, sign = random.Random(51), 1.0 if arm.elbow_left else -1.0
    return [
        [
            arm.facing_rad + draw.uniform(-3.1, 3.1), sign * draw.uniform(arm.bend_rad, math.pi - arm.bend_rad),
            draw.uniform(0.0, 0.2), draw.uniform(-6.0, 6.0),
        ]
        for _ in range(count)
    ]  # fmt: skip


def _settings(mill: Mill, count: int = 200) -> list[list[float]]:
    draw = random.Random(52)
    return [
        [*(draw.uniform(-0.3, 0.3) for _ in range(3)), draw.uniform(-mill.tilt_max, mill.tilt_max),
         draw.uniform(-7.0, 7.0)] for _ in range(count)
    ]  # fmt: skip


@pytest.mark.parametrize("arm", ARMS)
def test_an_arm_is_where_its_chain_ends(arm: Arm) -> None:
    for joints in _postures(arm):
        x, y, z, angle = arm.forward(joints)
        end = _arm_chain(arm, joints)
        assert [x, y, z] == pytest.approx(end[:3, 3].tolist(), abs=1e-12)
        assert [math.cos(angle), math.sin(angle)] == pytest.approx(end[:2, 0].tolist(), abs=1e-12)
        assert list(arm.inverse((x, y, z, angle))) == pytest.approx(joints, abs=1e-9)


@pytest.mark.parametrize("mill", MILLS)
def test_a_tool_is_in_the_workpiece_where_its_chain_says(mill: Mill) -> None:
    for joints in _settings(mill):
        x, y, z, tilt, turn = mill.forward(joints)
        end = _mill_chain(mill, joints)
        assert [x, y, z] == pytest.approx(end[:3, 3].tolist(), abs=1e-12)
        tool = [math.sin(turn) * math.sin(tilt), math.cos(turn) * math.sin(tilt), math.cos(tilt)]
        assert tool == pytest.approx(end[:3, 2].tolist(), abs=1e-12)
        assert list(mill.inverse((x, y, z, tilt, turn))) == pytest.approx(joints, abs=1e-12)


def _rates(chain: Callable[[Sequence[float]], Any], joints: Sequence[float], rates: Sequence[float]) -> Any:
    step = 1e-6
    ends = [
        chain([at + sign * step * rate for at, rate in zip(joints, rates, strict=True)])[:3, 3] for sign in (-1.0, 1.0)
    ]
    return (ends[1] - ends[0]) / (2.0 * step)


@pytest.mark.parametrize("arm", ARMS)
def test_an_arm_goes_as_it_is_told(arm: Arm) -> None:
    wanted = [0.03, -0.05, 0.02, 0.4]
    for joints in _postures(arm, 40):
        rates = arm.joint_rates(arm.forward(joints), wanted)
        assert _rates(lambda at: _arm_chain(arm, at), joints, rates) == pytest.approx(wanted[:3], abs=1e-6)
        assert rates[0] + rates[1] + rates[3] == pytest.approx(wanted[3], abs=1e-12), "the tool turns by all three"


@pytest.mark.parametrize("mill", MILLS)
def test_a_mill_goes_as_it_is_told(mill: Mill) -> None:
    wanted = [0.03, -0.05, 0.02, 0.4, -0.3]
    for joints in _settings(mill, 40):
        rates = mill.joint_rates(mill.forward(joints), wanted)
        assert _rates(lambda at: _mill_chain(mill, at), joints, rates) == pytest.approx(wanted[:3], abs=1e-7)
        assert list(rates[3:]) == wanted[3:]


def test_known_postures_of_an_arm() -> None:
    quarter = 0.5 * math.pi
    assert Arm(0.3, 0.4).forward((0.0, quarter, 0.1, -quarter)) == pytest.approx((0.3, 0.4, 0.1, 0.0))
    # three, four and five: the elbow is at a right angle where the wrist is 0.5 m away
    assert Arm(0.3, 0.4).inverse((0.5, 0.0, 0.0, 0.0))[1] == pytest.approx(quarter)
    assert Arm(0.3, 0.4, elbow_left=False).inverse((0.5, 0.0, 0.0, 0.0))[1] == pytest.approx(-quarter)
    # two links and the way to the wrist as an equilateral triangle
    shoulder, elbow, *_ = Arm(0.2, 0.2).inverse((0.2, 0.0, 0.0, 0.0))
    assert (shoulder, elbow) == pytest.approx((-math.pi / 3, 2 * math.pi / 3))


def test_a_mill_keeps_the_tip_where_the_table_turns() -> None:
    mill = MILLS[1]
    tip = [0.04, -0.02, 0.03]
    for tilt, turn in ((0.0, 0.0), (0.7, 1.0), (-1.1, -3.0)):
        assert _mill_chain(mill, mill.inverse([*tip, tilt, turn]))[:3, 3] == pytest.approx(tip, abs=1e-12)
    # a tip on the cradle's axis is not moved by tilting
    on_axis = [0.1, -mill.table_m[0], -mill.table_m[1], 0.0, 0.0]
    assert mill.joint_rates(on_axis, [0.0, 0.0, 0.0, 1.0, 0.0])[:3] == pytest.approx((0.0, 0.0, 0.0), abs=1e-12)


def test_what_an_arm_cannot_reach_and_where_it_is_singular_is_refused() -> None:
    arm = ARMS[0]
    least, most = arm.span_m
    assert math.hypot(*arm.forward((0.3, 0.1, 0.0, 0.0))[:2]) == pytest.approx(most)
    assert math.hypot(*arm.forward((0.3, math.pi - 0.1, 0.0, 0.0))[:2]) == pytest.approx(least)
    for distance in (0.0, least - 1e-6, most + 1e-6, 0.55, 5.0, math.nan):
        with pytest.raises(ValueError, match=r"from the shoulder; want 0\.0\d+ to 0\.54\d+ m"):
            arm.inverse((distance, 0.0, 0.0, 0.0))
        rates = arm.joint_rates((distance, 0.0, 0.0, 0.0), (0.1, 0.1, 0.0, 0.0))
        assert math.isnan(distance) or max(map(abs, rates)) < 20.0, "bounded where it stands already"
    with pytest.raises(ValueError, match="bent to the right; want it on the left"):
        arm.forward((0.3, -0.5, 0.0, 0.0))
    with pytest.raises(ValueError, match="bent to the left; want it on the right"):
        ARMS[1].forward((0.3, 0.5, 0.0, 0.0))


def test_a_table_that_would_meet_the_spindle_is_refused() -> None:
    with pytest.raises(ValueError, match=r"a tilt of 1\.3 rad .* at most 1\.2 rad"):
        MILLS[1].inverse((0.0, 0.0, 0.0, 1.3, 0.0))


@pytest.mark.parametrize(
    ("kind", "keys", "word"),
    [
        (Arm, {"upper_m": 0.0, "fore_m": 0.1}, "upper_m"), (Arm, {"upper_m": 0.1, "fore_m": math.inf}, "fore_m"),
        (Arm, {"upper_m": 0.1, "fore_m": 0.1, "bend_rad": 0.0}, "bend_rad"),
        (Arm, {"upper_m": 0.1, "fore_m": 0.1, "bend_rad": 1.6}, "bend_rad"),
        (Arm, {"upper_m": 0.1, "fore_m": 0.1, "facing_rad": math.nan}, "facing_rad"),
        (Mill, {"pivot_m": (0.0, math.nan, 0.0)}, "pivot_m"), (Mill, {"table_m": (0.0, math.inf)}, "table_m"),
        (Mill, {"tool_m": -0.1}, "tool_m"),
        (Mill, {"tilt_max": 4.0}, "tilt_max"), (Mill, {"tilt_max": 0.0}, "tilt_max"),
    ],
)  # fmt: skip
def test_numbers_that_describe_no_machine_are_refused(kind: Any, keys: dict[str, Any], word: str) -> None:
    with pytest.raises(ValueError, match=rf"describe (arm|mill): {word} .*; want"):
        kind(**keys)
