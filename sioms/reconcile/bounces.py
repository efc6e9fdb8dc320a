"""A gap whose contacts bounce: a cost of many minima, and a few missed bounces that would outweigh all the rest."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sioms.reconcile.effect import Array, Slot
from sioms.reconcile.effects import known
from sioms.reconcile.fit import Fit, Problem, refit
from sioms.reconcile.model import AxisModel

#: Relative steps in which the numbers of a gap are searched: when it is new, and when it was found beside other effects.
UNPOLISHED = tuple(
    (symbol, width * spread)
    for spread in (0.25, 0.08, 0.025, 0.008)
    for symbol, width in (("gap", 1.0), ("load_fraction", 1.0), ("zeta", 2.0), ("f_contact", 1.0))
)
POLISHED = (("gap", 0.08), ("gap", 0.025), ("gap", 0.008))
BOUNCE = 3.0  # in units of the median residual


def rattles(model: AxisModel) -> bool:
    """Say whether there is a gap, whose bounces leave more than noise does."""
    return any(known()[n].slot is Slot.BACKLASH for n in model.effects)


def polish(
    problem: Problem,
    bent: Problem,
    model: AxisModel,
    frozen: Sequence[str],
    widths: Sequence[tuple[str, float]],
) -> Fit:
    """Fit a backlash: its cost is rough, so search by steps of given relative widths before the smooth fit of the rest.

    Args:
        bent: the same problem, as it is fitted after the search.
    """
    name = next(n for n in model.effects if known()[n].slot is Slot.BACKLASH)
    first = problem.residual(model)
    scale = spread(first)
    best, cost = model, rough(first, scale)
    for symbol, width in widths:
        here = best.effects[name]
        trials = [
            best.with_effect(name, {**here, symbol: here[symbol] * (1.0 + width * sign)})
            for sign in (1.0, -1.0, 0.4, -0.4)
        ]
        trials = [t for t in trials if _inside(t, name)]
        costs = list(problem.mapper(lambda t: rough(problem.residual(t), scale), trials))
        if costs and min(costs) < cost:
            best, cost = trials[int(np.argmin(costs))], min(costs)
    return refit(bent, best, frozen, 4)


def bent(problem: Problem, model: AxisModel) -> Problem:
    """Let what a model leaves by bounces that fall out otherwise count little more than what it leaves elsewhere.

    Few, they hold most of the squares. With these to go by, all other numbers would follow them, and what acts between the bounces
    would not be seen. Source: P. W. Holland, R. E. Welsch, "Robust regression using iteratively reweighted least-squares", Comm.
    Stat. A6 (1977) 813-827.
    """
    return replace(problem, bend=spread(replace(problem, bend=np.inf).residual(model)))


def spread(residual: Array) -> float:
    """Size beyond which a residual counts less: of a bounce that comes a little late or early."""
    return BOUNCE * max(float(np.median(np.abs(residual))), 1.0)


def rough(residual: Array, scale: float) -> float:
    """Sum of squares to which a missed bounce adds little more than a bounce nearly hit (Cauchy's loss)."""
    return float(np.sum(np.log1p((residual / scale) ** 2)))


def _inside(model: AxisModel, name: str) -> bool:
    return all(
        p.lower * model.scale(p) <= model.effects[name][p.symbol] <= p.upper * model.scale(p)
        for p in known()[name].parameters
    )
