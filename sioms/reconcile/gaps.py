"""How far measurement and model disagree on samples that took no part in any choice, and the floor under it.

The floor in closed loop comes from repeated laps where all that drives the axis repeats itself (difference over sqrt
2), else from sensor and drive noise propagated through the linear loop. It is an estimate of its own: what a model
reaches does not change it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sioms.reconcile.effect import Array
from sioms.reconcile.fit import Problem, closed_errors
from sioms.reconcile.model import AxisModel
from sioms.reconcile.noise import Noise, rigid
from sioms.reconcile.records import Record
from sioms.reconcile.session import State, applied, estimate, half, heats
from sioms.reconcile.simulate import replay, track
from sioms.reconcile.verdict import Gap

#: A lap repeats the command to this share of its range.
SAME_LAP = 1e-3
LEAST_LAP_S = 0.5
#: Of what differs from lap to lap in the force, known inputs may make this part.
KNOWN_PART = 0.3
LAPS, THROUGH_LOOP, OF_WINDOWS = "repeated laps", "noise through the loop", "noise of the records"


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
    force = np.sqrt(
        np.mean(np.abs(gain * close) ** 2) * noise.sensor**2 + np.mean(np.abs(loop * close) ** 2) * noise.drive**2
    )
    place = np.sqrt(np.mean(np.abs(plant * close) ** 2) * noise.drive**2 + noise.sensor**2)
    return float(force), float(place)


def measure(problem: Problem, nominal: AxisModel, model: AxisModel, states: Sequence[State] = ()) -> tuple[Gap, ...]:
    """Compare before and after on the samples of ``problem`` (the untouched ones).

    Args:
        states: session parameters of each record, estimated on the first halves; the scores that use them, and
            those of the frozen model to set beside them, are of the second halves.
    """
    unit, k = nominal.force_unit, problem.noise.drive  # an expected innovation answers to one drive noise
    before, after = _rms(problem.residual(nominal)) * k, _rms(problem.residual(model)) * k
    late = [_late_errors(problem, model, s) for s in ([], states)] if states else [(None,) * 3] * 2
    frozen, session = late
    out = [Gap("force, short windows", unit, before, after, k, frozen[0], session[0], OF_WINDOWS)]
    if nominal.controller is None or any(r.command is None for r in problem.session.records):
        return tuple(out)
    errors = [closed_errors(problem, m) for m in (nominal, model)]
    floors = [lap_floor(r, p) for r in problem.session.records if (p := lap(r, nominal.sample_time_s))]
    if floors:
        force, place = (float(np.median([f[i] for f in floors])) for i in (0, 1))
    else:
        force, place = loop_floor(nominal, problem.noise)
    how = LAPS if floors else THROUGH_LOOP
    out.append(Gap("force, closed loop", unit, errors[0][0], errors[1][0], force, frozen[1], session[1], how))
    place_unit = nominal.position_unit
    out.append(Gap("position, closed loop", place_unit, errors[0][1], errors[1][1], place, frozen[2], session[2], how))
    return tuple(out)


def session_states(problem: Problem, model: AxisModel) -> tuple[State, ...]:
    """Estimate the session parameters of every record on the first half of its samples in ``problem``."""
    return tuple(
        estimate(problem, model, r, half(problem, r), heat)
        for r, heat in zip(problem.session.records, heats(problem, model), strict=True)
    )


def _late_errors(problem: Problem, model: AxisModel, states: Sequence[State]) -> tuple[float | None, ...]:
    """Errors over the second halves: of short windows [{F}], and in closed loop of force and position."""
    windows, force, place = [], [], []
    unit = problem.noise.drive / problem.noise.innovation
    for i, (r, heat) in enumerate(zip(problem.session.records, heats(problem, model), strict=True)):
        m, seen = applied(model, r, states[i]) if states else (model, r)
        start = states[i].heat if states else heat
        part = slice(half(problem, r), problem.span(r).stop)
        run = track(m, seen.position, seen.force, problem.noise, start, external=seen.external)
        windows.append(run.innovation[part] * unit)
        if model.controller is not None and seen.command is not None:
            run = replay(m, seen, start)
            force.append(np.nan_to_num(run.force - seen.force, nan=1e9)[part])
            place.append(np.nan_to_num(run.position - seen.position, nan=1e9)[part])
    return tuple(_rms(np.concatenate(e)) if e else None for e in (windows, force, place))


def rungs(problem: Problem, models: Sequence[AxisModel]) -> tuple[float, ...]:
    """Force error of each model on the samples of ``problem``: in closed loop where it can be, [{F}]."""
    closed = all(r.command is not None for r in problem.session.records)
    return tuple(
        closed_errors(problem, m)[0]
        if closed and m.controller is not None
        else _rms(problem.residual(m)) * problem.noise.drive
        for m in models
    )


def _rms(x: Array) -> float:
    return float(np.sqrt(np.mean(x**2)))
