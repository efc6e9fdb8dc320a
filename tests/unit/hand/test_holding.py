"""Holding: what is corrected, what is let be, and what is done with the object meanwhile."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from sioms.hand.plane import PlaneHand
from sioms.hand.skills import Skills
from sioms.hand.touch import Manner
from sioms.plant.outline import disk
from sioms.plant.planar import Body


@pytest.mark.parametrize(("let_rad", "least", "most"), [(0.0, 0.0, 0.4), (math.radians(3.0), 1.0, 3.0)])
def test_small_friction_angles_are_let_be(let_rad: float, least: float, most: float) -> None:
    hand = PlaneHand(Body(disk(0.02)), (0.0, 1e-3, 0.0), seed=2)
    skills = Skills(hand.hand, hand.reading, Manner(let_rad=let_rad))
    hand.run(skills.grasp())
    assert 1.0 < math.degrees(hand.truth().quality) < 3.0
    hand.run(skills.hold(1.5))
    assert least <= math.degrees(hand.truth().quality) < most


def test_what_is_held_is_carried() -> None:
    hand = PlaneHand(Body(disk(0.02)), (0.0, 0.0, 0.0), seed=2)
    skills = Skills(hand.hand, hand.reading)
    hand.run(skills.grasp())
    before = list(hand.world.pose)
    hand.run(skills.hold(0.6, (0.0, 0.02)))
    assert hand.world.pose[1] - before[1] == pytest.approx(0.012, abs=1.5e-3)
    assert hand.world.pose[0] - before[0] == pytest.approx(0.0, abs=1.5e-3) and hand.is_held()
    hand.run(skills.hold(1.0, rolling=(0.3, -0.3)))
    assert math.radians(3.0) < hand.truth().quality < math.radians(9.0)  # 17 degrees of the links, on a disk of 20 mm
    with pytest.raises(ValueError, match="want finite ones"):
        skills.hold(1.0, (math.nan, 0.0))


def test_friction_angles_are_smoothed_alike_at_any_rate() -> None:
    hand = PlaneHand(Body(disk(0.02)), (0.0, 0.0, 0.0), seed=2)
    skills = Skills(hand.hand, hand.reading)
    seen = replace(skills._seen(), eta1=0.1, eta2=-0.1)
    after = []
    for rate_hz in (400.0, 200.0):
        value, skills._gone_s = (0.0, 0.0), 1.0 / rate_hz
        for _ in range(round(0.05 * rate_hz)):
            value = skills._smoothed(value, seen, 0.05)
        after.append(value[0])
    assert after[0] == pytest.approx(after[1], rel=0.03) and after[0] == pytest.approx(0.063, rel=0.05)
