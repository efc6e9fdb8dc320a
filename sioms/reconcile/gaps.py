"""How far measurement and model disagree on samples that took no part in any choice, and the floor under it.

The floor in closed loop comes from repeated laps where the command repeats itself (difference over sqrt 2),
else from sensor and drive noise propagated through the linear loop.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sioms.reconcile.effect import Array
from sioms.reconcile.fit import Problem
from sioms.reconcile.model import AxisModel
from sioms.reconcile.noise import Noise, response, rigid
from sioms.reconcile.records import Record
from sioms.reconcile.simulate import replay
from sioms.reconcile.verdict import Gap

#: A lap repeats the command to this share of its range.
SAME_LAP = 1e-3
LEAST_LAP_S = 0.5


def lap(record: Record, sample_time_s: float) -> int:
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
    f, y = record.force[period:] - record.force[:-period], record.position[period:] - record.position[:-period]
    return float(np.std(f) / np.sqrt(2.0)), float(np.std(y) / np.sqrt(2.0))


def loop_floor(model: AxisModel, noise: Noise) -> tuple[float, float]:
    """Force and position that sensor and drive noise make in the linear closed loop, root mean square."""
    c = model.controller
    if c is None:
        return noise.drive, noise.sensor
    z = np.exp(1j * np.linspace(1e-3, np.pi, 4096))
    a, b = rigid(model)
    plant = (b[0] * (z - a[1, 1]) + a[0, 1] * b[1]) / ((z - a[0, 0]) * (z - a[1, 1]) - a[0, 1] * a[1, 0])
    alpha = 1.0 - np.exp(-2.0 * np.pi * c.velocity_filter_hz * model.sample_time_s) if c.velocity_filter_hz else 1.0
    speed = alpha * (1.0 - 1.0 / z) / model.sample_time_s / (1.0 - (1.0 - alpha) / z)
    gain = (c.k * (1.0 + c.kz / z) - c.kb * speed) / (1.0 + c.kp / z)
    loop = gain * plant
    close = 1.0 / (1.0 + loop)
    force = np.sqrt(np.mean(np.abs(gain * close) ** 2) * noise.sensor**2 + np.mean(np.abs(loop * close) ** 2) * noise.drive**2)
    place = np.sqrt(np.mean(np.abs(plant * close) ** 2) * noise.drive**2 + noise.sensor**2)
    return float(force), float(place)


def measure(problem: Problem, nominal: AxisModel, model: AxisModel) -> tuple[Gap, ...]:
    """Compare before and after on the samples of ``problem`` (the untouched ones)."""
    unit, k = nominal.force_unit, problem.noise.drive  # an expected innovation answers to one drive noise
    before, after = problem.residual(nominal), problem.residual(model)
    out = [Gap("force, short windows", unit, _rms(before) * k, _rms(after) * k, k, with_session(problem, model, after) * k)]
    if nominal.controller is None or any(r.command is None for r in problem.session.records):
        return tuple(out)
    errors = [closed_errors(problem, m) for m in (nominal, model)]
    floors = [lap_floor(r, p) for r in problem.session.records if (p := lap(r, nominal.sample_time_s))]
    force, place = (float(np.median([f[i] for f in floors])) for i in (0, 1)) if floors else loop_floor(nominal, problem.noise)
    out.append(Gap("force, closed loop", unit, errors[0][0], errors[1][0], force))
    out.append(Gap("position, closed loop", nominal.position_unit, errors[0][1], errors[1][1], place))
    return tuple(out)


def rungs(problem: Problem, models: Sequence[AxisModel]) -> tuple[float, ...]:
    """Force error of each model on the samples of ``problem``: in closed loop where it can be, [{F}]."""
    closed = all(r.command is not None for r in problem.session.records)
    return tuple(closed_errors(problem, m)[0] if closed and m.controller is not None
                 else _rms(problem.residual(m)) * problem.noise.drive for m in models)


def closed_errors(problem: Problem, model: AxisModel) -> tuple[float, float]:
    """Root mean square error of the simulated closed loop in force and position."""
    force, place, temperature = [], [], 0.0
    for r in problem.session.records:
        run = replay(model, r, temperature)
        temperature = run.end_temperature if problem.session.continuous else 0.0
        force.append(np.nan_to_num(run.force - r.force, nan=1e9))
        place.append(np.nan_to_num(run.position - r.position, nan=1e9))
    return _rms(problem.join(force)), _rms(problem.join(place))


def with_session(problem: Problem, model: AxisModel, residual: Array) -> float:
    """Residual after a session offset of force is re-estimated on the first half of each untouched part.

    Returns:
        Root mean square over the second halves, in units of the expected innovation.
    """
    ones = [response(model, problem.noise, np.ones(len(r))) for r in problem.session.records]
    column = problem.join(ones) / problem.noise.innovation
    left, at = [], 0
    for r in problem.session.records:
        n = len(range(len(r))[problem.span(r)])
        e, c = residual[at : at + n], column[at : at + n]
        half = n // 2
        size = float(c[:half] @ c[:half])
        offset = float(e[:half] @ c[:half]) / size if size > 0.0 else 0.0
        left.append(e[half:] - offset * c[half:])
        at += n
    return _rms(np.concatenate(left))


def _rms(x: Array) -> float:
    return float(np.sqrt(np.mean(x**2)))
