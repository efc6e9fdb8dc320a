"""Free simulation: how far a model that nothing holds on the measurement comes from it.

Short windows behind an observer hide what a model is worth as a model: a resonance that is wrong, friction above the
force of the drive, a force that was fitted for another. Here the recorded force alone drives the model, over long
segments and whole records. The state at the start of a segment is fitted to the segment (shooting), as it is a
property of the segment and not of the model. The floor is the same model under noise, fitted in the same way.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sioms.reconcile import kernel as k
from sioms.reconcile.disturbance import Disturbance
from sioms.reconcile.effect import Array
from sioms.reconcile.fit import Problem
from sioms.reconcile.floor import DRAWS
from sioms.reconcile.model import AxisModel
from sioms.reconcile.noise import Noise
from sioms.reconcile.records import Record
from sioms.reconcile.simulate import Packed, Run, pack, released

#: Lengths of segments, and the least number of samples in one.
HORIZONS_S, LEAST_SAMPLES = (0.25, 1.0), 24
#: Segments of one length at most, evenly over all records.
MOST_SEGMENTS = 40
#: Steps of the fit of a start, and the shares of one that are tried.
STEPS, SHARES = 4, (1.0, 0.3, 0.1)
#: Farther than so many ranges of the segment's motion nothing is counted: the model has left.
FAR = 10.0
#: A machine moves, and a model sticks, over at least so long.
STUCK_S = 0.05


@dataclass(frozen=True, slots=True)
class Segment:
    """A part of a record.

    Attributes:
        place, speed, heat: state of a model at its first sample, as an observer has it.
    """

    record: Record
    start: int
    stop: int
    place: float
    speed: float
    heat: float


@dataclass(frozen=True, slots=True)
class Flight:
    """A model over one segment, running free from the start that fits best; shape (n,) each.

    Attributes:
        error: of position, [{x}]; bounded.
        slopes: of position with the numbers of the start, shape (n, k).
        run: of the model.
    """

    error: Array
    slopes: Array
    run: Run


@dataclass(frozen=True, slots=True)
class Freely:
    """How far models come from the measurement over segments of one length, root mean square, [{x}].

    Attributes:
        horizon_s: length of the segments; infinite for what is there of each record as a whole.
        moved: of the measured motion about what a constant speed explains.
        stuck: share of the measured way that passes while the model after is at rest.
    """

    horizon_s: float
    before: float
    after: float
    floor: float
    moved: float
    stuck: float

    @property
    def over(self) -> str:
        """The length of the segments in words."""
        return f"over {self.horizon_s:g} s" if np.isfinite(self.horizon_s) else "over whole records"


def freely(
    problems: tuple[Problem, Problem],
    models: tuple[AxisModel, AxisModel],
    noise: Disturbance,
    rng: np.random.Generator,
) -> tuple[Freely, ...]:
    """Let two models, before and after, run free over the samples of their problems, over segments of every length that
    the records hold.
    """
    dt, records = models[0].sample_time_s, problems[0].session.records
    cuts = {h: [_cuts(problems[0], r, h, dt) for r in records] for h in (*HORIZONS_S, np.inf)}
    every = {str(c): h for h, c in cuts.items() if any(c)}  # what is no longer than a segment is whole
    return tuple(_over(problems, models, noise, rng, horizon) for horizon in every.values())


def errors(problem: Problem, model: AxisModel, horizon_s: float) -> Array:
    """Return how far a model that runs free over segments of a length is from the measurement, shape (n,), [{x}]; none
    where no record holds one.
    """
    packed = pack(model)
    off = [flight(model, packed, s).error for s in _segments(problem, model, horizon_s)]
    return np.concatenate(off) if off else np.empty(0)


def moved(problem: Problem, model: AxisModel, horizon_s: float) -> Array:
    """Return the measured motion over the same segments about what a constant speed explains, shape (n,), [{x}]."""
    parts = [s.record.position[s.start : s.stop] for s in _segments(problem, model, horizon_s)]
    off = [_beside(y, np.vander(np.arange(len(y), dtype=np.float64), 2)) for y in parts]
    return np.concatenate(off) if off else np.empty(0)


def _over(
    problems: tuple[Problem, Problem],
    models: tuple[AxisModel, AxisModel],
    noise: Disturbance,
    rng: np.random.Generator,
    horizon: float,
) -> Freely:
    squares, pushed, way, stuck = np.zeros(3), np.zeros(DRAWS), 0.0, 0.0
    count, packed = 0, [pack(m) for m in models]
    both = [_segments(q, m, horizon) for q, m in zip(problems, models, strict=True)]
    for segments in zip(*both, strict=True):
        y = segments[0].record.position[segments[0].start : segments[0].stop]
        flights = [flight(*each) for each in zip(models, packed, segments, strict=True)]
        line = _beside(y, np.vander(np.arange(len(y), dtype=np.float64), 2))
        squares += [float(np.sum(e**2)) for e in (flights[0].error, flights[1].error, line)]
        drawn = (_pushed(models[1], packed[1], segments[1], flights[1], noise, problems[1].noise, rng) for _ in pushed)
        pushed += [float(np.sum(e**2)) for e in drawn]
        count += len(y)
        moves, rests = np.abs(np.diff(y)), _at_rest(flights[1].run.v, models[1])
        way, stuck = way + float(np.sum(moves)), stuck + float(np.sum(moves[rests[:-1]]))
    before, after, moved = np.sqrt(squares / max(count, 1)).tolist()
    floor = float(np.sqrt(np.median(pushed) / max(count, 1)))
    return Freely(horizon, before, after, floor, moved, stuck / max(way, 1e-300))


def _cuts(problem: Problem, record: Record, horizon: float, dt: float) -> list[tuple[int, int]]:
    """Return the ends of the segments of a record; none where it does not hold one of that length."""
    span = problem.span(record)
    n = span.stop - span.start
    if not np.isfinite(horizon):
        return [(span.start, span.stop)] if n >= LEAST_SAMPLES else []
    size = max(round(horizon / dt), LEAST_SAMPLES)
    ends = np.linspace(span.start, span.stop, n // size + 1).astype(int)
    return list(zip(ends[:-1].tolist(), ends[1:].tolist(), strict=True)) if n >= size else []


def _segments(problem: Problem, model: AxisModel, horizon: float) -> Iterator[Segment]:
    """Yield the segments of all records, with the heat that a model has at their starts."""
    every = [
        Segment(record, a, b, float(run.x[a]), float(run.v[a]), float(run.temperature[a]))
        for record, run in zip(problem.session.records, problem.runs(model), strict=True)
        for a, b in _cuts(problem, record, horizon, model.sample_time_s)
    ]
    chosen = np.unique(np.linspace(0, len(every) - 1, min(len(every), MOST_SEGMENTS)).astype(int)) if every else ()
    return (every[i] for i in chosen)


def flight(model: AxisModel, packed: Packed, segment: Segment) -> Flight:
    """Run a model free over a segment, from the start that leaves least of it."""
    y = segment.record.position[segment.start : segment.stop]
    far = FAR * max(float(np.ptp(y)), model.resolution, 1e-300)
    start, steps = _start(model, packed, segment)

    def off(run: Run) -> Array:
        return np.clip(np.nan_to_num(run.position - y, nan=far, posinf=far, neginf=-far), -far, far)

    run = _run(packed, segment, start)
    error, slopes = off(run), np.empty((len(y), 0))
    for _ in range(STEPS):
        slopes = np.stack([off(_run(packed, segment, start + s)) - error for s in steps], axis=1)
        step = steps.T @ np.linalg.lstsq(slopes, error, rcond=1e-9)[0]
        for share in SHARES:
            trial = _run(packed, segment, start - share * step)
            new = off(trial)
            if new @ new < (1.0 - 1e-4) * (error @ error):
                run, error, start = trial, new, start - share * step
                break
        else:
            break
    return Flight(error, slopes, run)


def _start(model: AxisModel, packed: Packed, segment: Segment) -> tuple[Array, Array]:
    """Return a first guess of the state at the start of a segment, and small steps of what is not known of it."""
    dt, p = model.sample_time_s, packed.plant
    y = segment.record.position[segment.start : segment.stop]
    before = segment.record.force[max(segment.start - 1, 0)]
    start = np.array([segment.place, segment.speed, segment.heat, 0.0, before, 0.0, 0.0])
    slow = 1e-3 * max(float(np.ptp(y)) / (len(y) * dt), model.resolution / dt, 1e-6 * model.max_speed)
    steps = np.zeros((2 if p[k.LOAD] == 0.0 or p[k.GAP] > 0.0 else 4, len(start)))
    steps[0, 0], steps[1, 1] = 1e-3 * max(float(np.ptp(y)), model.resolution), slow
    if len(steps) > 2:  # two masses in contact: the wind-up between them, and its rate
        steps[2, 5], steps[3, 6] = slow * dt, slow
    return start, steps


def _run(packed: Packed, segment: Segment, start: Array, force: Array | None = None) -> Run:
    part = slice(segment.start, segment.stop)
    record = segment.record.cut(part.start, part.stop)
    known = record.external
    both = known if force is None else force if known is None else known + force
    return released(packed, record.force, start, both, record.bends)


def _pushed(
    model: AxisModel,
    packed: Packed,
    segment: Segment,
    clean: Flight,
    push: Disturbance,
    noise: Noise,
    rng: np.random.Generator,
) -> Array:
    """Return the error that noise leaves over a segment, beside what another start would make up for."""
    n = segment.stop - segment.start
    start, _ = _start(model, packed, segment)
    start[0], start[1] = clean.run.x[0], clean.run.v[0]
    runs = [_run(packed, segment, start, force).position for force in (None, push.drawn(n, rng))]
    off = np.nan_to_num(runs[1] - runs[0]) + noise.sensor * rng.standard_normal(n)
    return _beside(off, clean.slopes)


def _beside(error: Array, slopes: Array) -> Array:
    """Return what slopes leave of an error."""
    if slopes.shape[1] == 0:
        return error
    out: Array = error - slopes @ np.linalg.lstsq(slopes, error, rcond=1e-9)[0]
    return out


def _at_rest(v: Array, model: AxisModel) -> NDArray[np.bool_]:
    """Say where a model rests, and has rested for longer than a turn of its motion takes."""
    rests = np.abs(v) <= 1e-6 * model.max_speed
    size = max(round(STUCK_S / model.sample_time_s), 2)
    return np.asarray(np.convolve(rests, np.ones(size), "same") >= 0.999 * size)
