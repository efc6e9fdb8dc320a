"""The command line of the hand: each verb of its table is there, and what cannot be is one sentence."""

from __future__ import annotations

import argparse
import math
import re
from pathlib import Path

import numpy as np
import pytest

from sioms.hand.command import VERBS, add_parser, run
from sioms.hand.command.canvas import HEIGHT, VIEW_M, WIDTH, drawn
from sioms.hand.command.frames import Frame, Side
from sioms.hand.command.skill import carry_out, lines
from sioms.hand.kinematics import Hand
from sioms.hand.plane import PlaneHand, Rig
from sioms.hand.regrasp import NEUTRAL
from sioms.hand.touch import Event, Failed, Fault, Manner
from sioms.hand.trials import Losses, Outcome, draw, losses
from sioms.plant.outline import ellipse
from sioms.plant.planar import Body, Mount, World

_JOINTS = Hand().inverse((0.0, 0.0, 0.0, Rig().open_m, NEUTRAL, NEUTRAL))
OPEN = _JOINTS[:3], _JOINTS[3:]


def _words(*words: str) -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    add_parser(parser.add_subparsers(dest="command"))
    return parser.parse_args(["hand", *words])


@pytest.mark.parametrize("verb", VERBS)
def test_a_verb_explains_itself(verb: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as end:
        _words(verb, "--help")
    assert end.value.code == 0
    assert VERBS[verb].text.split()[0].capitalize() in capsys.readouterr().out


def test_trials_count_what_becomes_of_objects(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(_words("trials", "--count", "1")) == 0
    out = capsys.readouterr().out
    assert "disk" in out and "held" in out and "all       100.0 %" in out
    assert "lost: 0 of 1 with a coefficient of 1.4 and more; 0 of 0 below it, 0 of them without a warning before" in out


def test_an_unknown_family_of_objects_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(_words("trials", "--shapes", "disk", "cubes")) == 1
    assert "no family cubes; want disk, ellipse" in capsys.readouterr().err


def test_losses_are_counted_apart_by_friction_and_warning() -> None:
    lost = [
        Outcome(0, "disk", friction, 0.0, 0.0, 0.0, 0, 0, not dropped, None, dropped, warned, 1.0)
        for friction, dropped, warned in (
            (1.4, False, True), (2.0, True, False), (1.3, True, True), (0.9, True, False), (0.8, False, True),
        )
    ]  # fmt: skip
    assert losses(lost) == Losses(1, 2, 2, 3, 1)


def test_hulls_are_general_convex_polygons_sharp_and_rounded() -> None:
    """No two sides alike, corners on no common ellipse, and none in which a finger would be at the start."""
    drawn = [draw(number, 7, ("hull",)) for number in range(40)]
    sharp = [one.outline.points for one in drawn if len(one.outline.points) < 13]
    assert 8 < len(sharp) < 32 and {len(points) for points in sharp} >= {4, 5, 6}
    for points in sharp:
        sides = np.linalg.norm(np.roll(points, -1, axis=0) - points, axis=1)
        assert np.min(np.diff(np.sort(sides))) > 0.0
        assert float(np.ptp(np.linalg.norm(points, axis=1))) > 1e-3
    assert all(min(World(Body(one.outline), [Mount()] * 2, OPEN, one.pose).clearances()) > 0.02 for one in drawn)


def test_no_trials_are_refused(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="2"):
        run(_words("trials", "--count", "0"))
    assert "must be an integer >= 1" in capsys.readouterr().err


def test_single_skills_follow_one_another_on_one_hand() -> None:
    hand, events = PlaneHand(Body(ellipse(0.031, 0.022)), (0.002, -0.001, 0.4), seed=3), list[Event]()
    with pytest.raises(Failed, match="touches nothing") as nothing:
        carry_out(hand, "sense", Manner(), 1.0, events.append)
    assert nothing.value.fault is Fault.NOTHING_THERE
    first = carry_out(hand, "grasp", Manner(), 1.0, events.append)
    assert first is not None and first.grasp.quality > math.radians(5.0)
    again = carry_out(hand, "regrasp", Manner(), 1.0, events.append)
    held = carry_out(hand, "hold", Manner(), 0.5, events.append)
    assert again is not None and held is not None
    assert held.grasp.quality < again.grasp.quality < 0.5 * first.grasp.quality
    assert hand.truth().quality < math.radians(3.0)
    assert any("regrasp" in event.text for event in events)
    assert "friction angles" in lines(held)[0] and "finger 2" in lines(held)[-1]
    assert carry_out(hand, "release", Manner(), 0.5, events.append) is None and not hand.is_held()


def test_a_force_beyond_what_fingers_bear_is_refused_before_anything_is_opened(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert run(_words("grasp", "--force", "40")) == 1
    assert "at most 4 N" in capsys.readouterr().err


def test_the_demonstration_ends_as_it_says(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("matplotlib")
    assert run(_words("demo", "--quiet", "--no-animation", "-o", str(tmp_path))) == 0
    out = capsys.readouterr().out
    assert "regrasp" in out and "roll from" in out and "knocks" in out
    worst = re.search(r"at most ([\d.]+) deg", out)
    assert worst is not None and float(worst[1]) < 1.0
    assert "it ended by itself: stale sensor" in out and "finger 2" in out.splitlines()[-2]
    assert (tmp_path / "hand.png").stat().st_size > 20_000 and not (tmp_path / "hand.gif").exists()


def test_a_frame_in_the_terminal_shows_object_fingers_and_forces() -> None:
    outline = [(float(x), float(y)) for x, y in ellipse(0.031, 0.022).points]
    sides = [
        Side((sign * 0.043, 0.0), (sign * 0.043, sign * -0.14), (sign * 0.031, 0.0), 1.0, felt)
        for sign, felt in ((-1, 1.0), (1, 0.5))
    ]
    frame = Frame(12.3, "hold", (0.0, 0.0, 0.0), (sides[0], sides[1]), (math.radians(2.0), math.nan), "a word")
    rows = drawn(frame, outline)
    assert len(rows) == HEIGHT + 3 and all(len(row) == WIDTH for row in rows[:HEIGHT])
    middle = rows[HEIGHT // 2]
    assert middle[WIDTH // 2] == " " and "hold" in rows[HEIGHT] and "2.00" in rows[HEIGHT] and "--" in rows[HEIGHT]
    drawn_at = [column for column, char in enumerate(middle) if char != " "]
    end = 0.0557 * WIDTH / VIEW_M  # the far side of a finger
    assert abs(drawn_at[0] - (WIDTH / 2 - end)) < 2 and abs(drawn_at[-1] - (WIDTH / 2 + end)) < 2
    one, two = re.findall(r"finger \d ([^ ]+)", rows[HEIGHT + 1])
    assert one.count("█") > two.count("█") > 0
