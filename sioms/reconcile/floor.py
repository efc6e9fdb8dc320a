"""The floor: how far a right model would be from the records, by noise alone.

In closed loop it comes from repeated laps where all that drives the axis repeats itself (difference over sqrt 2), else
from the disturbance that short windows show, put on the model (``disturbance``). It is an estimate of its own: what a
model reaches does not change it, and nothing is cut off at it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sioms.reconcile.disturbance import Disturbance
from sioms.reconcile.effect import Array
from sioms.reconcile.fit import Problem
from sioms.reconcile.model import AxisModel
from sioms.reconcile.noise import rigid
from sioms.reconcile.records import Record
from sioms.reconcile.simulate import replay

#: A lap repeats the command to this share of its range.
SAME_LAP = 1e-3
LEAST_LAP_S = 0.5
#: Of what differs from lap to lap in the force, known inputs may make this part.
KNOWN_PART = 0.3
#: Times that noise is drawn.
DRAWS = 3
LAPS, ON_MODEL, OF_WINDOWS = "repeated laps", "noise of the records on the model", "noise of the records"


@dataclass(frozen=True, slots=True)
class Floor:
    """Force [{F}] and position [{x}] that noise leaves in closed loop, root mean square, and how that was found."""

    force: float
    place: float
    how: str


def closed_floor(problem: Problem, model: AxisModel, noise: Disturbance, rng: np.random.Generator) -> Floor:
    """Return the floor of the closed loop on the samples of ``problem``; that of short windows without a controller."""
    records = problem.session.records
    if model.controller is None or any(r.command is None for r in records):
        return Floor(problem.noise.drive, problem.noise.sensor, OF_WINDOWS)
    laps = [lap_floor(r, p) for r in records if (p := lap(r, model.sample_time_s))]
    if laps:
        force, place = (float(np.median([f[i] for f in laps])) for i in (0, 1))
        chatter = _of_counts(problem, model)
        return Floor(float(np.hypot(force, chatter[0])), float(np.hypot(place, chatter[1])), LAPS)
    force, place = _under_noise(problem, model, noise, rng)
    own = problem.noise.sensor**2 - model.resolution**2 / 12.0  # counts are in the simulation
    return Floor(float(np.hypot(force, _by_sensor(model) * np.sqrt(max(own, 0.0)))), place, ON_MODEL)


def lap(record: Record, sample_time_s: float) -> int:
    """Return the period in samples of all that drives the axis, 0 where it does not repeat.

    Laps of one command are no laps where a known force or a test signal differs from one to the next by more than a
    part of what
    differs in the force: that would pass for noise.
    """
    period = _period(record, sample_time_s)
    if period:
        noise, _ = lap_floor(record, period)
        inputs = [u for u in (record.external, record.feedforward) if u is not None]
        if any(_lap_difference(u, period) > KNOWN_PART * noise for u in inputs):
            return 0
    return period


def _lap_difference(signal: Array, period: int) -> float:
    return float(np.std(signal[period:] - signal[:-period]) / np.sqrt(2.0))


def _period(record: Record, sample_time_s: float) -> int:
    """Return the period of the command in samples, 0 where it does not repeat."""
    c = record.command
    if c is None or np.ptp(c) == 0.0:
        return 0
    n, least = len(c), int(LEAST_LAP_S / sample_time_s)
    if n < 3 * least:
        return 0
    z = c - c.mean()
    size = 1 << int(np.ceil(np.log2(2 * n)))
    shared = np.fft.irfft(np.abs(np.fft.rfft(z, size)) ** 2)[: 2 * n // 3]
    energy = np.concatenate([[0.0], np.cumsum(z**2)])
    q = np.arange(len(shared))
    apart = (energy[n] - energy[q] + energy[n - q] - 2.0 * shared) / (n - q)
    good = np.flatnonzero(apart[least:] < (SAME_LAP * np.ptp(c)) ** 2) + least
    if not len(good):
        return 0
    first = good[: int(np.argmax(np.diff(np.append(good, n)) > 1)) + 1]  # the first run of close shifts
    return int(first[np.argmin(apart[first])])


def lap_floor(record: Record, period: int) -> tuple[float, float]:
    """Root mean square lap-to-lap difference over sqrt 2: of force and of position."""
    return _lap_difference(record.force, period), _lap_difference(record.position, period)


def _under_noise(
    problem: Problem, model: AxisModel, noise: Disturbance, rng: np.random.Generator
) -> tuple[float, float]:
    """Put noise on a model in closed loop; return how far force and position then are, root mean square.

    Where it sticks, bounces or saturates otherwise in one draw, that draw is far from the others: the median of them
    counts.
    """
    drawn = []
    for _ in range(DRAWS):
        pushed, heat = [], 0.0
        for r in problem.session.records:
            known = 0.0 if r.external is None else r.external
            clean = replay(model, r, heat)
            other = replay(model, replace(r, external=known + noise.drawn(len(r), rng)), heat)
            heat = clean.end_temperature if problem.session.continuous else 0.0
            pushed.append((other.force - clean.force, other.position - clean.position))
        drawn.append([_rms(np.nan_to_num(problem.join([p[i] for p in pushed]))) for i in (0, 1)])
    force, place = np.median(drawn, axis=0)
    return float(force), float(place)


def _of_counts(problem: Problem, model: AxisModel) -> tuple[float, float]:
    """How far counts alone move the simulated closed loop: laps share theirs with each other, no simulation does."""
    smooth, off, heat = replace(model, resolution=0.0), [], 0.0
    for r in problem.session.records:
        runs = [replay(m, r, heat) for m in (model, smooth)]
        heat = runs[0].end_temperature if problem.session.continuous else 0.0
        off.append((runs[0].force - runs[1].force, runs[0].position - runs[1].position))
    force, place = (_rms(np.nan_to_num(problem.join([o[i] for o in off]))) for i in (0, 1))
    return force, place


def _by_sensor(model: AxisModel) -> float:
    """Force per noise of the sensor in the linear closed loop, root mean square, [{F}/{x}]."""
    c = model.controller
    if c is None:
        return 0.0
    z = np.exp(1j * np.linspace(1e-3, np.pi, 4096))
    a, b = rigid(model)
    plant = (b[0] * (z - a[1, 1]) + a[0, 1] * b[1]) / ((z - a[0, 0]) * (z - a[1, 1]) - a[0, 1] * a[1, 0])
    alpha = 1.0 - np.exp(-2.0 * np.pi * c.velocity_filter_hz * model.sample_time_s) if c.velocity_filter_hz else 1.0
    speed = alpha * (1.0 - 1.0 / z) / model.sample_time_s / (1.0 - (1.0 - alpha) / z)
    gain = (c.k * (1.0 + c.kz / z) - c.kb * speed) / (1.0 + c.kp / z)
    return float(np.sqrt(np.mean(np.abs(gain / (1.0 + gain * plant)) ** 2)))


def _rms(x: Array) -> float:
    return float(np.sqrt(np.mean(x**2)))
