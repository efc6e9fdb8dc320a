"""Blocks of time: held-out scores and standard errors without refitting.

With the Jacobian of a fit at hand, leaving a block out moves the parameters by one Gauss-Newton step, exact to first
order. Blocks, not samples, are the independent units, because residuals of an axis are correlated over tens to hundreds
of samples.
Source: P. W. Koh, P. Liang, "Understanding black-box predictions via influence functions", 2017, sec. 2;
H. R. Kuensch, "The jackknife and the bootstrap for general stationary observations", Ann. Stat. 17 (1989).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.special import digamma, polygamma
from scipy.stats import t as student

from sioms.reconcile.descent import within
from sioms.reconcile.effect import Array

#: A step without a fold that moves a parameter by more than this share of its size is tried, as long or shorter, not
#: extrapolated.
NEAR, SHORTER = 0.1, (1.0, 0.3)
#: Variances from which on it makes sense to ask how they scatter, and half the most degrees of freedom that the others
#: lend.
LEAST_MODERATED, MOST_PRIOR = 4, 500.0


class Fitted(Protocol):
    """A fit of any subject: residual (n,) in units of the floor, and its Jacobian (n, k)."""

    @property
    def residual(self) -> Array: ...
    @property
    def jacobian(self) -> Array: ...


def _normal(fit: Fitted, ids: NDArray[np.int64]) -> tuple[Array, Array, Array]:
    """Per block: J'J (b, k, k), J'r (b, k), r'r (b,)."""
    b, k = int(ids.max()) + 1, fit.jacobian.shape[1]
    edges = np.searchsorted(ids, np.arange(b + 1))
    h, g, c = np.zeros((b, k, k)), np.zeros((b, k)), np.zeros(b)
    for i in range(b):
        j, r = fit.jacobian[edges[i] : edges[i + 1]], fit.residual[edges[i] : edges[i + 1]]
        h[i], g[i], c[i] = j.T @ j, j.T @ r, float(r @ r)
    return h, g, c


def heldout(
    fit: Fitted, ids: NDArray[np.int64], folds: int = 10, moved: Callable[[Array], Array] | None = None
) -> Array:
    """Sum of squares of each block when the parameters come from the other folds, shape (blocks,).

    Args:
        moved: residual with the parameters changed by so many of their sizes. Where one fold tells most of a parameter
            the others would move it far, to where the slopes of here say nothing; None: they are believed.
    """
    h, g, c = _normal(fit, ids)
    if fit.jacobian.shape[1] == 0:
        return c
    total_h, total_g = h.sum(0), g.sum(0)
    ridge = (1e-9 * np.trace(total_h) or 1.0) * np.eye(len(total_g))
    out, size = np.empty(len(c)), np.ones(len(total_g))
    fold = np.arange(len(c)) % max(min(folds, len(c)), 2)
    for f in range(fold.max() + 1):
        inside = fold == f
        d = within(total_h - h[inside].sum(0) + ridge, total_g - g[inside].sum(0), -size, size)
        if moved is not None and np.max(np.abs(d)) > NEAR:
            tried = [c, *(np.bincount(ids, weights=moved(share * d) ** 2) for share in SHORTER)]
            out[inside] = min(tried, key=lambda e: float(e[~inside].sum()))[inside]
        else:
            out[inside] = c[inside] + 2.0 * g[inside] @ d + np.einsum("i,bij,j->b", d, h[inside], d)
    return out


def intervals(fit: Fitted, ids: NDArray[np.int64], level: float = 0.95) -> Array:
    """Half-widths of confidence intervals, in units of the parameters' scale, shape (k,).

    The parameters are moved by leaving out each block in turn (the jackknife, which does not count on the blocks
    weighing alike), and Student's t is of as many blocks as the information on a parameter comes from. Where two blocks
    tell
    a parameter, its own spread says next to nothing: it is drawn towards what the spreads of all are, in units of the
        formal ones.
    Source: A. C. Cameron, D. L. Miller, "A practitioner's guide to cluster-robust inference", J. Human Resources 50
    (2015), sec. VI; A. V. Carter, K. T. Schnepel, D. G. Steigerwald, "Asymptotic behavior of a t-test robust to cluster
    heterogeneity", Rev. Econ. Stat. 99 (2017) 698-709; G. K. Smyth, "Linear models and empirical Bayes methods", Stat.
    Appl. Genet. Mol. Biol. 3 (2004), sec. 6.
    """
    h, g, _ = _normal(fit, ids)
    b, k = g.shape
    if k == 0 or b < 3:
        return np.full(k, np.inf)
    total = h.sum(0) + (1e-9 * np.trace(h.sum(0)) or 1.0) * np.eye(k)
    moves = np.stack([np.linalg.solve(total - inside, -own) for inside, own in zip(h, g, strict=True)])
    variance = (b - 1) / b * np.sum((moves - moves.mean(0)) ** 2, axis=0)
    inverse = np.linalg.inv(total)
    share = np.einsum("ij,bjk,ki->bi", inverse, h, inverse)
    effective = share.sum(0) ** 2 / np.maximum(np.sum(share**2, axis=0), 1e-300)
    variance, freedom = _moderated(variance, np.diag(inverse), np.maximum(effective - 1.0, 1.0))
    return np.asarray(student.ppf(0.5 + 0.5 * level, freedom) * np.sqrt(variance))


def combined(fit: Fitted, ids: NDArray[np.int64], slopes: Array, level: float = 0.95) -> Array:
    """Half-widths of the intervals of what the numbers of a fit add up to, shape (m,): the larger of the jackknife's
    and that of white noise.

    Args:
        slopes: how each of it goes with the numbers, in units of their scale, shape (m, k).
    """
    h, g, _ = _normal(fit, ids)
    n, (b, k) = len(fit.residual), g.shape
    if k == 0 or b < LEAST_MODERATED:
        return np.full(len(slopes), np.inf)
    total = h.sum(0) + 1e-9 * np.trace(h.sum(0)) / k * np.eye(k)
    moves = np.stack([np.linalg.solve(total - inside, -own) for inside, own in zip(h, g, strict=True)]) @ slopes.T
    jackknife = (b - 1) / b * np.sum((moves - moves.mean(0)) ** 2, axis=0)
    white = (
        float(fit.residual @ fit.residual) / max(n - k, 1) * np.sum(slopes.T * np.linalg.solve(total, slopes.T), axis=0)
    )
    return np.asarray(student.ppf(0.5 + 0.5 * level, b - 1) * np.sqrt(np.maximum(jackknife, white)))


def formal(fit: Fitted, level: float = 0.95) -> Array:
    """Half-widths of the intervals of least squares under white noise, in units of the parameters' scale, shape (k,).

    Noise that is alike for a while only makes the truth wider: where the blocks say less, they are few, and it is
        chance. The larger
    of both is the safer. Source: J. D. Angrist, J.-S. Pischke, "Mostly Harmless Econometrics", 2009, sec. 8.2.
    """
    n, k = fit.jacobian.shape
    h = fit.jacobian.T @ fit.jacobian
    inverse = np.linalg.inv(h + (1e-9 * np.trace(h) or 1.0) * np.eye(k))
    each = float(fit.residual @ fit.residual) / max(n - k, 1)
    return np.asarray(student.ppf(0.5 + 0.5 * level, max(n - k, 1)) * np.sqrt(each * np.diag(inverse)))


def _moderated(variance: Array, formal: Array, freedom: Array) -> tuple[Array, Array]:
    """Draw variances towards a common multiple of the formal ones, as strongly as they scatter less than chance would
    have it.

    Returns:
        Variances and degrees of freedom; both as given where fewer than ``LEAST_MODERATED`` are told.
    """
    told = variance > 1e-12 * formal
    if told.sum() < LEAST_MODERATED:
        return variance, freedom
    half = 0.5 * freedom[told]
    level = np.log(variance[told] / formal[told]) - digamma(half) + np.log(half)
    excess = float(np.var(level, ddof=1) - np.mean(polygamma(1, half)))
    prior = 2.0 * _inverse_trigamma(max(excess, polygamma(1, MOST_PRIOR)))
    common = np.exp(level.mean() + digamma(0.5 * prior) - np.log(0.5 * prior))
    return (prior * common * formal + freedom * variance) / (prior + freedom), prior + freedom


def _inverse_trigamma(y: float) -> float:
    """Solve polygamma(1, x) = y by Newton's method on 1/y (Smyth 2004, appendix)."""
    x = 0.5 + 1.0 / y
    for _ in range(20):
        t = float(polygamma(1, x))
        x += t * (1.0 - t / y) / float(polygamma(2, x))
    return x


def better(loss_a: Array, loss_b: Array) -> tuple[float, float]:
    """Compare two models by blocks.

    The error counts blocks, each by its relative change: an effect that is real helps nearly wherever it
    acts, a lucky fit helps in the loudest blocks and hurts in the others.

    Returns:
        (share of b's loss that a saves, how many standard errors the mean relative saving is from nothing).
    """
    quiet = 0.5 * float(np.quantile(loss_a + loss_b, 0.1)) + 1e-300
    z = (loss_b - loss_a) / (loss_b + loss_a + quiet)
    spread = float(np.std(z, ddof=1) / np.sqrt(len(z))) if len(z) > 1 else np.inf
    return float((loss_b - loss_a).sum() / loss_b.sum()), float(np.mean(z) / max(spread, 1e-12))
