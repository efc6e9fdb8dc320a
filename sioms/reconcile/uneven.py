"""The numbers of what is named: they must be the same everywhere.

An effect of a form near the one that is named leaves little, in no shape that a smoother of the state finds, for its
own shape is the name's: friction that falls as it heats leaves friction where the axis is warmer than the name has it.
So the numbers of each name are let change with each variable; where what remains asks for that, the law is another one.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from sioms.reconcile.blocks import better
from sioms.reconcile.effect import Array
from sioms.reconcile.effects import known
from sioms.reconcile.engine.evidence import unseen
from sioms.reconcile.fit import Fit, Problem, block_ids
from sioms.reconcile.locate import variables
from sioms.reconcile.refuse import RIDGES, hats, knots
from sioms.reconcile.screen import dead_band, instrument_motion, thinned
from sioms.reconcile.thresholds import SURE, UNEVEN, UNEVEN_PATH

#: Places over a variable between which a number changes evenly, and parts of the blocks of time that are left out in
#: turn.
PLACES, FOLDS = 6, 5


@dataclass(frozen=True, slots=True)
class Uneven:
    """An effect whose numbers are not the same everywhere.

    Attributes:
        share: of what remains that is explained, on blocks of time not fitted to, where they change with a variable.
        errors: by how many standard errors.
    """

    effect: str
    variable: str
    share: float
    errors: float


def uneven(problem: Problem, fit: Fit, names: Iterable[str]) -> list[Uneven]:
    """Return those of the effects of a fit whose numbers surely change, each with the variable that explains most."""
    over = _over(problem, fit)
    found = []
    for name in names:
        most = max(_changes(problem, fit, name, over), key=lambda u: u.share, default=None)
        # what builds up over a path is over within a few rows, where no step of a model is exact
        least = UNEVEN_PATH if known()[name].mechanism.builds_up else UNEVEN
        if most is not None and most.share >= least and most.errors >= SURE:
            found.append(most)
    return found


def _over(problem: Problem, fit: Fit) -> dict[str, Array]:
    """Return the variables over which numbers are let change, for the rows of ``thinned``."""
    told = variables(instrument_motion(problem, fit.model), fit.model, dead_band(problem, fit.model))
    return {name: problem.join(parts)[thinned(len(fit.residual))] for name, (_, parts) in told.items()}


def _changes(problem: Problem, fit: Fit, name: str, over: Mapping[str, Array]) -> Iterator[Uneven]:
    """Yield what is explained where the numbers of an effect change with one variable after the other."""
    rows = thinned(len(fit.residual))
    left, ids = fit.residual[rows], block_ids(problem, fit.model.sample_time_s)[rows]
    slopes = fit.jacobian[rows][:, [f.effect == name for f in fit.free]]
    for variable, at in over.items():
        columns = np.concatenate([hats(at, knots(at, PLACES)) * s[:, None] for s in slopes.T], axis=1)
        size = np.sqrt(np.mean(columns**2, axis=0))
        columns = columns[:, size > 0.0] / size[size > 0.0]
        less = unseen(columns, left, ids % FOLDS, [1e-2 * ridge for ridge in RIDGES])
        after, before = (np.asarray(np.bincount(ids, weights=r**2), dtype=np.float64) for r in (less, left))
        yield Uneven(name, variable, *better(after, before))
