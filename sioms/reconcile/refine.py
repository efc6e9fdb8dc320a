"""Numbers of the nominal model that are uncertain: bounded while effects are missing, and judged by free runs.

Short windows behind an observer hardly show slow dynamics, and none of a model so heavy that it does not listen to its
force. What is refined is therefore kept within ``WITHIN`` times what is stated until the effects are there, then fitted
again beside all of them, and taken from where a model that nothing holds predicts best: the short windows, a fit to
free runs over long segments, or the model as it was stated.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sioms.reconcile.effect import Array, Ref
from sioms.reconcile.effects import known
from sioms.reconcile.engine.fit import BASE, Free, fitted, get, put
from sioms.reconcile.fit import Fit, Problem, closed_errors, free_parameters, refit
from sioms.reconcile.free import HORIZONS_S, errors
from sioms.reconcile.model import AxisModel
from sioms.reconcile.thresholds import WIDER, WITHIN, WORSE

#: Steps of a fit to free runs, its tolerance, and the small step of its slopes.
STEPS, TOLERANCE, SMALL = 8, 1e-3, 2e-3
#: How often the bounds are widened at most.
TIMES = 3


def bounded(model: AxisModel) -> AxisModel:
    """Return the model with the bounds that its refined inertia has during a search, and those of effects that it
    states about as large as any is sought, or larger: a fit that begins outside its bounds goes nowhere, and one that
    begins just inside runs into them.
    """
    within = {"inertia": (model.inertia / WITHIN, model.inertia * WITHIN)} if "inertia" in model.refine else {}
    for name, given in model.effects.items():
        for p in (q for q in known()[name].parameters if not q.phase and not q.fixed):
            (low, high), stated = model.bounds(name, p), given[p.symbol]
            # a size may be refined as an inertia may; shares, times and speeds of a bend have bounds for what they are
            most = WITHIN * stated if p is known()[name].primary and p.ref not in (Ref.ONE, Ref.TIME) else stated
            if not (low <= stated <= high and low <= most <= high):
                within[f"{name}.{p.symbol}"] = (min(low, WITHIN * stated), max(high, WITHIN * stated))
    return replace(model, within=within)


def runs_away(model: AxisModel) -> bool:
    """Say whether a refined number leans on its bound: it stands for something else."""
    ends = ((getattr(model, symbol), *span) for symbol, span in model.within.items() if symbol in model.refine)
    return any(not 1.02 * low < value < 0.98 * high for value, low, high in ends)


def loops(problem: Problem, model: AxisModel) -> bool:
    """Say whether the closed loop can be simulated: then that is the free run that counts."""
    return model.controller is not None and all(r.command is not None for r in problem.session.records)


def ahead(problem: Problem, model: AxisModel) -> float:
    """Return the error of what a model predicts by itself, root mean square: of force in closed loop where that can be
    simulated, else of position over the longest segments that the records hold.
    """
    if loops(problem, model):
        return closed_errors(problem, model)[0]
    off = errors(problem, model, _longest(problem, model))
    return float(np.sqrt(np.mean(off**2))) if len(off) else np.inf


def settled(problem: Problem, nominal: AxisModel, fit: Fit, frozen: Sequence[str]) -> Fit:
    """Settle the refined numbers of a fitted model; where they are not those that short windows ask for, they are held.

    Args:
        problem: the samples that were searched.
        nominal: with the numbers as they are stated.
        frozen: effects that keep their values.
    """
    if not nominal.refine:
        return fit
    fit = _widened(problem, fit, frozen)
    own = [free for free in free_parameters(fit.model) if free.effect == BASE]
    stated = put(fit.model, own, get(nominal, own))
    models = [_held(stated)] if runs_away(fit.model) else [_held(stated), _held(_flown(problem, fit.model))]
    options = [fit, *(refit(problem, m, frozen) for m in models)]
    off = [ahead(problem, f.model) for f in options]
    return fit if off[0] <= WORSE * min(off) else options[int(np.argmin(off))]


def nearest(problem: Problem, model: AxisModel, others: Sequence[AxisModel]) -> AxisModel | None:
    """Return the first of other models that predicts about as well as the best of them, and better than a model; None
    where none does.
    """
    off = [ahead(problem, m) for m in others]
    least = min(off, default=np.inf)
    if ahead(problem, model) <= WORSE * least:
        return None
    return next(m for m, e in zip(others, off, strict=True) if e <= WORSE * least)


def _widened(problem: Problem, fit: Fit, frozen: Sequence[str]) -> Fit:
    """Fit again beside all effects with wider bounds, as long as what is predicted gains by it."""
    off = ahead(problem, fit.model)
    for _ in range(TIMES):
        if not runs_away(fit.model):
            break
        spans = {symbol: (low / WITHIN, high * WITHIN) for symbol, (low, high) in fit.model.within.items()}
        new = refit(problem, replace(fit.model, within=spans), frozen)
        if (gained := ahead(problem, new.model)) > WIDER * off:
            break
        fit, off = new, gained
    return fit


def _flown(problem: Problem, model: AxisModel) -> AxisModel:
    """Fit the refined numbers to free runs over the longest segments."""
    free = tuple(f for f in free_parameters(model) if f.effect == BASE)
    return flown(problem, model, free, _longest(problem, model))


def flown(problem: Problem, model: AxisModel, free: tuple[Free, ...], horizon: float) -> AxisModel:
    """Fit some numbers of a model to free runs over segments of a length."""

    def off(m: AxisModel) -> Array:
        return errors(problem, m, horizon)

    if not len(base := off(model)):
        return model
    size = max(float(np.sqrt(np.mean(base**2))), 1e-300)

    def slopes(at: Array, r: Array) -> Array:
        columns = []
        for i, f in enumerate(free):
            moved, step = at.copy(), SMALL if at[i] + SMALL * f.scale <= f.upper else -SMALL
            moved[i] += step * f.scale
            columns.append((off(put(model, free, moved)) / size - r) / step)
        return np.stack(columns, axis=1)

    return fitted(model, free, lambda m: off(m) / size, slopes, STEPS, TOLERANCE).model


def _longest(problem: Problem, model: AxisModel) -> float:
    """Return the longest length of segments that some record holds."""
    spans = (problem.span(r) for r in problem.session.records)
    whole = max(s.stop - s.start for s in spans) * model.sample_time_s
    return max((h for h in HORIZONS_S if h <= whole), default=np.inf)


def _held(model: AxisModel) -> AxisModel:
    within = {key: span for key, span in model.within.items() if key not in model.refine}
    return replace(model, refine=(), within=within)
