"""Fit place, width and load of one contact to one frame of strains: variable projection with Levenberg-Marquardt steps.

The load P enters linearly and is eliminated at every step; what remains is a search in (t, b), b = a^2, on
the tables of `sioms.tactile.model`.  Everything the search needs at a point is ten scalar products of f,
df/dt, df/db and the strains y, so the search itself is plain scalar arithmetic, written once; only the scalar
products exist twice, in numpy and as loops for numba (optional).  Source: Golub and Pereyra (1973) in
Kaufman's form; dissertation 3.5.

Weights are inverse variances, hence the cost is a chi square and the covariance needs no scale.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from enum import IntEnum
from functools import lru_cache
from types import FunctionType
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Products = tuple[float, float, float, float, float, float, float, float, float, float]
# solves one frame, see `_solve` -> (status, t, b, ten products, iterations, sum of weights)
Solve = Callable[..., tuple[int, float, float, Products, int, float]]

MOST_STEPS = 100
LEAST_LOAD = 1e-3  # N/m, where the load of the best fit is not positive
_TOLERANCE = 1e-7  # stop when a step gains less than this much chi square: 3e-4 standard deviations


def _products_numpy(
    nodes: Floats,
    first: float,
    step: float,
    width_step: float,
    weights: Floats,
    y: Floats,
    pull: Floats,
    load: float,
    load_weight: float,
    t: float,
    b: float,
) -> Products:
    """Return ff, ft, fb, fy, tt, tb, ty, bb, by, yy with f = f(t, b), t = df/dt, b = df/db, weighted.

    Under a conductor y is what is left of the outputs without its pull at t (see `drawn_frame`), and t = df/dt -
    (dy/dt)/P: then all that is made of the products holds as it stands.
    """
    rows, columns, _, elements = nodes.shape
    column = min(max(int((t - first) / step), 0), columns - 2)
    s = (t - first) / step - column
    row = min(int(b**0.5 / width_step), rows - 2)
    low = (row * width_step) ** 2
    span = ((row + 1) * width_step) ** 2 - low
    u = (b - low) / span
    s2, u2 = s * (1.0 - s), u * (1.0 - u)
    s0, s1, p0, p1 = (1.0 + 2.0 * s) * (1.0 - s) ** 2, s**2 * (3.0 - 2.0 * s), s2 * (1.0 - s), -s2 * s
    ds, dp0, dp1 = 6.0 * s2 / step, (1.0 - s) * (1.0 - 3.0 * s) / step, s * (3.0 * s - 2.0) / step
    u0, u1, v0, v1 = (
        (1.0 + 2.0 * u) * (1.0 - u) ** 2,
        u**2 * (3.0 - 2.0 * u),
        span * u2 * (1.0 - u),
        -span * u2 * u,
    )
    du, dv0, dv1 = 6.0 * u2 / span, (1.0 - u) * (1.0 - 3.0 * u), u * (3.0 * u - 2.0)
    along = np.array([[s0, p0, s1, p1], [-ds, dp0, ds, dp1], [s0, p0, s1, p1]])
    across = np.array([[u0, v0, u1, v1], [u0, v0, u1, v1], [-du, dv0, du, dv1]])
    # nodes (row, column, [f, ft, fb, ftb], element) against across (row, value or d/db) x along (column,
    # value or d/dt)
    mixed = across.reshape(3, 2, 1, 2, 1) * along.reshape(3, 1, 2, 1, 2)
    block = nodes[row : row + 2, column : column + 2].reshape(16, elements)
    values = np.empty((4, elements))
    np.matmul(mixed.reshape(3, 16), block, out=values[:3])
    values[3] = y
    if pull.shape[1]:
        angle, gain, quadratic, output, amplitude, reach = pull
        away = angle - t
        drawn = amplitude * np.exp(-np.abs(away) / reach)
        root = np.sqrt(np.maximum(1.0 + 4.0 * quadratic * (output - drawn), 1e-4))
        values[3] = -2.0 * gain * (output - drawn) / (1.0 + root)
        heavy = values[0] * weights
        p = max((heavy @ values[3] + load_weight * load) / (heavy @ values[0] + load_weight), LEAST_LOAD)
        values[1] -= gain * drawn * np.sign(away) / (reach * root * p)
    gram = (values * weights) @ values.T
    (ff, ft, fb, fy), (_, tt, tb, ty), (_, _, bb, by), (_, _, _, yy) = gram.tolist()
    return ff, ft, fb, fy, tt, tb, ty, bb, by, yy


def _products_loops(
    nodes: Floats,
    first: float,
    step: float,
    width_step: float,
    weights: Floats,
    y: Floats,
    pull: Floats,
    load: float,
    load_weight: float,
    t: float,
    b: float,
) -> Products:
    """Return the same as `_products_numpy`, for the compiler."""
    rows, columns, _, elements = nodes.shape
    column = min(max(int((t - first) / step), 0), columns - 2)
    s = (t - first) / step - column
    row = min(int(b**0.5 / width_step), rows - 2)
    low = (row * width_step) ** 2
    span = ((row + 1) * width_step) ** 2 - low
    u = (b - low) / span
    along = (
        (1.0 + 2.0 * s) * (1.0 - s) ** 2,
        s * (1.0 - s) ** 2,
        s**2 * (3.0 - 2.0 * s),
        -(s**2) * (1.0 - s),
    )
    d_along = (-6.0 * s * (1.0 - s), (1.0 - s) * (1.0 - 3.0 * s), 6.0 * s * (1.0 - s), s * (3.0 * s - 2.0))
    across = (
        (1.0 + 2.0 * u) * (1.0 - u) ** 2,
        u * (1.0 - u) ** 2,
        u**2 * (3.0 - 2.0 * u),
        -(u**2) * (1.0 - u),
    )
    d_across = (-6.0 * u * (1.0 - u), (1.0 - u) * (1.0 - 3.0 * u), 6.0 * u * (1.0 - u), u * (3.0 * u - 2.0))
    value, turn, widen = np.zeros(elements), np.zeros(elements), np.zeros(elements)
    for i in range(2):
        for j in range(2):
            for q in range(4):
                x, z = 2 * j + q % 2, 2 * i + q // 2
                scale = span if q >= 2 else 1.0
                w0 = along[x] * across[z] * scale
                w1 = d_along[x] * across[z] * scale / step
                w2 = along[x] * d_across[z] * scale / span
                cell = nodes[row + i, column + j, q]
                for e in range(elements):
                    value[e] += w0 * cell[e]
                    turn[e] += w1 * cell[e]
                    widen[e] += w2 * cell[e]
    ff = ft = fb = fy = tt = tb = ty = bb = by = yy = 0.0
    left = y
    if pull.shape[1]:
        left = np.empty(elements)
        slope = np.empty(elements)
        for e in range(elements):
            away = pull[0, e] - t
            drawn = pull[4, e] * np.exp(-abs(away) / pull[5, e])
            root = np.sqrt(max(1.0 + 4.0 * pull[2, e] * (pull[3, e] - drawn), 1e-4))
            left[e] = -2.0 * pull[1, e] * (pull[3, e] - drawn) / (1.0 + root)
            slope[e] = pull[1, e] * drawn * np.sign(away) / (pull[5, e] * root)
            ff += weights[e] * value[e] * value[e]
            fy += weights[e] * value[e] * left[e]
        p = max((fy + load_weight * load) / (ff + load_weight), LEAST_LOAD)
        ff = fy = 0.0
        for e in range(elements):
            turn[e] -= slope[e] / p
    for e in range(elements):
        w = weights[e]
        ff += w * value[e] * value[e]
        ft += w * value[e] * turn[e]
        fb += w * value[e] * widen[e]
        fy += w * value[e] * left[e]
        tt += w * turn[e] * turn[e]
        tb += w * turn[e] * widen[e]
        ty += w * turn[e] * left[e]
        bb += w * widen[e] * widen[e]
        by += w * widen[e] * left[e]
        yy += w * left[e] * left[e]
    return ff, ft, fb, fy, tt, tb, ty, bb, by, yy


_products: Callable[..., Products] = _products_numpy


def _fit(
    nodes: Floats,
    first: float,
    step: float,
    width_step: float,
    weights: Floats,
    y: Floats,
    pull: Floats,
    load: float,
    load_weight: float,
    t: float,
    b: float,
    top_b: float,
) -> tuple[float, float, Products, int]:
    """Search over the scalar products `_products`; numba compiles the same body, see `_bound`."""
    top_t = first + step * (nodes.shape[1] - 1)
    b = min(b, top_b)
    at = _products(nodes, first, step, width_step, weights, y, pull, load, load_weight, t, b)
    ff, fy = at[0] + load_weight, at[3] + load_weight * load
    cost = at[9] - max(fy, 0.0) ** 2 / ff
    damping = 1e-3
    steps = 0
    while steps < MOST_STEPS:
        steps += 1
        p = fy / ff
        # a load of the wrong sign gives no direction: fall back on a small positive one
        p = max(p, LEAST_LOAD)
        gain_t, gain_b = p * (at[6] - p * at[1]), p * (at[8] - p * at[2])
        tt, bb = p * p * (at[4] - at[1] ** 2 / ff), p * p * (at[7] - at[2] ** 2 / ff)
        tb = p * p * (at[5] - at[1] * at[2] / ff)
        lt, lb = tt * (1.0 + damping) + 1e-30, bb * (1.0 + damping) + 1e-30
        det = lt * lb - tb * tb
        move_t, move_b = (lb * gain_t - tb * gain_b) / det, (lt * gain_b - tb * gain_t) / det
        if b + move_b < 0.0 or b + move_b > top_b:
            # the least of the quadratic lies on the bound, and there at another t
            move_b = min(max(move_b, -b), top_b - b)
            move_t = (gain_t - tb * move_b) / lt
        # one pitch at most, because the model turns over within about that distance, and not off the table;
        # the whole step is shortened: a part of it need not lead downhill
        room = min(0.1, top_t - t if move_t > 0.0 else t - first)
        share = min(1.0, room / max(abs(move_t), 1e-30))
        new_t, new_b = t + share * move_t, min(max(b + share * move_b, 0.0), top_b)
        promised = (new_t - t) * gain_t + (new_b - b) * gain_b
        try_at = _products(nodes, first, step, width_step, weights, y, pull, load, load_weight, new_t, new_b)
        try_ff, try_fy = try_at[0] + load_weight, try_at[3] + load_weight * load
        try_cost = try_at[9] - max(try_fy, 0.0) ** 2 / try_ff
        gained = cost - try_cost
        if gained >= -1e-12 * abs(cost):
            t, b, at, ff, fy, cost = new_t, new_b, try_at, try_ff, try_fy, try_cost
        if promised < _TOLERANCE:
            break
        # at the ends of the arc the model bends so that undamped steps leap to and fro across a narrow valley
        if gained < 0.3 * promised:
            damping = max(10.0 * damping, 1e-3)
        elif gained > 0.7 * promised:
            damping = max(0.1 * damping, 1e-9)
    return t, b, at, steps


def drawn_frame(
    angle: Floats, gain: Floats, quadratic: Floats, output: Floats, amplitude: float, reach: float
) -> Floats:
    """Return the rows that the search needs of a frame under a conductor, shape (6, ns); `NOT_DRAWN` without one.

    Element i gives d = l + q l^2 + A exp(-|t_i - t|/reach) for a touch at t; what is left at t is -gain l.

    Args:
        angle, gain, quadratic: of the elements [rad, 1, 1/output].
        output: d of the frame, shape (ns,).
        amplitude: A [output].
        reach: over which the pull falls to 1/e [rad].
    """
    return np.stack([angle, gain, quadratic, output, np.full(angle.size, amplitude), np.full(angle.size, reach)])


NOT_DRAWN: Floats = np.zeros((6, 0))


class Status(IntEnum):
    """Say how far `solve` came."""

    FITTED = 0
    NO_CONTACT = 1
    WRONG_SIGN = 2


def _solve(
    nodes: Floats,
    first: float,
    step: float,
    width_step: float,
    bank: Floats,
    bank_square: Floats,
    places: Floats,
    noise: Floats,
    share: Floats,
    least: float,
    y: Floats,
    pull: Floats,
    load: float,
    load_weight: float,
    top_b: float,
    start_t: float,
    start_b: float,
) -> tuple[int, float, float, Products, int, float]:
    """Do one frame's whole work: weights, touch or not, best pattern, search.

    The search starts from `start_t`, `start_b` unless `start_b` is negative.
    """
    blank = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    square = y * y
    if (square / noise).sum() < least:
        return 1, 0.0, 0.0, blank, 0, 0.0
    weights = 1.0 / (noise + share * square.max())
    if start_b < 0.0:
        score = bank @ (weights * y)
        explained = score * np.abs(score) / (bank_square @ weights)
        best = np.argmax(explained)
        # a pull: turned over, some touch explains more
        if explained[best] <= -explained.min():
            return 2, 0.0, 0.0, blank, 0, 0.0
        start_t, start_b = places[best, 0], places[best, 1]
    t, b, at, steps = _fit(
        nodes,
        first,
        step,
        width_step,
        weights,
        y,
        pull,
        load,
        load_weight,
        float(start_t),
        float(start_b),
        top_b,
    )
    return 0, t, b, at, steps, weights.sum()


def _bound(function: Callable[..., Any], **names: Any) -> Any:
    """Return a function that finds others under these names of its module.

    The next process finds it in the cache of numba, which compiles a function that encloses another anew each time.
    """
    return FunctionType(function.__code__, {**function.__globals__, **names}, function.__name__)


@lru_cache(maxsize=1)
def plain() -> Solve:
    """Return the solver in plain numpy."""
    return _solve


@lru_cache(maxsize=1)
def compiled() -> Solve:
    """Return the solver compiled by numba; takes seconds the first time on a machine, then is read from the cache.

    Raises:
        ImportError: numba is not installed (the extra ``fast`` of SIOMS brings it).
    """
    if importlib.util.find_spec("numba") is None:
        raise ImportError(
            "compile tactile fit: numba is not installed; run: pip install 'sioms[fast]', or fit in plain numpy"
        )
    numba: Any = importlib.import_module("numba")
    jit = numba.njit(cache=True, error_model="numpy")
    fit = jit(_bound(_fit, _products=jit(_products_loops)))
    solver: Solve = jit(_bound(_solve, _fit=fit))
    return solver
