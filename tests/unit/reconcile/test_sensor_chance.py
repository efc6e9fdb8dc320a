"""What chance makes of few rows: no view is above its floor by it, and no load is told to be more certain."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from sioms.reconcile.files.finger import read_experiments, read_model
from sioms.reconcile.finger.data import TOUCH
from sioms.reconcile.finger.prepare import prepare
from sioms.reconcile.sensors.search import Searcher
from sioms.reconcile.sensors.subject import by_chance
from sioms.reconcile.thresholds import SENSOR
from sioms.reconcile_selftest.finger_draw import draw_finger
from sioms.reconcile_selftest.finger_world import FingerWorld

DRAWS = 20_000


@pytest.mark.parametrize("count", [12, 22, 60, 140])
def test_a_scatter_of_few_differences_is_hardly_ever_lower_than_chance_allows(count: int) -> None:
    noise = np.random.default_rng(count).standard_normal((DRAWS, count + 2))
    seen = 1.4826 * np.median(np.abs(np.diff(noise, 2, axis=1)), axis=1) / np.sqrt(6.0)
    assert np.mean(seen * by_chance(count) < 1.0) < 0.008
    assert np.mean(seen * (1.0 + 2.0 / np.sqrt(count + 2)) < 1.0) > 0.04, "what had been allowed"


@pytest.mark.parametrize("count", [24, 72, 400])
def test_white_noise_of_few_rows_is_not_above_the_floor(count: int) -> None:
    searcher: Any = SimpleNamespace(data=SimpleNamespace(view=np.zeros(count, dtype=np.int64), views=("strength",)))
    (limit,) = Searcher.beyond_chance(searcher, SENSOR.floor)
    ratio = np.sqrt(np.mean(np.random.default_rng(count).standard_normal((DRAWS, count)) ** 2, axis=1))
    assert np.mean(ratio > limit) < 0.003
    assert count > 400 or np.mean(ratio > SENSOR.floor) >= (0.03 if count < 100 else 0.0)
    assert (limit == SENSOR.floor) == (count == 400)


def test_loads_of_few_touches_are_not_told_to_be_more_certain_than_they_are(tmp_path: Path) -> None:
    finger = draw_finger("f", "null", np.random.default_rng(3))
    places = np.radians(np.arange(20.0, 130.0, 4.0))
    touches = FingerWorld(finger, np.random.default_rng(4)).touches(places, np.full(28, 200.0), np.zeros(28))
    np.savez(tmp_path / "edge.npz", **touches)  # type: ignore[arg-type]
    (tmp_path / "nominal.toml").write_text(finger.public())
    nominal, name, _ = read_model(tmp_path / "nominal.toml", tmp_path)
    d = prepare(read_experiments(tmp_path), nominal, name).training
    measured, rng, seen = d.measured(), np.random.default_rng(5), []
    for _ in range(400):  # loads that are as uncertain as stated, and nothing else
        off = 1.0 + d.load_share * rng.standard_normal(len(d.touched))
        said = measured.copy()
        said[d.view == TOUCH] = (measured[d.view == TOUCH].reshape(len(off), -1) * off[:, None]).ravel()
        seen.append(d.scatter(said))
    assert np.mean(np.array(seen) < 0.9) < 0.01
    assert np.median(seen) < 4.0
