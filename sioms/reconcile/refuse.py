"""Refusal: is there something left that no named effect explains, and what does it look like?

A generic smoother over the state, judged on blocks it has not seen, says how much of the residual *could* be
explained by anything that depends on position, speed, direction, force, acceleration, place in the turn or
displacement since reversal. It names nothing; it only keeps the named model honest.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sioms.reconcile.effect import Array
from sioms.reconcile.engine.evidence import unseen
from sioms.reconcile.fit import Fit, Problem, block_ids
from sioms.reconcile.model import AxisModel
from sioms.reconcile.screen import Motion, dead_band, direction, instrument_motion, smoothed_motion, thinned
from sioms.reconcile.thresholds import BURST_S, LOUD_BLOCK, MOST_LOUD

KNOTS = 14
HARMONICS = 4
RIDGES = (1e-4, 1e-2, 1.0)


def hats(x: Array, knots: Array) -> Array:
    """Piecewise linear basis on rising knots, shape (n, len(knots))."""
    out = np.zeros((len(x), len(knots)))
    place = np.clip(np.searchsorted(knots, x) - 1, 0, len(knots) - 2)
    width = knots[place + 1] - knots[place]
    part = np.clip((x - knots[place]) / np.where(width > 0, width, 1.0), 0.0, 1.0)
    rows = np.arange(len(x))
    out[rows, place] = 1.0 - part
    out[rows, place + 1] += part
    return out


def knots(values: Array, count: int = KNOTS) -> Array:
    """Knots at quantiles, so that every hat over them has data."""
    q = np.unique(np.quantile(values, np.linspace(0.0, 1.0, count)))
    return q if len(q) > 1 else np.array([q[0], q[0] + 1.0])


def since_reversal(x: Array, sign: Array) -> Array:
    """Displacement since the last change of direction, shape (n,)."""
    turn = np.flatnonzero(np.diff(np.sign(np.where(np.abs(sign) > 0.5, sign, 0.0))) != 0) + 1
    start = np.zeros(len(x), dtype=np.int64)
    start[turn] = turn
    out: Array = np.abs(x - x[np.maximum.accumulate(start)])
    return out


def basis(motions: list[Motion], model: AxisModel, dead: float) -> list[Array]:
    """Generic force columns of the state for every record, shape (n, k) each."""
    x, v, u, a = (np.concatenate([getattr(m, q) for m in motions]) for q in "xvua")
    kx, kv, ku, ka = knots(x), knots(v, 2 * KNOTS), knots(u, 8), knots(a, 8)
    turn = 2.0 * np.pi / model.pitch
    whole = max(float(np.ptp(m.x)) for m in motions) > 0.5 * model.pitch
    length = max(float(np.ptp(m.x)) for m in motions)
    out = []
    for m in motions:
        s = direction(m.v, dead)
        xi = since_reversal(m.x, s)
        columns = [
            hats(m.x, kx),
            hats(m.x, kx) * s[:, None],
            hats(m.v, kv),
            hats(m.u, ku),
            hats(m.a, ka),
            s[:, None] * np.exp(-xi[:, None] / (length * np.array([3e-3, 1e-2, 3e-2, 1e-1]))),
            (m.x * m.v)[:, None],
            s[:, None],
        ]
        if whole:
            wave = np.concatenate(
                [f(h * turn * m.x)[:, None] for h in range(1, HARMONICS + 1) for f in (np.sin, np.cos)],
                axis=1,
            )
            columns += [
                wave,
                wave * m.a[:, None],
                wave * (m.v**2)[:, None],
                wave * m.u[:, None],
                wave * m.v[:, None],
            ]
        out.append(np.concatenate(columns, axis=1))
    return out


def smoother_share(problem: Problem, fit: Fit) -> float:
    """Share of the residual's energy that the generic smoother explains on blocks it has not seen."""
    rest, r = smoother_rest(problem, fit), fit.residual[thinned(len(fit.residual))]
    return 1.0 - float(rest @ rest) / float(r @ r)


def smoother_rest(problem: Problem, fit: Fit, folds: int = 5) -> Array:
    """Residual that the generic smoother leaves on blocks it has not seen; the residual itself where it explains
    nothing.

    Returns:
        The rows of ``thinned``.
    """
    rows = thinned(len(fit.residual))
    motions = instrument_motion(problem, fit.model)
    columns = basis(motions, fit.model, dead_band(problem, fit.model))
    f = problem.join([problem.answer(fit.model, c) for c in columns])[rows] / problem.noise.innovation
    size = np.sqrt(np.mean(f**2, axis=0))
    f = f[:, size > 1e-12] / size[size > 1e-12]
    fold = block_ids(problem, fit.model.sample_time_s)[rows] % folds
    r = fit.residual[rows]
    return unseen(f, r, fold, [1e-2 * ridge for ridge in RIDGES])


def loud_turns(problem: Problem, fit: Fit) -> tuple[int, int, float]:
    """Count the bursts of the residual that come while the motion turns, starts or stops.

    Returns:
        Loud tenths of a second that hold such a moment or follow one, all loud ones, and the share of all tenths that
        do.
    """
    ids, energy, loud = _loud(problem, fit)
    dead, length = dead_band(problem, fit.model), max(int(BURST_S / fit.model.sample_time_s), 1)
    turns = []
    for m in smoothed_motion(problem, fit.model):
        way = np.sign(np.where(np.abs(direction(m.v, dead)) > 0.5, m.v, 0.0))
        changed = np.diff(way, prepend=way[0]) != 0.0
        turns.append(np.convolve(changed, np.ones(length), "full")[: len(way)])
    near = np.bincount(ids, weights=problem.join(turns), minlength=len(energy)) > 0.5
    return int(np.sum(loud & near)), int(np.sum(loud)), float(np.mean(near))


def _loud(problem: Problem, fit: Fit) -> tuple[NDArray[np.int64], Array, NDArray[np.bool_]]:
    """Return the tenth of a second that each sample of the residual is in, the energy of each, and whether it is
    loud.
    """
    ids = block_ids(problem, fit.model.sample_time_s, BURST_S)
    energy = np.bincount(ids, weights=fit.residual**2) / np.bincount(ids)
    return ids, energy, energy > LOUD_BLOCK * float(np.median(energy))


def bursts(problem: Problem, fit: Fit) -> float:
    """Measure how far the residual comes in bursts.

    Returns:
        The share of the energy above the quiet level that lies in loud tenths of a second; 0 where more than a
        third of the time is loud.
    """
    _, energy, loud = _loud(problem, fit)
    above = np.clip(energy - float(np.median(energy)), 0.0, None)
    if np.mean(loud) > MOST_LOUD:
        return 0.0
    return float(above[loud].sum() / max(above.sum(), 1e-300))
