"""The drive noise by what the innovations show, where the measured force does not tell it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from sioms.reconcile.checks import LEAST_COUNTS
from sioms.reconcile.effect import Array
from sioms.reconcile.fit import Problem, block_ids, refit
from sioms.reconcile.floor import lap
from sioms.reconcile.locked import read_right
from sioms.reconcile.model import AxisModel
from sioms.reconcile.noise import Noise, moves_at, observer, sensor_noise
from sioms.reconcile.records import Session
from sioms.reconcile.refuse import smoother_rest
from sioms.reconcile.screen import thinned
from sioms.reconcile.tones import hum

#: Bandwidth of the observer where no force was measured: with the colour of the drive noise unknown, what
#: happens above it would drown the mechanics below.
UNMEASURED_HZ = 20.0
#: No model is asked to be nearer than this share of the rated force; below it lies the exactness of any simulation.
LEAST_DRIVE = 1e-3
#: The noise of a current sensor is taken out of the drive's from so many tenths of a second in motion.
LEAST_MOVING = 20


def calibrated(problem: Problem, session: Session, model: AxisModel) -> Problem:
    """Set the drive noise to what the innovations show, where no force was measured or its own noise is the larger.

    Laps give it free of any model error (difference over sqrt 2). Without laps it is what the quietest quarter of the
    time holds, after a first refit, of what no smooth function of the state explains: Coulomb friction, alike
    everywhere, would else pass for noise.
    """
    if any(r.force_measured is not None for r in session.records):
        return _lowered(problem, model, lambda drive: observer(model, problem.noise.sensor, drive))
    laps = [lap(r, model.sample_time_s) for r in session.records]
    coarse = model.effects.get("encoder_quantisation", {}).get("factor", 1.0)
    sensor = sensor_noise(read_right(session, model), model.resolution * coarse)
    hertz = max(UNMEASURED_HZ, moves_at(session, sensor, model.sample_time_s))
    stiffness = model.inertia * (2.0 * np.pi * hertz) ** 2
    problem = replace(problem, noise=observer(model, max(sensor, problem.noise.drive / stiffness), problem.noise.drive))
    for _ in range(2):
        if any(laps):
            pairs = [
                (r.innovation[p:] - r.innovation[:-p]) / np.sqrt(2.0)
                for r, p in zip(problem.runs(model), laps, strict=True)
                if p
            ]
            noise = np.concatenate(pairs) / problem.noise.innovation
            size = max(round(0.1 / model.sample_time_s), 1)
            energy = np.mean(noise[: len(noise) // size * size].reshape(-1, size) ** 2, axis=1)
            excess = float(np.sqrt(np.median(energy)))
        else:
            fit = refit(problem, model, iterations=3)
            if (line := hum(problem, fit)) is not None:  # no noise, however much it drowns
                fit = replace(fit, residual=fit.residual - line.trace)
            ids = block_ids(problem, model.sample_time_s, 0.1)[thinned(len(fit.residual))]
            energy = np.bincount(ids, weights=smoother_rest(problem, fit) ** 2) / np.bincount(ids)
            excess = float(np.sqrt(np.quantile(energy, 0.25)))
        least = LEAST_DRIVE * model.rated_force
        drive = float(np.clip(problem.noise.drive * excess, least, None))
        # A drive without noise has none whose colour is unknown: then the observer may be as fast as the sensor allows.
        problem = replace(
            problem,
            noise=observer(model, sensor if drive < 2.0 * least else max(sensor, drive / stiffness), drive),
        )
    return _lowered(problem, model, lambda drive: observer(model, max(sensor, drive / stiffness), drive))


def _lowered(problem: Problem, model: AxisModel, design: Callable[[float], Noise]) -> Problem:
    """Halve the drive noise while that is more likely, by the innovations of most of the time in motion.

    A measured force has noise of its own, of which the axis feels nothing; and where the sensor makes most of the
    innovation, its size says little of the drive, but too fast an observer is seen.
    """
    bare = replace(problem, weights=None)
    ids = block_ids(bare, model.sample_time_s, 0.1)
    edges = np.searchsorted(ids, np.arange(ids.max() + 1))
    place = bare.join([r.position for r in bare.session.records])
    travel = np.maximum.reduceat(place, edges) - np.minimum.reduceat(place, edges)
    moving = travel > LEAST_COUNTS * model.resolution
    if np.sum(moving) < LEAST_MOVING:
        return problem

    def unlikely(noise: Noise) -> Array:
        energy = np.add.reduceat(replace(bare, noise=noise).residual(model) ** 2, edges) / np.bincount(ids)
        cost: Array = energy[moving] + 2.0 * np.log(noise.innovation)
        return cost

    noise, cost = problem.noise, unlikely(problem.noise)
    while noise.drive > 2.0 * LEAST_DRIVE * model.rated_force:
        lower = design(0.5 * noise.drive)
        trial = unlikely(lower)
        if np.median(trial - cost) >= 0.0:
            break
        noise, cost = lower, trial
    return replace(problem, noise=noise)
