"""The whole workflow on recorded grasps of the independent generator; the truth stays in this process."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sioms.reconcile import command as reconcile
from sioms.reconcile.command.selftest_sensors import write_public
from sioms.reconcile.files.hand import read_grasps, read_model
from sioms.reconcile.hand.subject import prepare
from sioms.reconcile.sensors.fit import ratios
from sioms.reconcile_selftest.hand_world import HiddenHand, draw_hand
from sioms.reconcile_selftest.sensors import score_sensor

pytestmark = pytest.mark.timeout(600)  # processor time, of which a busy machine has little
SOUGHT = {"joint_stiffness_2": {"share": -0.2}, "mounting_angle_1": {"beta": float(np.radians(1.5))}}
"""Of what the hand's specification asks for; a link and friction are in the blind test."""


def solve(hidden: HiddenHand, folder: Path) -> tuple[int, dict[str, Any]]:
    write_public(hidden, folder, 7)
    out = folder / "report"
    grasps, model = str(folder / "grasps.npz"), str(folder / "nominal.toml")
    status = reconcile.main(["hand", grasps, "--model", model, "--out", str(out), "--quiet"])
    page = (out / "report.html").read_text()
    assert page.startswith("<!doctype html>") and 'src="data:image' in page
    return status, json.loads((out / "verdict.json").read_text())


def test_effects_at_once_are_named_with_their_sizes_and_corrected(tmp_path: Path) -> None:
    """Both at once; the corrected model, taken as nominal, leaves noise."""
    hidden = HiddenHand("h", "multi", named=SOUGHT)
    status, answer = solve(hidden, tmp_path / "h")
    assert status == 0 and set(answer["effects"]) == set(SOUGHT), (answer["effects"], answer["verdict"])
    for name, values in SOUGHT.items():
        for symbol, true in values.items():
            assert answer["parameters"][name][symbol] == pytest.approx(true, rel=0.04), name
    left = prepare(read_grasps(tmp_path / "h" / "grasps.npz"), *read_model(tmp_path / "h" / "report" / "model.toml"))
    assert np.all(ratios(left.whole, left.model) < 1.2)


@pytest.mark.parametrize(("kind", "only", "exit_status"), [
    ("confounded", "one_load", 4), ("unknown", "finger_radius", 3),
])  # fmt: skip
def test_a_hand_is_judged_right(tmp_path: Path, kind: str, only: str, exit_status: int) -> None:
    hidden = draw_hand("h", kind, np.random.default_rng(11), only)
    status, answer = solve(hidden, tmp_path / "h")
    assert score_sensor(hidden, answer).right, (hidden.named, answer["effects"], answer["verdict"])
    assert status == exit_status
