"""The whole workflow on fingers and force sensors of the independent generator; the truth stays in this process."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from sioms.reconcile import command as reconcile
from sioms.reconcile.command.selftest_sensors import selftest, write_public
from sioms.reconcile_selftest.finger_draw import HiddenFinger, draw_finger
from sioms.reconcile_selftest.force_world import HiddenSensor, draw_sensor
from sioms.reconcile_selftest.sensors import score_sensor


def solve(hidden: HiddenFinger | HiddenSensor, folder: Path) -> tuple[int, dict[str, object]]:
    subject = "tactile" if isinstance(hidden, HiddenFinger) else "force"
    write_public(hidden, folder, 7)
    out = folder / "report"
    status = reconcile.main(
        [subject, str(folder), "--model", str(folder / "nominal.toml"), "--out", str(out), "--quiet"]
    )
    assert (out / "report.html").read_text().startswith("<!doctype html>")
    return status, json.loads((out / "verdict.json").read_text())


@pytest.mark.usefixtures("without_pictures")
@pytest.mark.parametrize(("kind", "only", "exit_status"), [
    ("null", "", 0), ("multi", "", 0), ("unknown", "cubic", 3), ("confounded", "warming", 4),
])  # fmt: skip
def test_a_force_sensor_is_judged_right(tmp_path: Path, kind: str, only: str, exit_status: int) -> None:
    hidden = draw_sensor("s", kind, np.random.default_rng(11), only)
    status, answer = solve(hidden, tmp_path / "s")
    row = score_sensor(hidden, answer)
    assert row.right, (hidden.named, answer["effects"], answer["verdict"])
    assert status == exit_status


@pytest.mark.parametrize(("kind", "only", "exit_status"), [("null", "", 0), ("single", "gain_scatter", 0)])
def test_a_finger_is_judged_right(tmp_path: Path, kind: str, only: str, exit_status: int) -> None:
    hidden = draw_finger("f", kind, np.random.default_rng(12), only)
    status, answer = solve(hidden, tmp_path / "f")
    row = score_sensor(hidden, answer)
    assert row.right, (hidden.named, answer["effects"], answer["verdict"])
    assert status == exit_status
    assert all(e < 0.05 for e in row.errors)
    if hidden.named:
        assert row.closed > 0.9
        assert 'src="data:image' in (tmp_path / "f" / "report" / "report.html").read_text()


@pytest.mark.usefixtures("without_pictures")
def test_one_place_cannot_tell_gain_from_depth(tmp_path: Path) -> None:
    hidden = draw_finger("f", "confounded", np.random.default_rng([900, 7]))
    status, answer = solve(hidden, tmp_path / "f")
    assert status == 4
    named = set(answer["effects"]), *(set(a) for a in answer["alternatives"])  # type: ignore[attr-defined]
    assert {"gain_scatter"} in named and {"depth_scatter"} in named
    assert answer["separating_experiment"]


@pytest.mark.usefixtures("without_pictures")
def test_a_corrected_model_is_right_and_taken_as_nominal_leaves_nothing(tmp_path: Path) -> None:
    hidden = draw_sensor("s", "single", np.random.default_rng(11), "hysteresis")
    status, found = solve(hidden, tmp_path / "s")
    assert status == 0
    assert score_sensor(hidden, found).right, (hidden.named, found["effects"], found["verdict"])
    assert "Pictures need matplotlib" in (tmp_path / "s" / "report" / "report.html").read_text()
    model = tmp_path / "s" / "report" / "model.toml"
    out = tmp_path / "again"
    assert reconcile.main(["force", str(tmp_path / "s"), "--model", str(model), "--out", str(out), "--quiet"]) == 0
    answer = json.loads((out / "verdict.json").read_text())
    assert answer["ladder"][0]["ratio"] < 1.2


def test_the_self_test_prints_its_table(capsys: pytest.CaptureFixture[str]) -> None:
    assert selftest("force", 1, 3, jobs=1) == 0
    said = capsys.readouterr().out
    assert "nothing hidden: silent" in said and "1/1" in said
