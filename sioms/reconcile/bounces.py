"""A gap whose contacts bounce: a cost of many minima, and a few missed bounces that would outweigh all the rest."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sioms.reconcile.effect import Array
from sioms.reconcile.effects import known
from sioms.reconcile.engine.fit import Free, get, put
from sioms.reconcile.fit import Fit, Problem, descended, free_parameters, refit, shifted
from sioms.reconcile.model import AxisModel

#: Relative steps in which the numbers of a gap are searched: when it is new, and when it was found beside other
#: effects.
UNPOLISHED = tuple(
    (symbol, width * spread)
    for spread in (0.25, 0.08, 0.025, 0.008)
    for symbol, width in (("gap", 1.0), ("load_fraction", 1.0), ("zeta", 2.0), ("f_contact", 1.0))
)
POLISHED = (("gap", 0.08), ("gap", 0.025), ("gap", 0.008))
BOUNCE = 3.0  # in units of the median residual
#: Steps over which slopes are taken beside a gap, before and after its numbers are searched, in sizes of the numbers;
#: that of intervals.
STRIDES, INTERVALS = ((0.05, 0.02), (0.01, 0.003)), 0.03
#: Fits from numbers that are off by so many of their sizes, to see what other minima are as deep.
OTHERS, OFF = 3, 0.04
#: Accepted steps of a descent at most, and the gain below which it ends.
STEPS, TOLERANCE = 4, 1e-3


def has_impacts(model: AxisModel) -> bool:
    """Say whether there is a gap, whose bounces leave more than noise does."""
    return any(known()[n].mechanism.bounces for n in model.effects)


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
    name = next(n for n in model.effects if known()[n].mechanism.bounces)
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

    Few, they hold most of the squares. With these to go by, all other numbers would follow them, and what acts between
    the bounces
    would not be seen. Source: P. W. Holland, R. E. Welsch, "Robust regression using iteratively reweighted
    least-squares", Comm. Stat. A6 (1977) 813-827.
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


def deepest(problem: Problem, model: AxisModel, frozen: Sequence[str], rng: np.random.Generator) -> tuple[Fit, ...]:
    """Fit all numbers beside a gap, from the given ones and from others near them; the fit that leaves least comes
    first.

    Every bounce that comes to fall otherwise is a step in the cost: a slope over 0.2 % is that of the nearest step, not
    of the cost, and descent by it ends where it began. Over some per cent steps average out. How far apart the minima
    are that it leads to from here and there is how little the data tell.
    """
    free = free_parameters(model, frozen)
    starts = [model, *(shifted(model, free, OFF * rng.standard_normal(len(free))) for _ in range(OTHERS))]
    judged, fits = bent(problem, model), []
    for end in [model, *(_strode(problem, start, frozen) for start in starts)]:
        r = judged.residual(end)
        fits.append(Fit(end, free, r, np.empty((len(r), 0))))
    best = min(fits, key=lambda fit: fit.cost)
    others = [fit for fit in fits[1:] if fit is not best]
    best = refit(judged, best.model, frozen, STEPS)
    slopes = _secants(judged, best.model, free, get(best.model, free), INTERVALS)
    return replace(best, jacobian=slopes), *others


def _strode(problem: Problem, model: AxisModel, frozen: Sequence[str]) -> AxisModel:
    """Descend by wide slopes, search the numbers of the gap, descend by narrower ones."""
    before, after = STRIDES
    for stride in before:
        model = _stride(problem, model, frozen, stride)
    model = polish(problem, bent(problem, model), model, frozen, UNPOLISHED[4:]).model
    for stride in after:
        model = _stride(problem, model, frozen, stride)
    return model


def _stride(problem: Problem, model: AxisModel, frozen: Sequence[str], stride: float) -> AxisModel:
    problem, free = bent(problem, model), free_parameters(model, frozen)

    def slopes(x: Array, r: Array) -> Array:
        return _secants(problem, model, free, x, stride)

    return descended(problem, model, free, STEPS, TOLERANCE, slopes).model


def _secants(problem: Problem, model: AxisModel, free: Sequence[Free], at: Array, stride: float) -> Array:
    """Differences of the residual over a stride to both sides, within the bounds, per size of each number."""

    def column(i: int) -> Array:
        ends = []
        for sign in (1.0, -1.0):
            moved = at.copy()
            moved[i] = np.clip(at[i] + sign * stride * free[i].scale, free[i].lower, free[i].upper)
            ends.append(moved)
        ahead, behind = (problem.residual(put(model, free, x)) for x in ends)
        width: float = ends[0][i] - ends[1][i]
        return np.asarray((ahead - behind) * (free[i].scale / width))

    return np.stack(list(problem.mapper(column, range(len(free)))), axis=1)
