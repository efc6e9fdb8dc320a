"""A survey of a known object: its plan, its recording, and grasps on a simulated plane that hides nothing."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from sioms.hand.command import record
from sioms.hand.plane import PlaneHand, Rig
from sioms.hand.survey import COLUMNS, DISK, PHI, PSI, Survey, Thing, rows_of, settings, text_of
from sioms.hand.touch import Manner
from sioms.plant.outline import disk
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
    with pytest.raises(ValueError, match="want 1 or 2"):
        Thing(0, 0.02)


def test_a_survey_records_grasps_that_close_on_the_object(tmp_path: Path) -> None:
    """A hand that is as stated closes to a tenth of a millimetre, and its drives bend as Table 4.1 says."""
    hand = PlaneHand(Body(disk(0.02)), (1e-3, -2e-3, 0.0), Rig(every=4, compiled=False), Mount(), seed=1)
    survey = Survey(hand.hand, hand.reading, Thing(DISK, 0.02), Manner(frames=10))
    assert hand.run(survey.carry_out(settings(1, (0.5, 1.5)), hand.beside)) == 1 and not hand.is_held()
    (tmp_path / "a.csv").write_text(text_of(survey.rows))
    read = reconciled.read_grasps(tmp_path / "a.csv")
    assert len(read) == 2 and read.load[:, 0] == pytest.approx([0.5, 1.5], rel=0.15)
    from sioms.reconcile.hand.belief import gaps
    from sioms.reconcile.hand.model_file import from_table

    found = gaps(from_table({"hand": {}}, "x")[0].base, read)
    assert np.max(np.abs(found.along)) < 1.5e-4 and np.max(np.abs(found.across)) < 3e-4
    assert np.max(np.abs(found.drive)) < 0.02 and np.max(np.abs(found.wrist)) < 0.05


@pytest.mark.parametrize(("text", "said"), [
    ("[finger3]\nlink_m = 0.14\n", "nobody reads finger3"),
    ("[finger1]\nlinks = 0.14\n", "unexpected keyword argument 'links'"),
    ("[finger1]\nlink_m = -1.0\n", "link_m is -1.0"),
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
