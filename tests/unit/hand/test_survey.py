"""A survey of a known object: its plan, its recording, and grasps on a simulated plane that hides nothing."""

from __future__ import annotations

import contextlib
import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from sioms.hand import survey
from sioms.hand.command import record
from sioms.hand.live.beside import Beside
from sioms.hand.plane import PlaneHand, Rig
from sioms.hand.survey import BAR, COLUMNS, DISK, PHI, PSI, Survey, Thing, rows_of, settings, text_of
from sioms.hand.touch import Felt, Manner
from sioms.plant.outline import disk, rectangle
from sioms.plant.planar import Body, Mount
from sioms.reconcile.files import hand as reconciled


def test_a_plan_covers_directions_and_both_fingers_apart_with_small_turns() -> None:
    plan = settings(20, (1.0, 0.5))
    psi, one, two = (np.array([getattr(s, name) for s in plan]) for name in ("psi", "phi1", "phi2"))
    assert np.ptp(psi) > 1.8 * PSI and np.max(np.abs(np.diff(psi))) < 0.35
    for phi in (one, two):
        assert PHI[0] <= phi.min() < PHI[0] + 0.1 and PHI[1] - 0.1 < phi.max() <= PHI[1]
    assert abs(np.corrcoef(one, two)[0, 1]) < 0.6
    assert all(s.loads == (0.5, 1.0) for s in plan)
    with pytest.raises(ValueError, match="want some above 0"):
        settings(3, ())


def test_a_recording_is_read_by_what_analyses_it(tmp_path: Path) -> None:
    assert set(COLUMNS) == set(reconciled.COLUMNS)
    row = np.arange(float(len(COLUMNS)))
    row[2], row[-1] = 1.0, 0.0
    row[COLUMNS.index("fx1") : COLUMNS.index("slip")] = math.nan
    text = text_of([row.tolist(), (row + 0.0).tolist()])
    assert "fx1" not in text.splitlines()[0]
    (tmp_path / "a.csv").write_text(text)
    read = reconciled.read_grasps(tmp_path / "a.csv")
    assert len(read) == 2 and read.load[0].tolist() == [row[COLUMNS.index(f"load{i}")] for i in (1, 2)]
    assert not read.weighed.any() and read.told.all()
    assert np.array_equal(rows_of(text), [row, row], equal_nan=True)
    with pytest.raises(ValueError, match="its columns are"):
        rows_of("a,b\n1,2\n")


def test_known_objects_are_disks_and_bars() -> None:
    assert Thing(DISK, 0.02).apart_m == 0.04
    with pytest.raises(ValueError, match="want 1, a disk, or 2, a bar"):
        Thing(0, 0.02)


def test_a_survey_records_grasps_that_close_on_the_object(tmp_path: Path) -> None:
    """A hand that is as stated closes to a tenth of a millimetre, and its drives bend as Table 4.1 says."""
    hand = PlaneHand(Body(disk(0.02)), (1e-3, -2e-3, 0.0), Rig(every=4, compiled=False), Mount(), seed=1)
    survey = Survey(hand.hand, hand.reading, Thing(DISK, 0.02), Manner(frames=10))
    told: list[str] = []
    survey.progress = told.append
    assert hand.run(survey.carry_out(settings(1, (0.5, 1.5)), hand.beside)) == 1 and not hand.is_held()
    assert told == ["grasp 1 of 1, 2 rows"]
    (tmp_path / "a.csv").write_text(text_of(survey.rows))
    read = reconciled.read_grasps(tmp_path / "a.csv")
    assert len(read) == 2 and read.load[:, 0] == pytest.approx([0.5, 1.5], rel=0.15)
    from sioms.reconcile.hand.belief import gaps
    from sioms.reconcile.hand.model_file import from_table

    found = gaps(from_table({"hand": {}}, "x")[0].base, read)
    assert np.max(np.abs(found.along)) < 1.5e-4 and np.max(np.abs(found.across)) < 3e-4
    assert np.max(np.abs(found.wrist)) < 0.05
    assert np.max(np.abs(found.drive)) < 2e-4  # of 0.8 rad: while the damper still moves, more


def test_fingers_that_are_dragged_along_a_clamped_bar_tell_friction_under_each_load(tmp_path: Path) -> None:
    """What is hidden is a coefficient that falls with the load; flat contacts have 2.0 by Table 4.2."""
    mount = Mount(friction_by_load=((0.4, 1.0), (1.2, 0.6)))
    body = Body(rectangle(0.03, 0.08, 2e-3), record.CLAMPED_KG, record.CLAMPED)
    hand = PlaneHand(body, (1e-3, -2e-3, 0.0), Rig(every=4, compiled=False), mount, seed=1)
    survey = Survey(hand.hand, hand.reading, Thing(BAR, 0.03), Manner(frames=10))
    assert hand.run(survey.slide(settings(1, (0.4, 1.2)), hand.beside)) == 1
    assert hand.world.pose == pytest.approx([1e-3, -2e-3, 0.0], abs=1e-5)
    (tmp_path / "a.csv").write_text(text_of(survey.rows))
    read = reconciled.read_grasps(tmp_path / "a.csv")
    assert read.slip.tolist() == [1, 2, 1, 2]
    normal, shear = np.abs(read.wrist[..., 0]), np.abs(read.wrist[..., 1])
    hidden = 2.0 * np.interp(normal, [0.4, 1.2], [1.0, 0.6])
    assert shear / normal == pytest.approx(hidden, rel=0.03)


def test_a_cell_records_what_encoders_read_and_not_where_the_hand_knows_its_joints_to_be() -> None:
    """The hand knows of springs behind its encoders: joints that are corrected by them hide how stiff they are."""

    class Module:
        name = "left"

        def read(self) -> Any:
            return SimpleNamespace(position=(0.1, 0.2, 0.3), following_error=(0.01, 0.0, -0.2))

    class Cell:
        def open(self, name: str) -> Any:
            return contextlib.nullcontext(Module())

    cell: Any = Cell()
    felt = [Felt(True, 1.5, 0.0, 0.9), Felt(True, 1.6, 0.0, 1.1)]
    with Beside(cell, ("left", "right"), ()) as beside:
        row = beside.read(felt)
    module = [0.1, 0.2, 0.3]
    assert row[:6] == module * 2 and row[6:10] == [1.5, 1.6, 0.9, 1.1]
    assert row[10:16] == pytest.approx([0.11, 0.2, 0.1] * 2) and all(map(math.isnan, row[16:]))


@pytest.mark.parametrize(("text", "said"), [
    ("[finger3]\nlink_m = 0.14\n", "nobody reads finger3"),
    ("[finger1]\nlinks = 0.14\n", "unexpected keyword argument 'links'"),
    ("[finger1]\nlink_m = -1.0\n", "finger1: .*link_m is -1"),
    ("[finger2]\nlink_m = 'x'\n", "finger2: "),
    ("[finger1]\nturned_rad = nan\n", "turned_rad is nan; want an angle within pi"),
    ("[finger1]\nturned_rad = 'x'\n", "finger1: could not convert"),
    ("[finger1]\nfriction_by_load = [[1.0, 1.0], [0.5, 2.0]]\n", "that rise"),
    ("[finger1]\nfriction_by_load = [[1.0, -1.0]]\n", "a factor of 0 or more"),
])  # fmt: skip
def test_what_a_simulated_hand_hides_is_checked(tmp_path: Path, text: str, said: str) -> None:
    (tmp_path / "h.toml").write_text(text)
    with pytest.raises(ValueError, match=said):
        record.hidden(tmp_path / "h.toml")


def test_what_a_simulated_hand_hides_is_read(tmp_path: Path) -> None:
    (tmp_path / "h.toml").write_text("[finger2]\nlink_m = 0.142\nturned_rad = 0.026\n")
    mounts, turned = record.hidden(tmp_path / "h.toml")
    assert mounts == (Mount(), Mount(link_m=0.142)) and turned == (0.0, 0.026)
    assert record.hidden(None) == ((Mount(), Mount()), (0.0, 0.0))


def test_records_that_are_too_few_are_told_by_what_is_missing() -> None:
    assert survey.missing(21, 7) == "9 more rows and 3 more grasps"
    assert survey.missing(29, 12) == "1 more row" and survey.missing(36, 9) == "1 more grasp"
    assert survey.missing(survey.LEAST_ROWS, survey.LEAST_GRASPS) == ""


@pytest.mark.parametrize("loads", [(), (0.0, 1.0), (-0.5,), (0.5, 50.0), (math.nan,), (math.inf,)])
def test_forces_that_no_finger_bears_are_refused_before_anything_moves(loads: tuple[float, ...]) -> None:
    with pytest.raises(ValueError, match=r"above 0 and below .* N, an overload"):
        settings(3, loads)
