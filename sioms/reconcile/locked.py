"""Waves of the residual that are locked to the place and come more often than any force of the library does.

An encoder that errs within its signal period makes them, and so do harmonics of cogging. Noise that is read from the
records takes them in: the model meets the floor, and nothing seems to be missing.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from sioms.reconcile.fit import Fit, Problem
from sioms.reconcile.model import AxisModel
from sioms.reconcile.records import Session
from sioms.reconcile.thresholds import LOCKED

#: The effect that makes them.
INTERPOLATION = "interpolation_error"
#: Parts of a turn, or of a pitch, by which places are told apart; orders are sought up to a share of them, and of the
#: encoder's steps. Below the least one, effects of the library have their turn.
PLACES, OF_PLACES, OF_STEPS, LEAST = 8192, 0.25, 0.4, 61
#: Signal periods in a pitch at least.
FIRST = 16
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
    found = waves(problem, fit, LEAST)
    return found[0] if found and found[0].share > LOCKED else None


def waves(problem: Problem, fit: Fit, least: int = FIRST, most: int = 1) -> tuple[Wave, ...]:
    """Return waves of the residual over the place that noise has none of, the strongest first.

    Args:
        least: how often they come in a pitch at least; most: how many are wanted.
    """
    places = problem.join([r.position for r in problem.session.records])
    speeds = np.abs(problem.join([np.gradient(r.position) for r in problem.session.records]))
    moving = speeds > MOVING * np.max(speeds, initial=0.0)
    pitch, steps = fit.model.pitch, fit.model.resolution
    last = int(min(OF_PLACES * PLACES, OF_STEPS * pitch / steps if steps > 0.0 else np.inf))
    if last <= least or not np.any(moving):
        return ()
    r = fit.residual[moving] - np.mean(fit.residual[moving])
    at = (np.mod(places[moving] / pitch, 1.0) * PLACES).astype(np.int64) % PLACES
    power = np.abs(np.fft.rfft(np.bincount(at, weights=r, minlength=PLACES))) ** 2 / max(float(r @ r), 1e-300)
    power[:least] = 0.0
    orders = np.argsort(-power[:last])[:most]
    return tuple(Wave(int(n), 2.0 * float(power[n]) / len(r)) for n in orders if power[n] > BY_NOISE)


def read_right(session: Session, model: AxisModel) -> Session:
    """Return records without the error of an encoder within its signal period that a model has."""
    error = model.effects.get(INTERPOLATION)
    if error is None:
        return session
    turn = 2.0 * np.pi * error["n"] / model.pitch
    return replace(
        session,
        records=tuple(
            replace(r, position=r.position - error["amp"] * np.sin(turn * r.position + error["phase"]))
            for r in session.records
        ),
    )
