"""The live workflow of a hand: what it asks for, what it records, what it makes of a failure and of a verdict."""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import sioms
from sioms.hand.live.surveying import Nodes
from sioms.hand.model import model_of
from sioms.hand.survey import BAR, COLUMNS, DISK, SLIPS_N, Thing
from sioms.hand.touch import Failed, Fault
from sioms.lab.stopping import ExperimentStopped
from sioms.reconcile.command.subjects import SUBJECTS
from sioms.reconcile.errors import BadInputError
from sioms.reconcile.files.hand import known, read_grasps
from sioms.reconcile.hand.model_file import from_table
from sioms.reconcile.live import hand as workflow
from sioms.reconcile.live.hand import Grasping, live
from sioms.reconcile.sensors.verdict import Proposal
from sioms.reconcile.verdict import Outcome


class Cell:
    """Carries plans out by making rows of them."""

    def __init__(self) -> None:
        self.carried: list[tuple[Thing, int, bool, float]] = []
        self.asked: list[str] = []
        self.fails: Failed | None = None

    @contextmanager
    def surveying(self, cell: Any, nodes: Nodes, thing: Thing, slips: bool) -> Iterator[Any]:
        survey = SimpleNamespace(rows=[], events=[])

        def carry(plan: Sequence[Any], first: int) -> int:
            if self.fails is not None:
                raise self.fails
            self.carried.append((thing, len(plan), slips, max(plan[0].loads)))
            for number, setting in enumerate(plan):
                for i, load in enumerate(setting.loads):
                    row = dict.fromkeys(COLUMNS, 0.0) | {"time": 10.0 * number + i, "grasp": float(first + number)}
                    row |= {
                        "kind": float(thing.kind),
                        "thing": float(thing.number),
                        "size": thing.size_m,
                        "load1": load,
                    }
                    survey.rows.append([row[name] for name in COLUMNS])
            return len(plan)

        yield survey, carry


@pytest.fixture
def cell(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Cell:
    found = Cell()
    monkeypatch.setattr(workflow, "surveying", found.surveying)
    monkeypatch.setattr(workflow, "have_done", lambda text, without: found.asked.append(text))
    monkeypatch.setattr(sioms, "Workcell", lambda *_: found_cell())
    (tmp_path / "nominal.toml").write_text("[hand]\n")
    return found


@contextmanager
def found_cell() -> Iterator[None]:
    yield None


def verdicts(*outcomes: tuple[Outcome, tuple[str, ...]]) -> Any:
    """Return an analysis that comes to these outcomes, one after the other, with these experiments to decide."""
    left = list(outcomes)

    def analyse(data: Path, *_: Any) -> Any:
        outcome, names = left.pop(0)
        grasps = read_grasps(data)
        proposals = tuple(Proposal(name, name, 9.0 - i) for i, name in enumerate(names))
        return SimpleNamespace(outcome=outcome, effects=(), alternatives=(), experiments=proposals, grasps=grasps)

    return analyse


def test_objects_are_requested_one_by_one_and_what_decides_is_made(
    cell: Cell, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(
        workflow, "reconcile_hand", verdicts((Outcome.AMBIGUOUS, ("wrists", "loads")), (Outcome.NAMED, ()))
    )
    asked = Grasping(Nodes(), (0.012, 0.03), (0.03,), 0.025, grasps=6, yes=True)
    verdict, _ = live(tmp_path / "nominal.toml", asked, tmp_path / "records", lambda text: None)
    kinds = [(thing.kind, thing.size_m, count, slips) for thing, count, slips, _ in cell.carried]
    assert kinds == [(DISK, 0.012, 6, False), (DISK, 0.03, 6, False), (BAR, 0.03, 6, False), (BAR, 0.025, 3, True),
                     (DISK, 0.012, 6, False)]  # fmt: skip
    assert cell.carried[3][3] == max(SLIPS_N) and cell.carried[4][3] == max(workflow.HEAVY)
    assert [text.split(" mm")[0] for text in cell.asked] == [
        "lay a disk of 30", "lay a bar of 30", "clamp a bar of 25", "lay a disk of 12",
    ]  # fmt: skip
    grasps = verdict.grasps  # type: ignore[attr-defined]
    assert np.all(np.diff(grasps.grasp) >= 0) and np.all(np.diff(grasps.time) >= 0.0) and len(set(grasps.grasp)) == 27
    assert (tmp_path / "records" / "grasps.csv").exists()


def test_one_object_first_and_the_others_only_when_they_decide(
    cell: Cell, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(workflow, "reconcile_hand", verdicts((Outcome.AMBIGUOUS, ("sizes",)), (Outcome.NAMED, ())))
    asked = Grasping(Nodes(), (0.012, 0.03), grasps=12, full=False, yes=True)
    live(tmp_path / "nominal.toml", asked, tmp_path / "records", lambda text: None)
    assert [thing.size_m for thing, *_ in cell.carried] == [0.012, 0.03]


@pytest.mark.parametrize(("asked", "said"), [
    (Grasping(Nodes(), yes=True), "no object"),
    (Grasping(Nodes(), (0.02,), grasps=3, yes=True), "needs 10 in all"),
    (Grasping(Nodes(wrists=()), (0.02,), clamped=0.03, yes=True), "no --clamped bar"),
    (Grasping(Nodes(wrists=("wrist1",)), (0.02,), yes=True), "1 wrists; needs two"),
    (Grasping(Nodes(), (0.02,)), "nobody to ask"),
    (Grasping(Nodes(), (0.02, 5.0), yes=True), r"hand: .* radius of the disk is 5 m; want less than 0.5"),
    (Grasping(Nodes(), (0.02,), clamped=30.0, yes=True), "the width of the bar is 30 m"),
])  # fmt: skip
def test_what_cannot_be_is_refused_before_anything_moves(
    cell: Cell, tmp_path: Path, asked: Grasping, said: str
) -> None:
    with pytest.raises(BadInputError, match=said):
        live(tmp_path / "nominal.toml", asked, tmp_path / "records", lambda text: None)
    assert not cell.carried and not (tmp_path / "records").exists()


def test_a_hand_that_fails_is_an_experiment_that_was_stopped(cell: Cell, tmp_path: Path) -> None:
    cell.fails = Failed(Fault.NOTHING_THERE, "survey object: nothing is touched; want an object between them")
    asked = Grasping(Nodes(), (0.02,), yes=True)
    with pytest.raises(ExperimentStopped, match=r"nothing is touched; .* the hand stands"):
        live(tmp_path / "nominal.toml", asked, tmp_path / "records", lambda text: None)


def test_what_is_found_is_what_the_driver_loads(tmp_path: Path) -> None:
    """Friction that falls to 0.8 of the table at 4 N leaves 0.8 of its least, 1.4."""
    nominal = from_table({"hand": {"joint_stiffness": 3.0}}, "x")[0]
    found = nominal.with_effect("link_length_1", {"dl": np.array([0.002])})
    found = found.with_effect("mounting_angle_2", {"beta": np.array([0.026])})
    found = found.with_effect("joint_stiffness_1", {"share": np.array([-0.2])})
    found = found.with_effect("load_gain_2", {"g": np.array([0.1])})
    power = math.log(0.8) / math.log(4.0)
    found = found.with_effect("friction_load", {"m": np.array([power]), "c": np.array([0.0])})
    (tmp_path / "nominal.toml").write_text("[hand]\njoint_stiffness = 3.0\n")
    args = argparse.Namespace(out=tmp_path, model=tmp_path / "nominal.toml")
    SUBJECTS["hand"].write(args, SimpleNamespace(model=found))
    model = model_of((tmp_path / "hand.toml").read_text())
    assert model == known(found)
    assert model.link_m == pytest.approx((0.142, 0.14)) and model.mount_rad == pytest.approx((0.0, 0.026))
    assert model.load_gain == pytest.approx((0.0, 0.1))
    assert model.joint_stiffness == pytest.approx((2.4, 3.0)) and model.friction == pytest.approx(1.4 * 0.8)
