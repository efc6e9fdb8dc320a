"""What chance makes of few rows: no view is above its floor by it, and no load is told to be more certain."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from sioms.reconcile.sensors.search import Searcher
from sioms.reconcile.sensors.subject import by_chance
from sioms.reconcile.thresholds import SENSOR

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
