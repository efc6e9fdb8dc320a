"""Fit the switched-on effects of a sensor model to rows of data; rows come in views (kinds of evidence)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from sioms.reconcile.blocks import intervals
from sioms.reconcile.engine.fit import BASE, Free, fitted, put
from sioms.reconcile.engine.fit import Fit as AnyFit
from sioms.reconcile.sensors.effect import Array, Quantity, SensorModel

Fit = AnyFit[SensorModel]
_STEP = 2e-3


class Data(Protocol):
    """Rows of one subject. Pure: no method changes anything.

    Attributes:
        view: number of the view of each row, shape (n,).
        views: names of the views.
        block: block of each row, rising from 0, shape (n,); blocks are what is held out.
        element: element that a row belongs to, -1 for rows that mix elements, shape (n,).
        footing: first view of the group of each view; those of one group are brought to the floor and reported
            together.
    """

    @property
    def view(self) -> NDArray[np.int64]: ...
    @property
    def views(self) -> tuple[str, ...]: ...
    @property
    def block(self) -> NDArray[np.int64]: ...
    @property
    def element(self) -> NDArray[np.int64]: ...

    @property
    def footing(self) -> tuple[int, ...]: ...

    def predict(self, model: SensorModel) -> Array:
        """Return what the model says, in the units of the rows, shape (n,)."""
        ...

    def miss(self, predicted: Array) -> Array:
        """Return predicted less measured in units of the floor, nuisances projected out, shape (n,)."""
        ...

    def doubts(self, model: SensorModel) -> Array:
        """Return changes of the prediction by a standard deviation of what is not known but
        systematic, shape (n, k).
        """
        ...

    def whiten(self, change: Array) -> Array:
        """Return a change of the prediction as ``miss`` sees it, shape (n,) or (n, k)."""
        ...

    def independent(self) -> tuple[NDArray[np.int64], Array]:
        """Return which rows have errors in common, a number from 0 for each, shape (n,), and the changes of the rows
        with what ``miss`` projects out, shape (n, k).
        """
        ...


def ratios(data: Data, model: SensorModel) -> Array:
    """Return the root mean square of each view in units of its floor."""
    square, count = _squares(data, model)
    return np.asarray(np.sqrt(square / np.maximum(count, 1)))


def on_one_footing(data: Data, model: SensorModel) -> Array:
    """Return weights of the rows that bring every group of views which is far from the floor down to it, shape (n,)."""
    square, count = (np.bincount(data.footing, weights=v) for v in _squares(data, model))
    group = 1.0 / np.maximum(np.sqrt(square / np.maximum(count, 1.0)), 1.0)
    out: Array = group[np.array(data.footing)[data.view]]
    return out


def _squares(data: Data, model: SensorModel) -> tuple[Array, Array]:
    e, n = data.miss(data.predict(model)), len(data.views)
    square, count = (np.bincount(data.view, weights=w, minlength=n) for w in (e**2, np.ones(len(e))))
    return square.astype(np.float64), count.astype(np.float64)


def half_intervals(data: Data, fit: Fit, weights: Array) -> Array:
    """Half-widths of the 95 % intervals of the free numbers: by blocks left out, and by what is systematic."""
    doubts = weights[:, None] * data.whiten(data.doubts(fit.model))
    moved = np.linalg.lstsq(fit.jacobian, doubts, rcond=1e-10)[0]
    size = np.array([f.scale for f in fit.free])
    ids, beside = data.independent()
    spread = intervals(*_with(fit, ids, weights[:, None] * beside))[: len(size)]
    return np.asarray(size * np.hypot(spread, 1.96 * np.linalg.norm(moved, axis=1)))


class _Whole(NamedTuple):
    residual: Array
    jacobian: Array


def _with(fit: Fit, ids: NDArray[np.int64], beside: Array) -> tuple[_Whole, NDArray[np.int64]]:
    """Return a fit in which what is projected out is free as well, in the order of its blocks.

    Blocks that are left out tell of those numbers, too: projected out of all at once, the others seem to know them.
    """
    order = np.argsort(ids, kind="stable")
    basis = np.linalg.qr(beside)[0]
    residual, jacobian = (v - basis @ (basis.T @ v) for v in (fit.residual, fit.jacobian))
    return _Whole(residual[order], np.concatenate([jacobian, basis], axis=1)[order]), ids[order]


def free_numbers(model: SensorModel, frozen: Sequence[str] = ()) -> tuple[Free, ...]:
    """List the free numbers of a model."""
    out = [replace(f, index=None) for f in freed(BASE, model.refine, 1)]
    for name in model.effects:
        if name not in frozen:
            out += freed(name, model.library[name].parameters, model.count)
    return tuple(out)


def freed(effect: str, parameters: Sequence[Quantity], count: int) -> list[Free]:
    """Return the free numbers of parameters; of one that each has of its own ``count``."""
    return [
        Free(effect, q.symbol, q.size, q.lower, q.upper, q.phase, i, q.each)
        for q in parameters
        for i in range(count if q.each else 1)
    ]


def slopes(data: Data, model: SensorModel, free: Sequence[Free], at: Array) -> Array:
    """Return d miss / d (number / size) by differences, shape (n, k).

    Numbers of one quantity that every element has its own of are moved together: each row feels that of its
    own element only.
    """
    base = data.predict(put(model, free, at))
    raw = np.zeros((len(base), len(free)))
    groups: dict[tuple[str, str], list[int]] = {}
    for i, f in enumerate(free):
        groups.setdefault((f.effect, f.symbol), []).append(i)
    for places in groups.values():
        q = free[places[0]]
        step = np.where(at[places] + _STEP * q.scale > q.upper, -_STEP, _STEP)
        moved = at.copy()
        moved[places] += step * q.scale
        change = data.predict(put(model, free, moved)) - base
        if q.each:
            for i, h in zip(places, step, strict=True):
                mine = data.element == free[i].index
                raw[mine, i] = change[mine] / h
        else:
            raw[:, places[0]] = change / step[0]
    return data.whiten(raw)


def refit(
    data: Data,
    model: SensorModel,
    weights: Array,
    frozen: Sequence[str] = (),
    iterations: int = 8,
    tolerance: float = 1e-4,
) -> Fit:
    """Fit all free numbers by bounded Levenberg-Marquardt.

    Args:
        weights: of the rows, shape (n,): views far from the floor are brought on one footing.
    """
    free = free_numbers(model, frozen)
    return fitted(
        model,
        free,
        lambda m: weights * data.miss(data.predict(m)),
        lambda x, _: weights[:, None] * slopes(data, model, free, x),
        iterations,
        tolerance,
        damping=1e-5,
        ease=0.1,
    )
