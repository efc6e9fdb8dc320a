"""The hand's experiments: closed forms against the rigid integrator, the plane against both, gains and the cone."""

from __future__ import annotations

import math

import pytest

from sioms.hand.contacts import Likeness
from sioms.hand.control import Gains
from sioms.hand.edges import Edge
from sioms.hand.experiments.corners import round_corner
from sioms.hand.experiments.force import Loop, answer
from sioms.hand.experiments.regrasps import By, regrasp
from sioms.hand.experiments.rolls import SPEED, closed_form, rigid_time, roll
from sioms.hand.experiments.slips import slip
from sioms.hand.experiments.starts import Start
from sioms.hand.plane import Rig
from sioms.plant.planar import Mount

MM, DEG = 1e-3, math.pi / 180
RIG = Rig(every=4, compiled=False)
STARTS = [
    Start(Likeness.DISK, 20 * MM, 20 * DEG),
    Start(Likeness.DISK, 60 * MM, -40 * DEG),
    Start(Likeness.RECTANGLE, 30 * MM, -21.8014 * DEG),
    Start(Likeness.RECTANGLE, 80 * MM, 40 * DEG),
]


@pytest.mark.parametrize("start", STARTS)
def test_the_closed_form_is_the_time_of_rigid_fingers(start: Start) -> None:
    assert rigid_time(start) == pytest.approx(closed_form(start), rel=0.005)
    with pytest.raises(ValueError, match="want the rates of the rolling law"):
        rigid_time(start, reversed_sign=True)


def test_known_answers_of_turns() -> None:
    turns = [closed_form(start) * SPEED / DEG for start in (STARTS[0], STARTS[2])]
    assert turns == pytest.approx([51.4961, 14.847], rel=1e-4)


def test_a_rectangle_rolls_in_the_time_of_the_closed_form() -> None:
    found = roll(Start(Likeness.RECTANGLE, 57 * MM, 20 * DEG), RIG, 3)
    assert found.first == pytest.approx(20 * DEG, abs=0.5 * DEG)
    assert found.time_s == pytest.approx(found.expected_s, rel=0.05) and found.last < 0.3 * DEG
    least = min(found.trace, key=lambda row: row[3])
    assert abs(least[1]) < 1.5 * DEG  # the contacts are closest where it is parallel


def test_a_disk_is_regrasped_by_position_in_one_step() -> None:
    found = regrasp(Start(Likeness.DISK, 25 * MM, -15 * DEG), By.POSITION, 1, RIG)
    assert found.told is Likeness.DISK and found.radius_m == pytest.approx(25 * MM, rel=0.02)
    assert found.etas[0] == pytest.approx(15 * DEG, abs=0.5 * DEG) and found.etas[1] < 0.4 * DEG


def test_the_usual_gain_has_a_margin_of_two() -> None:
    gains, mount = Gains(), Mount()
    loop = Loop(2.5e-3, gains.filter_s)
    usual, twice, beyond = (answer(loop, share * gains.damper, mount, 1.0) for share in (1.0, 2.0, 3.5))
    assert usual.overshoot < 0.1 and twice.swing < 0.2 and beyond.swing > 1.0


def test_it_slides_at_the_cone_and_is_warned_of_before() -> None:
    found = slip(0.6, RIG)
    assert found.at == pytest.approx(math.atan(0.6), abs=1.0 * DEG)
    assert found.warned_at < 21 * DEG and found.warned_s > 1.0


def test_a_finger_that_rolls_on_to_a_corner_tells_the_vertex_within_the_width_of_the_contact() -> None:
    found = round_corner(before_m=3e-3, turn=30 * DEG, rig=RIG)
    assert found.drop_outs == 0 and found.early == 0
    assert 0.0 <= found.late < found.width
    assert {row.edge for row in found.rows[-400:]} == {Edge.VERTEX}
    places = [row.place for row in found.rows if row.at_corner]
    assert max(places) - min(places) < 4 * DEG  # while the link turned by 15 degrees and more
