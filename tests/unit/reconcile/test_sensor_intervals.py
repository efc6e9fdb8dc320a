"""Intervals of what is fitted beside numbers that are projected out: how often they hold the truth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import NDArray

from sioms.reconcile.blocks import intervals
from sioms.reconcile.sensors.fit import _Whole, _with

Floats = NDArray[np.float64]
GRASPS, ROWS, NUISANCES, TRIALS = 13, 6, 6, 300


@dataclass
class Fit:
    residual: Floats
    jacobian: Floats


def _covered(own: bool, weighted: bool) -> float:
    """Return the share of trials whose interval holds the truth: three numbers, noise that a grasp has in common."""
    random = np.random.default_rng(71)
    ids, held = np.repeat(np.arange(GRASPS), ROWS), 0
    for _ in range(TRIALS):
        columns = random.standard_normal((GRASPS, 3 + NUISANCES))[ids] + 0.3 * random.standard_normal(
            (len(ids), 3 + NUISANCES)
        )
        noise = random.standard_normal(GRASPS)[ids] + 0.3 * random.standard_normal(len(ids))
        weights = np.where(np.arange(len(ids)) % 2, 1.0, 0.7 if weighted else 1.0)
        beside = np.linalg.qr(columns[:, 3:])[0]
        out = np.eye(len(ids)) - beside @ beside.T
        jacobian, seen = weights[:, None] * (out @ columns[:, :3]), weights * (out @ noise)
        at = np.linalg.lstsq(jacobian, seen, rcond=None)[0]
        fit = Fit(seen - jacobian @ at, jacobian)
        mixed = random.permutation(len(ids))  # rows lie by view, not by grasp
        fit, place = Fit(fit.residual[mixed], fit.jacobian[mixed]), ids[mixed]
        found = _with(fit, place, (weights[:, None] * beside)[mixed]) if own else _sorted(fit, place)  # type: ignore[arg-type]
        held += int(np.sum(np.abs(at) < intervals(*found)[:3]))
    return held / (3 * TRIALS)


def _sorted(fit: Fit, ids: NDArray[np.int64]) -> tuple[_Whole, NDArray[np.int64]]:
    order = np.argsort(ids, kind="stable")
    return _Whole(fit.residual[order], fit.jacobian[order]), ids[order]


@pytest.mark.parametrize("weighted", [False, True])
def test_intervals_know_that_what_is_projected_out_is_told_by_the_same_grasps(weighted: bool) -> None:
    assert _covered(own=True, weighted=weighted) > 0.93
    assert _covered(own=False, weighted=weighted) < 0.88, "as it was: projected out once of all"
