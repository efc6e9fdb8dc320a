"""Screen effects of a sensor: what a little of each would change, against what is left, without refitting."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product

import numpy as np

from sioms.reconcile.engine.fit import Free
from sioms.reconcile.engine.search import Start
from sioms.reconcile.sensors.effect import Array, Quantity, SensorEffect, SensorModel
from sioms.reconcile.sensors.fit import Data, Fit, freed, slopes


def screen(data: Data, fit: Fit, weights: Array, effect: SensorEffect, frozen: tuple[str, ...] = ()) -> list[Start]:
    """Regress the residual on what a little of the effect would change; one start per trial shape, the best of all
    views first.
    """
    out, lefts = [], []
    known, r = fit.jacobian, fit.residual
    gram, pull = known.T @ known, known.T @ r
    for shape in _shapes(fit.model, effect):
        columns = weights[:, None] * np.concatenate(
            [_columns(data, fit.model, effect, values) for values in shape], axis=1
        )
        beside = known.T @ columns
        h = np.block([[gram, beside], [beside.T, columns.T @ columns]])
        size = np.sqrt(np.diag(h))
        live = size > 1e-9
        if not live[len(gram) :].any():
            continue
        scaled = h[np.ix_(live, live)] / np.outer(size[live], size[live]) + 1e-9 * np.eye(live.sum())
        slope = np.concatenate([pull, columns.T @ r])[live] / size[live]
        d = np.zeros(len(size))
        d[live] = np.linalg.lstsq(scaled, -slope, rcond=1e-10)[0] / size[live]
        values = _settled(effect, shape, d[len(gram) :], fit.model.count)
        if values is not None:
            left = r + known @ d[: len(gram)] + columns @ d[len(gram) :]
            lefts.append(left)
            out.append(Start(effect.name, _gain(data, r, left), values, 1.0 - float(left @ left) / float(r @ r)))
    if len(out) > 1 and any(q.each and len(q.starts) > 1 for q in effect.parameters):
        out.append(_elementwise(data, effect, out, lefts, r))
    return sorted(out, key=lambda s: -s.total)


def _elementwise(data: Data, effect: SensorEffect, starts: list[Start], lefts: list[Array], before: Array) -> Start:
    """Put the best shape of every element together, where elements have shapes of their own."""
    count = int(data.element.max()) + 1
    squares = np.array([np.bincount(data.element, weights=e**2, minlength=count) for e in lefts])
    best, which = max(starts, key=lambda s: s.total), squares.argmin(0)
    values = {q.symbol: np.array(best.values[q.symbol]) for q in effect.parameters}
    for q in effect.parameters:
        if q.each:
            values[q.symbol] = np.array([starts[k].values[q.symbol][i] for i, k in enumerate(which)])
    left = np.stack(lefts)[which[data.element], np.arange(len(before))]
    return Start(effect.name, _gain(data, before, left), values, 1.0 - float(left @ left) / float(before @ before))


def _gain(data: Data, before: Array, after: Array) -> float:
    """Share of squares saved in the view where it is most."""
    count = len(data.views)
    old = np.bincount(data.view, weights=before**2, minlength=count)
    new = np.bincount(data.view, weights=after**2, minlength=count)
    return float(np.max(np.where(old > 0.0, 1.0 - new / np.where(old > 0.0, old, 1.0), 0.0)))


def _shapes(model: SensorModel, effect: SensorEffect) -> Iterator[list[dict[str, Array]]]:
    """Yield trial shapes: one set of values, or a pair a quarter turn apart where a phase is free."""
    searched = [q for q in effect.parameters[1:] if len(q.starts) > 1]
    phase = next((q for q in effect.parameters if q.phase), None)
    for picks in product(*(q.starts for q in searched)):
        values = model.plain(effect.name)
        for q, pick in zip(searched, picks, strict=True):
            values[q.symbol] = np.full_like(values[q.symbol], pick)
        if phase is None:
            yield [values]
        else:
            yield [{**values, phase.symbol: np.array([turn])} for turn in (0.0, 0.5 * np.pi)]


def screening_columns(data: Data, model: SensorModel, effect: SensorEffect, tries: int = 5) -> Array:
    """Return what a natural size of the effect changes at most, of a few of its shapes, in units of the floor, shape
    (n, k).
    """
    shapes = list(_shapes(model, effect))
    step = max(len(shapes) // tries, 1)
    found = [_columns(data, model, effect, shape[0]) for shape in shapes[::step]]
    return max(found, key=lambda c: float(np.linalg.norm(c)))


def _columns(data: Data, model: SensorModel, effect: SensorEffect, values: dict[str, Array]) -> Array:
    """Return the whitened change per natural size of every number that says how large the effect is."""
    trial = model.with_effect(effect.name, values)
    free = _amounts(effect, model.count)
    at = np.concatenate([values[q.symbol] for q in _amplitudes(effect)])
    return slopes(data, trial, free, at)


def _amplitudes(effect: SensorEffect) -> tuple[Quantity, ...]:
    """Return what says how large an effect is; what shapes it only changes nothing while it is neutral."""
    first, *others = effect.parameters
    if any(q.phase for q in others):
        return (first,)
    return (first, *(q for q in others if not q.starts))


def _amounts(effect: SensorEffect, count: int) -> tuple[Free, ...]:
    return tuple(freed(effect.name, _amplitudes(effect), count))


def _settled(effect: SensorEffect, shape: list[dict[str, Array]], amount: Array, count: int) -> dict[str, Array] | None:
    """Turn regression coefficients into values to start from; None where the sign is not the effect's."""
    q = effect.primary
    values = {symbol: v.copy() for symbol, v in shape[0].items()}
    if len(shape) == 2:
        phase = next(p for p in effect.parameters if p.phase)
        a, b = amount * q.size
        values[q.symbol] = np.array([np.clip(np.hypot(a, b), q.lower, q.upper)])
        values[phase.symbol] = np.array([np.arctan2(b, a)])
        return values
    for f, change in zip(_amounts(effect, count), amount, strict=True):
        wanted = values[f.symbol][f.index] + change * f.scale
        held = np.clip(wanted, f.lower, f.upper)
        if f.symbol == q.symbol and not q.each and abs(held - effect.neutral) < 0.2 * abs(wanted - effect.neutral):
            return None
        values[f.symbol][f.index] = held
    return values
