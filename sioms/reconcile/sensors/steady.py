"""Is a named effect as large everywhere? A true one has the same numbers at all loads, places and times; a stand-in has
not.

What an effect contributes is let grow along each variable that a disagreement may go with, all numbers of the model
free.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import rankdata
from scipy.stats import t as student

from sioms.reconcile.sensors.effect import Array
from sioms.reconcile.sensors.fit import Data, Fit
from sioms.reconcile.sensors.subject import Variable
from sioms.reconcile.thresholds import SENSOR


@dataclass(frozen=True, slots=True)
class Change:
    """An effect is 1 - share to 1 + share as large, from the least to the most of a variable; half a 95 % interval."""

    effect: str
    variable: str
    share: float
    half: float


def changes(data: Data, fit: Fit, weights: Array, names: Iterable[str], variables: Sequence[Variable]) -> list[Change]:
    """Return how effects of a fitted model change along variables."""
    out = []
    full, known = data.predict(fit.model), np.linalg.qr(fit.jacobian)[0]
    edges = np.flatnonzero(np.diff(data.block, prepend=-1))
    for name in names:
        own = full - data.predict(fit.model.without_effect(name))
        for v in variables:
            z = np.zeros(len(own))
            place = rankdata(v.values) - 0.5 * (len(v.values) + 1)
            z[data.view == v.view] = place / max(float(np.abs(place).max()), 1.0)
            grown = weights * data.whiten(own * z)
            column = grown - known @ (known.T @ grown)
            energy = np.add.reduceat(column**2, edges)
            total = float(energy.sum())
            if total < SENSOR.trace**2 or total < 1e-6 * float(grown @ grown):
                continue
            share = -float(column @ fit.residual) / total
            score = np.add.reduceat(column * (fit.residual + share * column), edges)
            error = np.sqrt(np.sum((score / np.maximum(1.0 - energy / total, 0.05)) ** 2)) / total
            count = total**2 / float(np.sum(energy**2))
            out.append(Change(name, v.name, share, float(student.ppf(0.975, max(count - 1.0, 1.0)) * error)))
    return out
