"""What the picture of a recording shows."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from recording_rig import NODES, slots, write_slots

from sioms.recording.command import picture
from sioms.recording.command.picture import draw, panels
from sioms.recording.reader import Recording

EVER = 1 << 62


@pytest.fixture
def recording(tmp_path: Path) -> Recording:
    """A recording in which the second axis and all forces stand still."""
    told = [slots(node, 1, 50) for node in NODES]
    told[0][:, 5] = told[0][0, 5]
    told[1][:, 4:] = np.full(12, 0.5).view("<u8")
    return Recording(write_slots(tmp_path / "a.mcap", NODES, told))


def test_a_panel_has_one_unit_and_what_stands_still_is_text(recording: Recording) -> None:
    drawn, still = panels(recording, [], None, 0, EVER)
    assert [(each.title, each.unit, [curve[0] for curve in each.curves], each.steps) for each in drawn] == [
        ("mod0", "m", ["a position"], False),
        ("mod0", "rad", ["c position"], False),
        ("io0.in", "", ["a"], True),
    ]
    assert still[0].startswith("mod0 b position ") and still[0].endswith(" m")
    assert still[1:4] == [f"force0 {name} 0.5 N" for name in "abc"] and still[4] == "force0 d 0.5 N*m"


def test_what_is_asked_for_is_drawn_in_any_case(recording: Recording) -> None:
    drawn, still = panels(recording, ["force0"], None, 0, EVER)
    assert [(each.unit, len(each.curves)) for each in drawn] == [("N", 3), ("N*m", 3)] and not still


def test_a_picture_has_a_row_a_panel_and_the_text_below(recording: Recording) -> None:
    figure = draw(recording, [], None, 0, EVER)
    assert [axes.get_ylabel() for axes in figure.axes] == ["[m]", "[rad]", ""]
    assert "unchanged: mod0 b position" in figure.get_supxlabel()


def test_what_would_be_too_much_for_a_picture_is_named(recording: Recording, monkeypatch: pytest.MonkeyPatch) -> None:
    """A workcell of hundreds of axes that all move."""
    monkeypatch.setattr(picture, "MOST_DRAWN", 2)
    figure = draw(recording, [], None, 0, EVER)
    assert [axes.get_ylabel() for axes in figure.axes] == ["[m]", "[rad]"]
    assert "not drawn, name them to see them: io0.in" in figure.get_supxlabel()


def test_where_nothing_changes_there_is_only_text(recording: Recording, tmp_path: Path) -> None:
    told = [slots(NODES[1], 1, 5)]
    told[0][:, 4:] = np.full(12, 0.5).view("<u8")
    with Recording(write_slots(tmp_path / "b.mcap", NODES[1:2], told)) as still:
        figure = draw(still, [], None, 0, EVER)
    assert not figure.axes and "force0 a 0.5 N" in figure.get_supxlabel()
    figure.savefig(tmp_path / "b.png")
