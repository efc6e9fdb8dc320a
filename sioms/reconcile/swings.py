"""A number that swings with one frequency: a supply under another load, a belt that is not round."""

from __future__ import annotations

import numpy as np
from scipy.linalg import block_diag

from sioms.reconcile.course import Course, estimate
from sioms.reconcile.effect import Array
from sioms.reconcile.thresholds import GAIN, WHOLE_SWING
from sioms.reconcile.timed import waves
from sioms.reconcile.verdict import Estimate
from sioms.reconcile.windows import Number, Read, View

#: A frequency is one from so much of a period in the longest record on, up to one of so many windows a period.
LEAST_PERIOD, WINDOWS_A_PERIOD = 0.7, 4.0
ZOOMS = 6  # each halves the step of frequency


def swinging(view: View, number: Number, read: Read) -> Course | None:
    """Fit a swing of a number, with a size and a phase of its own in every record."""
    longest = max(len(s) for s in view.spans) * view.dt
    step = 0.1 / longest
    grid = np.arange(LEAST_PERIOD / longest, 1.0 / (WINDOWS_A_PERIOD * view.window * view.dt), step)
    if len(grid) == 0:
        return None
    middles = [0.5 * (c[1:] + c[:-1]) * view.dt for c in view.cuts]
    each = list(zip(middles, read.values, read.weights, strict=True))
    rough = [sum(_left(*record, f) for record in each) for f in grid]
    hz = float(grid[int(np.argmin(rough))])
    best = _sized(view, number, hz)
    for _ in range(ZOOMS):
        for f in (hz - step, hz + step):
            if f > 0.0 and (trial := _sized(view, number, f))[2] < best[2]:
                best, hz = trial, f
        step *= 0.5
    bare = _sized(view, number, hz, steady=False)
    steady = bare[2] > (1.0 + GAIN) * best[2]
    return _course(view, number, hz, best if steady else bare, steady)


def _course(view: View, number: Number, hz: float, sized: tuple[Array, Array, float], steady: bool) -> Course:
    size, spread, left = sized
    count = len(view.records)
    swung = size[-2 * count :].reshape(-1, 2)
    amplitude = float(np.sqrt(np.mean(np.sum(swung**2, axis=1))))
    wide = float(np.sqrt(np.mean(spread[-2 * count :] ** 2) / count))
    longest = max(len(s) for s in view.spans) * view.dt
    off = 1.96 * float(np.sqrt(12.0)) / (2.0 * np.pi * longest) * wide / max(amplitude, 1e-300)

    return Course(
        "swing",
        f"F = {number.force} sin(2 pi f t + phase)",
        f"the {number.text} swings in time at {hz:.3f} Hz",
        (
            estimate(view, number, amplitude, wide),
            Estimate("f", hz, hz - off, hz + off, "Hz", "frequency"),
        ),
        tuple(view.column(i, number) * (waves(len(r), hz, view.dt) @ swung[i]) for i, r in enumerate(view.records)),
        left * len(view.residual) / len(view.rows),
        1 + len(size),
        lambda view: _course(view, number, hz, _sized(view, number, hz, steady), steady),
        number.effects if hz * longest < WHOLE_SWING else (),
    )


def _left(t: Array, value: Array, weight: Array, hz: float) -> float:
    """Squares that a wave and a constant leave of values at times, each with its weight."""
    turn, root = 2.0 * np.pi * hz * t, np.sqrt(weight)
    f = np.stack([np.sin(turn), np.cos(turn), np.ones_like(t)], axis=1) * root[:, None]
    size = np.linalg.lstsq(f, value * root, rcond=1e-6)[0]
    return float(np.sum((value * root - f @ size) ** 2))


def _sized(view: View, number: Number, hz: float, steady: bool = True) -> tuple[Array, Array, float]:
    """Fit a steady part of all records, if there is one, then sine and cosine of each, as ``View.fitted``."""
    fixed, swung = [], []
    for i, r in enumerate(view.records):
        b = view.column(i, number)[:, None]
        e = view.answer(i, np.concatenate([b, b * waves(len(r), hz, view.dt)], axis=1))
        fixed.append(e[:, :1])
        swung.append(e[:, 1:])
    f = block_diag(*swung)
    return view.fitted(np.concatenate([np.concatenate(fixed), f], axis=1) if steady else f)
