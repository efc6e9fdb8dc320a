"""The whole workflow on four axes of an independent continuous-time generator, and a small blind self-test.

The truth stands here, not beside the data; the solver is a process of its own in the self-test. Two records of four
say enough of an axis that hides something; one that hides nothing is silent in all four.
"""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from sioms.reconcile import command as reconcile
from sioms.reconcile.axis import analyse
from sioms.reconcile.command.blind import solve
from sioms.reconcile.command.selftest import generate, record, write_public
from sioms.reconcile.excitation import gate
from sioms.reconcile.files.axis import read_data, read_model
from sioms.reconcile.prepare import Options, prepare
from sioms.reconcile.records import Session
from sioms.reconcile.verdict import Outcome
from sioms.reconcile_selftest.axis import Axis, Servo
from sioms.reconcile_selftest.draw import draw_axis
from sioms.reconcile_selftest.score import score

AXES = Path(__file__).parent / "reconcile_axes"


def answer(folder: Path, out: Path) -> tuple[int, dict[str, object]]:
    status = reconcile.main(["axis", str(folder), "--out", str(out), "--quiet"])
    return status, json.loads((out / "verdict.json").read_text())


@pytest.mark.usefixtures("without_pictures")
def test_nothing_hidden_is_silent(tmp_path: Path) -> None:
    status, found = answer(AXES / "s05", tmp_path)
    assert status == 0
    assert found["verdict"] == "none"
    assert found["effects"] == []


def test_stribeck_friction_is_named_with_its_parameters_and_the_gap_closes(tmp_path: Path) -> None:
    for name in ("nominal.json", "rec_0.npz", "rec_1.npz"):
        shutil.copy(AXES / "s18" / name, tmp_path)
    status, found = answer(tmp_path, tmp_path / "report")
    assert status == 0
    assert found["effects"] == ["stribeck"]
    values = found["parameters"]["stribeck"]  # type: ignore[index]
    assert values["Fc"] == pytest.approx(6.473, rel=0.02)
    assert values["Fs"] == pytest.approx(12.344, rel=0.02)
    assert values["vs"] == pytest.approx(0.009992, rel=0.05)
    gaps = {g["channel"]: g for g in found["gaps"]}  # type: ignore[attr-defined]
    told = {name: g for name, g in gaps.items() if g["floor"] is not None}
    assert {"force, short windows", "force, closed loop", "position, closed loop"} <= told.keys()
    assert all(g["closed"] > 0.95 for name, g in told.items() if "whole" not in name)
    assert gaps["force, closed loop"]["after"] == pytest.approx(gaps["force, closed loop"]["floor"], rel=0.34)
    page = (tmp_path / "report" / "report.html").read_text()
    assert "Stribeck" in page
    assert "data:image/png" in page
    assert "src='http" not in page
    corrected = read_model(tmp_path / "report" / "model.toml")
    assert corrected.effects["stribeck"]["Fc"] == values["Fc"]


@pytest.mark.usefixtures("without_pictures")
def test_one_cruising_speed_leaves_coulomb_and_viscous_friction_open(tmp_path: Path) -> None:
    status, found = answer(AXES / "s16", tmp_path)
    assert status == 4
    sets = [set(found["effects"]), *map(set, found["alternatives"])]  # type: ignore[arg-type, call-overload]
    assert {"coulomb"} in sets
    assert {"viscous"} in sets
    (other,) = found["alternative_parameters"]  # type: ignore[misc]
    assert other["viscous"]["b_extra"] == pytest.approx(0.24027 / 9.78, rel=0.05)  # the level over the one speed
    assert found["separation_in_noise"] > 10.0  # type: ignore[operator]
    assert (tmp_path / "experiment.csv").exists()


def test_an_effect_that_would_not_show_at_its_typical_size_is_found_where_it_is_larger(tmp_path: Path) -> None:
    """A slow axis with a coarse encoder: an eccentricity of a thousandth of a turn shows nothing there."""
    hidden = {"eccentricity": {"amp": 0.0623, "phase": -0.11}}
    axis = Axis(
        "slow", "single", True, 0.001, 7.35e-4, 1.57e-4, 0.306, 8.0, 2.0 * np.pi / 2048, 2.0 * np.pi,
        Servo(0.349, 0.0, 0.0, -0.0267, 0.765, 60.5), "full", False, True, 17, hidden,
    )  # fmt: skip
    write_public(axis, record(axis, 3.0), tmp_path / "slow")
    model = read_model(tmp_path / "slow" / "nominal.toml")
    session = read_data(tmp_path / "slow", model)
    ready = prepare(session, model, Options())
    assert "eccentricity" in gate(ready.problem, ready.model, ready.names).missing
    verdict = analyse(session, model, Options(pictures=False))
    assert verdict.outcome is Outcome.NAMED
    assert [e.name for e in verdict.effects] == ["eccentricity"]
    assert verdict.model.effects["eccentricity"]["amp"] == pytest.approx(0.0623, rel=0.03)
    assert "eccentricity" not in verdict.missing


@pytest.mark.timeout(400)
@pytest.mark.usefixtures("without_pictures")
def test_a_drag_outside_the_library_is_refused_and_described(tmp_path: Path) -> None:
    status, found = answer(AXES / "s35", tmp_path)
    assert status == 3
    assert found["effects"] == []
    (term,) = found["symbolic"]  # type: ignore[misc]
    assert term["name"] == "term_falling_drag"
    assert term["parameters"]["c"]["value"] == pytest.approx(0.0349, rel=0.05)
    assert term["parameters"]["v0"]["value"] == pytest.approx(4.329, rel=0.05)


def test_the_same_seed_gives_the_same_verdict() -> None:
    model = read_model(AXES / "s05" / "nominal.json")
    session = read_data(AXES / "s05", model)
    short = Session(tuple(r.cut(0, 1500) for r in session.records[:2]))
    first, second = (analyse(short, model, Options(seed=3)) for _ in "ab")
    assert [p.p for p in first.places] == [p.p for p in second.places]
    assert first.gaps == second.gaps
    assert first.ratio == second.ratio


def test_bad_input_is_an_error_and_no_verdict(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert reconcile.main(["axis", str(tmp_path / "none"), "--out", str(tmp_path / "r")]) == 2
    assert "bad input" in capsys.readouterr().err
    assert not (tmp_path / "r").exists()


@pytest.mark.timeout(400)
def test_a_small_blind_test(tmp_path: Path) -> None:
    """A generated axis, solved by a process that sees the public part only; s05 above hides nothing."""
    rng = np.random.default_rng(11)
    draw_axis("quiet", "null", rng)
    axis = draw_axis("late", "single", rng, "delay")
    folder = tmp_path / axis.name
    write_public(axis, record(axis, 1.2), folder)
    assert not any("delay" in p.read_text() for p in folder.glob("*.toml"))
    assert score(axis, solve(folder, "axis", "--jobs", "1")).right


def test_the_draw_is_reproducible_and_mixed() -> None:
    drawn = generate(6, 5)
    assert drawn[:3] == generate(3, 5)
    assert {a.kind for a in drawn} == {"null", "single", "multi", "unknown", "confounded"}
