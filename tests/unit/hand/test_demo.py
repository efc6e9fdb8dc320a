"""What a demonstration of the hand is made of: its cell, its pictures, and what it shows that the hand knows."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sioms.hand.around import Around
from sioms.hand.command.canvas import drawn
from sioms.hand.command.frames import Frame, Known, Side
from sioms.hand.command.stage import OPEN_M, TOGETHER, tables
from sioms.hand.shape import Touch
from sioms.hand.trials import draw
from sioms.plant.outline import ellipse


def _touch(x: float, y: float, normal: float) -> Touch:
    return Touch((x, y), normal, math.inf, math.inf)


def _frames(count: int) -> list[Frame]:
    states = ("close", "feel", "hold", "killed")
    sides = [
        Side((sign * 0.043, 0.0), (sign * 0.043, sign * -0.14), (sign * 0.031, 0.0), 1.0, 0.9, (-sign, 0.2))
        for sign in (-1.0, 1.0)
    ]
    known = Known(((0.031, 0.0), (0.0, 0.02)), ((0.03, 0.0), (0.0, 0.02), (-0.03, 0.0)))
    return [
        Frame(
            0.08 * i, states[4 * i // count], (0.0, 0.0, 0.1), (sides[0], sides[1]), (0.1, math.nan if i % 7 else 0.0),
            "a word " * 30, ((0.0, 0.04), (0.0, -0.5)), known,
        )
        for i in range(count)
    ]  # fmt: skip


def test_the_cell_of_a_demonstration_has_the_object_and_finger_2_in_a_process_of_its_own() -> None:
    subject = draw(19)
    whole, slow = tables(subject, 1.0)["device"], tables(subject, 0.5)["device"]
    assert np.allclose(whole["world"]["object"]["points_m"], subject.outline.points)
    assert whole["world"]["finger"][2]["axes"] == ["prober.plant.x_position", "prober.plant.y_position", ""]
    assert slow["left"]["tick_hz"] == 0.5 * whole["left"]["tick_hz"]
    assert {name for name, device in whole.items() if device["process"] == "finger2"} == {"touch2", "wrist2"}
    assert set(TOGETHER) | {"hand"} == set(whole)
    starts = [whole[name]["axis"][0]["motor"]["start"] for name in ("left", "right")]
    assert starts == [-0.5 * OPEN_M, 0.5 * OPEN_M]


def test_pictures_of_a_demonstration_are_written(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    from PIL import Image

    from sioms.hand.command.film import COLOURS, SIZE, SWIFT, animation, picture

    frames, outline = _frames(40), [(float(x), float(y)) for x, y in ellipse(0.031, 0.022).points]
    picture(tmp_path / "hand.png", frames, outline, [(0.5, "one"), (2.0, "two")])
    assert (tmp_path / "hand.png").stat().st_size > 20_000
    animation(tmp_path / "hand.gif", frames, outline, 12.5)
    with Image.open(tmp_path / "hand.gif") as film:
        counts = [math.ceil(10 / SWIFT.get(state, 1)) for state in ("close", "feel", "hold", "killed")]
        assert film.size == SIZE and film.n_frames <= sum(counts)  # equal ones are one
        for number, state in ((0, "close"), (film.n_frames - 1, "killed")):
            film.seek(number)
            seen = film.convert("RGB").getpixel((5, 5))
            wanted = [int(COLOURS[state][i : i + 2], 16) for i in (1, 3, 5)]
            assert seen == pytest.approx(wanted, abs=8)  # of the palette


def test_the_terminal_shows_the_prober_and_what_was_touched() -> None:
    frame, outline = _frames(8)[0], [(float(x), float(y)) for x, y in ellipse(0.031, 0.022).points]
    bare = replace(frame, prober=None, known=Known())
    assert drawn(frame, outline) != drawn(replace(frame, prober=None), outline) != drawn(bare, outline)


def test_what_touches_let_believe_is_an_outline_through_them() -> None:
    """Of a square of 40 mm with corners of 2 mm, touched on all sides and one corner."""
    around, c = Around(), math.sqrt(0.5)
    corner = 0.018 + 0.002 * c
    around.add([_touch(-0.02, 0.0, math.pi), _touch(0.02, 0.001, 0.0)], 0.0, 0.0, 0.0)
    around.add([_touch(0.0, -0.02, -0.5 * math.pi), _touch(0.0, 0.02, 0.5 * math.pi)], 0.0, 0.0, 0.5 * math.pi)
    around.add([_touch(corner, corner, 0.25 * math.pi)], 0.0, 0.0, 0.25 * math.pi)
    assert len(around.touches) == 5
    points = around.outline()
    assert np.abs(points).max() < 0.024
    for touch in around.touches:
        assert np.min(np.hypot(*(points - touch.point).T)) < 0.02  # points are at corners
    assert np.max(points[:, 0]) == pytest.approx(0.02, abs=3e-4)
