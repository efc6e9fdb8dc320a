"""Waves of the residual that are locked to the place and come more often than any effect of the library does.

An encoder that errs within its signal period makes them, and so do harmonics of cogging. Noise that is read from the
records takes them in: the model meets the floor, and nothing seems to be missing.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sioms.reconcile.fit import Fit, Problem
from sioms.reconcile.thresholds import LOCKED

#: Parts of a turn, or of a pitch, by which places are told apart; orders are sought up to a share of them, and of the
#: encoder's steps. Below the least one, effects of the library have their turn.
PLACES, OF_PLACES, OF_STEPS, LEAST = 8192, 0.25, 0.4, 61
#: Slower motion than this share of the fastest stays in one place.
MOVING = 0.05
#: What any of a thousand orders of noise has at most, over the mean of all.
BY_NOISE = 40.0


class Wave(NamedTuple):
    """A wave that is locked to the place: how often it comes in a pitch, and its share of the residual's squares."""

    order: int
    share: float

    @property
    def text(self) -> str:
        """Say what it may be."""
        return (
            f"{100 * self.share:.2g} % of what is taken for noise comes {self.order} times in a pitch: an encoder that "
            "errs within its signal period, or a harmonic of cogging"
        )


def locked(problem: Problem, fit: Fit) -> Wave | None:
    """Return the strongest wave of the residual over the place; None where noise has such ones, or nothing moves."""
    places = problem.join([r.position for r in problem.session.records])
    speeds = np.abs(problem.join([np.gradient(r.position) for r in problem.session.records]))
    moving = speeds > MOVING * np.max(speeds, initial=0.0)
    pitch, steps = fit.model.pitch, fit.model.resolution
    most = int(min(OF_PLACES * PLACES, OF_STEPS * pitch / steps if steps > 0.0 else np.inf))
    if most <= LEAST or not np.any(moving):
        return None
    r = fit.residual[moving] - np.mean(fit.residual[moving])
    at = (np.mod(places[moving] / pitch, 1.0) * PLACES).astype(np.int64) % PLACES
    power = np.abs(np.fft.rfft(np.bincount(at, weights=r, minlength=PLACES))) ** 2 / max(float(r @ r), 1e-300)
    order = LEAST + int(np.argmax(power[LEAST:most]))
    share = 2.0 * float(power[order]) / len(r)
    return Wave(order, share) if power[order] > BY_NOISE and share > LOCKED else None
