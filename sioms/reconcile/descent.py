"""Bounded Levenberg-Marquardt: least squares of a residual that is dear to evaluate and has few numbers.

Source: D. W. Marquardt, "An algorithm for least-squares estimation of nonlinear parameters", SIAM J. 11 (1963).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from sioms.reconcile.effect import Array

TRIALS = 5  # of one step, each more cautious
LEAST = 1e-7  # damping
LONGEST = 3.0  # a step changes no number by more sizes


def descend(
    residual: Callable[[Array], Array],
    slopes: Callable[[Array, Array], Array],
    at: Array,
    size: Array,
    lower: Array,
    upper: Array,
    iterations: int,
    tolerance: float,
    damping: float = 1e-3,
    ease: float = 0.2,
    left: float = 0.0,
) -> tuple[Array, Array, Array]:
    """Minimise the sum of squares of a residual.

    Args:
        residual: of the numbers, shape (k,) to (n,).
        slopes: d residual / d (number / size) at numbers with their residual, shape (n, k).
        at: numbers to start from, k > 0.
        size: natural size of each number.
        lower, upper: bounds, infinite where there is none.
        iterations: largest number of accepted steps.
        tolerance: stop when a step gains less than this share of the sum of squares.
        damping: at first, and ``ease`` its change after a good step; small for a residual that is smooth in its
            numbers.
        left: share of a number that can only be positive which a step leaves at least: where it nearly vanishes (the
            speed over which friction drops), nothing changes with it any more.

    Returns:
        Numbers, residual and slopes at the best point found.
    """
    r = residual(at)
    cost = float(r @ r)
    j = slopes(at, r)
    for _ in range(iterations):
        least = np.where(lower > 0.0, np.maximum(lower, left * at), lower)
        h, g = j.T @ j, j.T @ r
        gained = False
        for _ in range(TRIALS):
            more = damping * np.diag(np.diag(h) + 1e-12 * np.trace(h) + 1e-30)
            low, high = np.maximum((least - at) / size, -LONGEST), np.minimum((upper - at) / size, LONGEST)
            trial = np.clip(at + within(h + more, g, np.minimum(low, 0.0), np.maximum(high, 0.0)) * size, least, upper)
            rt = residual(trial)
            ct = float(rt @ rt)
            if ct < cost:
                gained = True
                break
            damping = max(damping, 1e-4) * 8.0
        if not gained:
            break
        done = cost - ct < tolerance * cost
        at, r, cost = trial, rt, ct
        damping = max(damping * ease, LEAST)
        j = slopes(at, r)
        if done:
            break
    return at, r, j


def within(h: Array, g: Array, low: Array, high: Array) -> Array:
    """Minimise d'hd/2 + g'd over low <= d <= high, which hold 0; the furthest outside is held at its end first, the
    others freed again.

    Numbers that trade against each other go far together: cut off one by one, they would no longer make up for each
        other.
    """
    d, free = np.linalg.lstsq(h, -g, rcond=1e-12)[0], np.ones(len(g), dtype=bool)
    while True:
        end = np.where(d > 0.0, high, low)
        beyond = np.where(free & (np.abs(d) > np.abs(end)), np.abs(d) / np.maximum(np.abs(end), 1e-12), 0.0)
        far = int(np.argmax(beyond))
        if beyond[far] == 0.0:
            return np.asarray(d)
        free[far], d[far] = False, end[far]
        d[free] = np.linalg.lstsq(h[np.ix_(free, free)], -(g[free] + h[np.ix_(free, ~free)] @ d[~free]), rcond=1e-12)[0]
