"""One finger of a live hand touches what lies on the platen, and yields: drivers of etc/hand.toml on one thread."""

from __future__ import annotations

import math
from typing import Any

import msgspec
import numpy as np
import pytest
from hand_cell_rig import HandCell, write

from sioms.drivers.compound.hand import HandDriver
from sioms.hand.contacts import FINGER_M
from sioms.hand.follow import D
from sioms.hand.skills import Skills
from sioms.hand.touch import Failed, Fault, Manner
from sioms.motion import CommandError
from sioms.protocol.flags import AnalogStatus, AxisStatus

FAULT = int(AxisStatus.FAULT)
RADIUS_M, AWAY_M, MOST_N = 0.02, 1e-3, 0.06
NEAR = RADIUS_M + FINGER_M + AWAY_M


def near(tables: dict[str, Any]) -> None:
    """A disk between both fingers, a millimetre from the left one; sensors slow enough for a test."""
    tables["world"]["object"] = {"shape": "disk", "radius_m": RADIUS_M, "pose": [0.0, 0.0, 0.0]}
    tables["left"]["axis"][0]["motor"]["start"] = -NEAR
    for finger in ("touch1", "touch2"):
        tables[finger]["tick_hz"] = 40.0
        tables[finger]["shape"]["mean_frames"] = 4


def near_and_felt(tables: dict[str, Any]) -> None:
    """The same with fingers that are asked what they feel."""
    near(tables)
    for finger in ("touch1", "touch2"):
        tables[finger]["tick_hz"] = 400.0
        tables[finger]["shape"]["mean_frames"] = 40


@pytest.fixture
def cell() -> HandCell:
    return HandCell(near, compiled=False)


def press(cell: HandCell, time_s: float, most_n: float, speed: float = 0.01) -> tuple[float, float]:
    """Move finger 1 alone along the line of centres; return how far the object went [m], and the hardest push [N]."""
    before, hardest = list(cell.world.pose), 0.0
    for _ in range(round(time_s / 2.5e-3)):
        write(cell.bank, [(0, False, 0.5 * speed), (D, False, -speed)], cell.now_ns, most_n)
        cell.advance(2.5e-3)
        hardest = max(hardest, cell.world.fingers[0].normal)
    return math.dist(before[:2], cell.world.pose[:2]), hardest


def test_a_finger_that_is_to_yield_leaves_the_object_where_it_is_and_another_pushes_it_away() -> None:
    yields, pushes = HandCell(near, compiled=False), HandCell(near, compiled=False)
    gone, hardest = press(yields, 1.0, MOST_N)
    assert gone < 0.25e-3 and hardest < 0.18
    touched, _, force, _, angle, _, age_s = yields.drivers["hand"].blocks[2].data
    assert touched == 1.0 and 0.5 * MOST_N < force < 2.0 * MOST_N and age_s < 0.01
    assert angle == pytest.approx(yields.coordinates[2], abs=1.2)  # friction sticks and slips
    gone, hardest = press(pushes, 1.0, 4.0)
    assert gone > 1.5e-3 and hardest > 0.19  # the platen holds it with 0.2 N


def test_a_finger_that_touches_nothing_goes_as_it_is_told(cell: HandCell) -> None:
    before = cell.coordinates
    press(cell, 0.3, MOST_N, speed=-0.02)
    assert cell.coordinates[D] - before[D] == pytest.approx(6e-3, abs=5e-4)
    assert cell.coordinates[0] - before[0] == pytest.approx(-3e-3, abs=5e-4)


def test_a_stop_while_a_finger_yields_leaves_it_standing(cell: HandCell) -> None:
    press(cell, 0.8, MOST_N)
    cell.bank.stop(np.arange(6), cell.now_ns)
    cell.advance(0.3)
    before = cell.coordinates
    cell.advance(0.3)
    assert np.allclose(cell.coordinates, before, atol=2e-4)
    assert cell.world.fingers[0].normal < 2.0 * MOST_N


@pytest.mark.parametrize(("what", "said"), [
    ("stale", "wrist1: its reading is 0.05"), ("invalid", "wrist1: its force is invalid or saturated"),
])  # fmt: skip
def test_without_a_force_nothing_yields_and_the_hand_stops(cell: HandCell, what: str, said: str) -> None:
    press(cell, 0.1, MOST_N)
    cell.halted.add("wrist1")
    if what == "invalid":
        cell.drivers["wrist1"].blocks[0].flags[:] = int(AnalogStatus.INVALID)
    cell.advance(0.1)
    assert (cell.bank.rows["status"].astype(int) & FAULT).all()
    assert said in cell.bank.fault_text(D)
    before = cell.coordinates
    cell.advance(0.2)
    assert np.allclose(cell.coordinates, before, atol=5e-4)


def test_a_hand_that_cannot_yield_takes_no_greatest_force() -> None:
    def without(tables: dict[str, Any]) -> None:
        near(tables)
        del tables["hand"]["touch"]

    cell = HandCell(without, compiled=False)
    with pytest.raises(CommandError, match="SPECIFIED_MAX_FORCE"):
        press(cell, 0.01, MOST_N)


@pytest.mark.parametrize(("touch", "said"), [
    ({}, "neither or both of fingers and wrists"),
    ({"wrists": ["a", "b"], "fingers": ["c", "d"]}, "neither or both of fingers and wrists"),
    ({"wrists": ["a", "b"], "contact_n": 0.0}, "touch: contact_n 0; want 1e-06 to 1000"),
    ({"wrists": ["a", "b"], "damper": math.nan}, "touch: damper nan"),
])  # fmt: skip
def test_a_touch_that_tells_no_force_is_refused(touch: dict[str, Any], said: str) -> None:
    axis = [{"name": name, "velocity_max": 0.2, "acceleration_max": 2.0} for name in HandDriver.COORDINATES]
    settings = msgspec.convert({"axes": ["left", "right"], "axis": axis, "touch": touch}, HandDriver.Settings)
    with pytest.raises(ValueError, match=said):
        HandDriver.describe("hand", settings)


MANNER = Manner(tap_n=MOST_N, tap_frames=160, yield_n=0.08)


def test_a_touch_of_one_finger_tells_the_place_and_moves_nothing() -> None:
    cell = HandCell(near_and_felt, compiled=False)
    skills = Skills(cell.hand, cell.reading, MANNER)
    before = list(cell.world.pose)
    skills._most_n = MANNER.yield_n
    touch, pushed = cell.run(skills._tap(0, NEAR - AWAY_M))
    assert pushed is None and touch is not None and skills.taps == 1
    assert math.dist(before[:2], cell.world.pose[:2]) < 0.1e-3  # 1 to 4 mm where none yields
    assert math.dist(touch.point, cell.world.pose[:2]) == pytest.approx(RADIUS_M, abs=0.1e-3)
    centre = math.atan2(touch.point[1] - cell.world.pose[1], touch.point[0] - cell.world.pose[0])
    assert math.remainder(touch.normal - centre, math.tau) == pytest.approx(0.0, abs=math.radians(0.5))


def test_a_finger_that_nothing_tells_of_is_named(cell: HandCell) -> None:
    skills = Skills(cell.hand, cell.reading, MANNER)
    skills._most_n = MANNER.yield_n
    cell.drivers["hand"]._touching.why = "wrist2: gone"
    cell.halted |= {"wrist1", "wrist2"}
    cell.advance(0.1)
    cell.reading = cell._read()
    with pytest.raises(Failed, match="nothing tells what finger 1 touches") as failed:
        cell.run(skills._guarded("feel", skills._feel_round([])))
    assert failed.value.fault is Fault.STALE
