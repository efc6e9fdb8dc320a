"""Axes without a drive: a pendulum that swings out, a machine that coasts, one that only a known force moves."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from sioms import reconcile
from sioms.reconcile.errors import BadInputError
from sioms.reconcile.files.axis import read_data
from sioms.reconcile.model import AxisModel
from sioms.reconcile.model_file import parse_model, write_model
from sioms.reconcile.records import Record, Session

DT, J, B, WEIGHT = 0.01, 2e-3, 3e-4, 0.08
FREE = AxisModel(True, DT, J, B, 0.0, 2 * np.pi, WEIGHT, 8.0, driven=False, refine=("viscous",))


def swing(start: float, push: NDArray[np.float64], seed: int) -> NDArray[np.float64]:
    """Integrate a pendulum about its lower rest finely, and read it with some noise."""
    x, v, fine, out = start, 0.0, 50, []
    for f in push:
        out.append(x)
        for _ in range(fine):
            v += DT / fine * (f - WEIGHT * np.sin(x) - B * v) / J
            x += DT / fine * v
    return np.array(out) + np.random.default_rng(seed).normal(scale=1e-4, size=len(out))


def test_a_pendulum_that_swings_out_shows_its_weight() -> None:
    linear = replace(FREE, effects={"spring": {"k": WEIGHT}})
    records = tuple(Record(f"swing {i}", swing(a, np.zeros(600), i), np.zeros(600)) for i, a in enumerate((1.2, -0.9)))
    verdict = reconcile.analyse(Session(records), linear)
    assert verdict.model.effects["gravity"]["amp"] == pytest.approx(WEIGHT, rel=0.02)
    assert "spring" not in verdict.model.effects


def test_nothing_is_asked_of_a_drive_that_is_not_there(tmp_path: Path) -> None:
    np.savez(tmp_path / "run.npz", phi=swing(1.0, np.zeros(200), 1), push=np.ones(200))
    (tmp_path / "columns.toml").write_text('[columns]\nposition = { name = "phi", unit = "rad" }\n')
    (record,) = read_data(tmp_path, FREE).records
    np.testing.assert_array_equal(record.force, 0.0)
    with pytest.raises(BadInputError, match=r"names no force.*driven = false"):
        read_data(tmp_path, replace(FREE, driven=True))
    (tmp_path / "columns.toml").write_text(
        '[columns]\nposition = { name = "phi", unit = "rad" }\nforce = { name = "push", unit = "N m" }\n'
    )
    with pytest.raises(BadInputError, match=r"names force, the model says driven = false.*external"):
        read_data(tmp_path, FREE)


def test_a_dead_force_channel_is_still_an_error() -> None:
    record = Record("run", swing(1.0, np.zeros(400), 1), np.zeros(400))
    with pytest.raises(BadInputError, match=r"force is constant at 0.*driven = false"):
        reconcile.analyse(Session((record,)), replace(FREE, driven=True))


def test_a_model_file_says_that_there_is_no_drive() -> None:
    text = write_model(FREE)
    assert parse_model(text, "model.toml").driven is False
    assert "driven" not in write_model(replace(FREE, driven=True))
    with pytest.raises(BadInputError, match="an axis without a drive has no controller"):
        parse_model(text + "[controller]\nk = 1.0\nkz = 0.0\nkp = 0.0\nkb = 0.0\noffset = 0.0\nlimit = 1.0\n"
                    "velocity_filter_hz = 0.0\n", "model.toml")  # fmt: skip
