"""Refusal for sensors: could anything that depends on the state explain what is left, or does it come in bursts?"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from sioms.reconcile.engine.evidence import unseen
from sioms.reconcile.sensors.effect import Array
from sioms.reconcile.sensors.fit import Data, Fit

FOLDS = 5
#: Of the squares of a column; strong ones for many columns beside few rows.
RIDGES = (1e-6, 1e-4, 1e-2, 0.1, 1.0)


def smoother_shares(data: Data, fit: Fit, weights: Array, features: Mapping[int, Array]) -> dict[int, float]:
    """Share of the residual of each view that a generic smoother explains on blocks it has not seen.

    Args:
        features: columns of the state for the rows of a view, shape (rows, k), by the number of the view.
    """
    out = {}
    for view, columns in features.items():
        mine = data.view == view
        r = fit.residual[mine] / weights[mine]
        size = np.sqrt(np.mean(columns**2, axis=0))
        f = columns[:, size > 1e-12] / size[size > 1e-12]
        total = float(r @ r)
        left = unseen(f, r, data.block[mine] % FOLDS, RIDGES) if f.shape[1] and total else r
        out[view] = 1.0 - float(left @ left) / total if total else 0.0
    return out


def burst_share(residual: Array, groups: NDArray[np.int64]) -> float:
    """Share of the energy above the quiet level that the loudest tenth of the groups (touches, samples) holds."""
    energy = np.bincount(groups, weights=residual**2) / np.maximum(np.bincount(groups), 1)
    above = np.clip(energy - np.median(energy), 0.0, None)
    top = np.sort(above)[-max(len(above) // 10, 1) :]
    return float(top.sum() / max(above.sum(), 1e-300))
