"""The whole workflow on recorded grasps of the independent generator; the truth stays in this process."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sioms.reconcile import command as reconcile
from sioms.reconcile.command.selftest_sensors import write_public
from sioms.reconcile_selftest.hand_world import HiddenHand, draw_hand
from sioms.reconcile_selftest.sensors import score_sensor

SOUGHT = {
    "link_length_1": {"dl": 2e-3}, "mounting_angle_2": {"beta": float(np.radians(1.5))},
    "joint_stiffness_2": {"share": -0.2}, "friction_load": {"m": -0.2},
}  # fmt: skip
"""What the hand's specification asks for: 2 mm, 1.5 degrees, 20 %, and friction that depends on the load."""


def solve(hidden: HiddenHand, folder: Path, model: Path | None = None) -> tuple[int, dict[str, Any]]:
    if model is None:
        write_public(hidden, folder, 7)
    out = folder / "report" if model is None else folder / "again"
    model = model or folder / "nominal.toml"
    grasps = str(folder / "grasps.npz")
    status = reconcile.main(["hand", grasps, "--model", str(model), "--out", str(out), "--quiet"])
    page = (out / "report.html").read_text()
    assert page.startswith("<!doctype html>") and 'src="data:image' in page
    return status, json.loads((out / "verdict.json").read_text())


def test_effects_at_once_are_named_with_their_sizes_and_corrected(tmp_path: Path) -> None:
    """All four at once; the corrected model, taken as nominal, leaves nothing."""
    hidden = HiddenHand("h", "multi", named=SOUGHT)
    status, answer = solve(hidden, tmp_path / "h")
    assert status == 0 and set(answer["effects"]) == set(SOUGHT), (answer["effects"], answer["verdict"])
    for name, values in SOUGHT.items():
        for symbol, true in values.items():
            found = answer["parameters"][name][symbol]
            assert found == pytest.approx(true, rel=0.15 if name == "friction_load" else 0.04), name
    status, answer = solve(hidden, tmp_path / "h", tmp_path / "h" / "report" / "model.toml")
    assert status == 0 and answer["ladder"][0]["ratio"] < 1.1  # nothing is added
    assert [step["action"] for step in answer["ladder"]] == ["start"]


@pytest.mark.parametrize(("kind", "only", "exit_status"), [
    ("confounded", "one_load", 4), ("unknown", "finger_radius", 3),
])  # fmt: skip
def test_a_hand_is_judged_right(tmp_path: Path, kind: str, only: str, exit_status: int) -> None:
    hidden = draw_hand("h", kind, np.random.default_rng(11), only)
    status, answer = solve(hidden, tmp_path / "h")
    assert score_sensor(hidden, answer).right, (hidden.named, answer["effects"], answer["verdict"])
    assert status == exit_status


def test_what_straight_links_cannot_show_is_not_named(tmp_path: Path) -> None:
    """One disk with links across the line: a longer link is the zeros of both joints; nothing may be named."""
    hidden = HiddenHand("h", "single", "straight", named={"link_length_1": {"dl": 0.5e-3}})
    _, answer = solve(hidden, tmp_path / "h")
    assert answer["effects"] == [] and answer["verdict"] in ("none", "unexplained")
