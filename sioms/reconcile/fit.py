"""Fit the switched-on effects of a model to records, nested in the tracking simulation.

The residual is the innovation over its expected standard deviation: what the model cannot predict over the
observer's short memory. It follows the measurement, so that stick, slip and contact happen where they did
happen, and it is smooth in the parameters where a free closed loop is not.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sioms.reconcile.effect import Array, Parameter, Slot
from sioms.reconcile.effects import known
from sioms.reconcile.engine.fit import BASE, Free, fitted, get, put
from sioms.reconcile.engine.fit import Fit as AnyFit
from sioms.reconcile.model import AxisModel
from sioms.reconcile.noise import Noise, response
from sioms.reconcile.records import Record, Session
from sioms.reconcile.simulate import Run, inertia, linked, pack, replay, track

#: ``map``, or the like of an executor.
Mapper = Callable[[Callable[[Any], Any], Iterable[Any]], Iterable[Any]]
Fit = AnyFit[AxisModel]
#: Length of a block of time, which is held out as a whole.
BLOCK_S = 0.5
#: Samples, and seconds, at the start of a record in which the observer finds the state.
SKIP, SKIP_S = 50, 0.05

#: A change of the residual by the small step of a slope may be a jump from this size on, and where it is so many times
#: the usual one.
JUMP, PEAK = 1.0, 8.0
#: Share of a positive number that a step of a fit leaves at least.
LEFT = 0.3
#: A model whose friction falls with speed has two speeds at which it agrees with a force. It has lost the measurement
#: where the innovation stays this many times over the expected one, and over its own median, for so many samples.
LOST, LOST_SHARE, LOST_SAMPLES = 10.0, 8.0, 50


@dataclass(frozen=True, slots=True)
class Problem:
    """Records to fit and the observer to fit them with.

    Attributes:
        begin, end: share of each record that counts; the rest is simulated but not looked at.
        weights: factor on each residual, shape (n,), for resampled blocks; None: all alike.
        bend: residuals beyond this count little more than it (Cauchy's loss): bounces in a gap that come a little late
            or early.
        mapper: applies a function to many trials, in order, as ``map`` does; one that uses all cores may be given. Not
            to be used within a trial: every fit uses it, and a pool that waits for itself waits for ever.
    """

    session: Session
    noise: Noise
    skip: int = SKIP
    begin: float = 0.0
    end: float = 1.0
    weights: Array | None = None
    bend: float = np.inf
    mapper: Mapper = map

    def span(self, record: Record) -> slice:
        """Samples of a record that count: from ``begin`` to ``end`` of it, never the first ``skip``."""
        n = len(record)
        return slice(max(self.skip, int(self.begin * n)), int(self.end * n))

    def runs(self, model: AxisModel) -> list[Run]:
        """Track every record; the heat state carries over."""
        packed, falling = pack(model), _falls(model)
        temperature, out = 0.0, []
        for r in self.session.records:
            run = track(model, r.position, r.force, self.noise, temperature, packed, external=r.external, bends=r.bends)
            if falling and (level := self._lost(run)) < np.inf:
                run = track(model, r.position, r.force, self.noise, temperature, packed, level, r.external, r.bends)
            temperature = run.end_temperature if self.session.continuous else 0.0
            out.append(run)
        return out

    def answer(self, model: AxisModel, force: Array) -> Array:
        """Return the innovation [{x}] that an unmodelled force on the motor, shape (n,) or (n, k), leaves."""
        return self.answering(model)(force)

    def answering(self, model: AxisModel) -> Callable[[Array], Array]:
        """Return ``answer`` of a model, for many forces."""
        packed = pack(model)
        rigid, pair = replace(model, inertia=inertia(packed)), linked(packed)
        return lambda force: response(rigid, self.noise, force, pair)

    def _lost(self, run: Run) -> float:
        """Return the innovation beyond which a run has lost the measurement; infinite where it never has."""
        size = np.abs(np.nan_to_num(run.innovation))
        level = LOST * self.noise.innovation
        if _longest(size > level) <= LOST_SAMPLES:
            return np.inf
        level = max(level, LOST_SHARE * float(np.median(size)))
        return level if _longest(size > level) > LOST_SAMPLES else np.inf

    def residual(self, model: AxisModel) -> Array:
        """Innovations over their expected standard deviation, all records in a row, without the starts."""
        e = self.join([r.innovation for r in self.runs(model)]) / self.noise.innovation
        e = np.clip(np.nan_to_num(e, nan=1e6, posinf=1e6, neginf=-1e6), -1e6, 1e6)
        if self.bend < np.inf:
            e = self.bend * np.sign(e) * np.sqrt(np.log1p((e / self.bend) ** 2))
        return e * self.factors

    @property
    def factors(self) -> Array | float:
        """Factors on the residual: of the blocks that are drawn anew, and of samples whose force is known less; shape
        (n,), or 1.
        """
        records = self.session.records
        if all(r.trust is None for r in records):
            return 1.0 if self.weights is None else self.weights
        trust = self.join([np.ones(len(r)) if r.trust is None else r.trust for r in records])
        return trust if self.weights is None else trust * self.weights

    def slope(self, residual: Array) -> Array:
        """How a residual, as ``residual`` gives it, goes with the innovation over its expected standard deviation,
        shape (n,).
        """
        weights = np.ones_like(residual) * self.factors
        if self.bend == np.inf:
            return weights
        bent = (residual / np.where(weights > 0.0, weights, 1.0) / self.bend) ** 2
        straight = np.expm1(bent)
        return weights * np.sqrt(np.where(bent > 0.0, straight / np.maximum(bent, 1e-300), 1.0)) / (1.0 + straight)

    def join(self, parts: Sequence[Array]) -> Array:
        """Lay per-record arrays out as ``residual`` does."""
        return np.concatenate([p[self.span(r)] for p, r in zip(parts, self.session.records, strict=True)])


def block_ids(problem: Problem, sample_time_s: float, block_s: float = BLOCK_S) -> NDArray[np.int64]:
    """Number the blocks of all records as ``Problem.residual`` lays them out."""
    size, out, first = max(int(block_s / sample_time_s), 1), [], 0
    for r in problem.session.records:
        n = len(range(len(r))[problem.span(r)])
        count = max(n // size, 1)
        ids = np.minimum(np.arange(n) // size, count - 1)
        out.append(ids + first)
        first += count
    return np.concatenate(out)


def _longest(loud: NDArray[np.bool_]) -> int:
    """Number of samples from a quiet one to the next, at most."""
    quiet = np.flatnonzero(np.concatenate([[True], ~loud, [True]]))
    return int(np.max(np.diff(quiet)))


def closed_errors(problem: Problem, model: AxisModel) -> tuple[float, float]:
    """Root mean square error of the simulated closed loop in force and position."""
    force, place, temperature = [], [], 0.0
    for r in problem.session.records:
        run = replay(model, r, temperature)
        temperature = run.end_temperature if problem.session.continuous else 0.0
        force.append(np.nan_to_num(run.force - r.force, nan=1e9))
        place.append(np.nan_to_num(run.position - r.position, nan=1e9))
    f, x = (float(np.sqrt(np.mean(problem.join(e) ** 2))) for e in (force, place))
    return f, x


def _falls(model: AxisModel) -> bool:
    """Say whether the friction of a model is lower at speed than near rest."""
    zero = np.zeros(1)
    for name, given in model.effects.items():
        effect = known()[name]
        if effect.slot is Slot.FRICTION:
            row = effect.row(effect.values(given), model.pitch)
            slow, fast = (
                effect.evaluate(zero, zero + share * model.max_speed, zero, zero, row) for share in (0.0, 0.5)
            )
            if slow[0] > 1.05 * fast[0]:
                return True
    return False


def free_parameters(model: AxisModel, frozen: Sequence[str] = ()) -> tuple[Free, ...]:
    """List what may move: every differentiable parameter of the effects not frozen, and the uncertain base."""
    lib, out = known(), []
    for name, given in model.effects.items():
        if name in frozen:
            continue
        for p in lib[name].parameters:
            if not p.fixed:
                out.append(_free(model, name, p, given[p.symbol]))
    for symbol in model.refine:
        value = getattr(model, symbol)
        least = 0.01 * value if symbol == "inertia" else 0.0  # without inertia there is no motion to predict
        out.append(Free(BASE, symbol, max(abs(value), 1e-12), *model.within.get(symbol, (least, np.inf))))
    return tuple(out)


def _free(model: AxisModel, name: str, p: Parameter, value: float) -> Free:
    scale = model.scale(p)
    lower, upper = (-np.inf, np.inf) if p.phase else model.bounds(name, p)
    size = 1.0 if p.phase else max(abs(value), 0.1 * abs(p.start) * scale, 1e-12)
    return Free(name, p.symbol, size, lower, upper, p.phase)


def shifted(model: AxisModel, free: Sequence[Free], sizes: Array) -> AxisModel:
    """Return the model with the free numbers changed by so many of their sizes, within their bounds."""
    at = get(model, free) + sizes * np.array([f.scale for f in free])
    return put(model, free, np.clip(at, [f.lower for f in free], [f.upper for f in free]))


def jacobian(
    problem: Problem, model: AxisModel, free: Sequence[Free], at: Array, base: Array, step: float = 2e-3
) -> Array:
    """Differences in the scaled parameters.

    Where so small a step moves some innovation by more than noise, the axis may have stuck, slipped or lost contact
    otherwise: a jump, which is no slope, however large. There the step is taken the other way, too, and what both agree
    on is kept.
    """

    def difference(i: int, h: float) -> Array:
        moved = at.copy()
        moved[i] += h
        return problem.residual(put(model, free, moved)) - base

    def column(i: int) -> Array:
        f = free[i]
        h = step * f.scale if at[i] + step * f.scale <= f.upper else -step * f.scale
        slope = difference(i, h)
        peak = float(np.max(np.abs(slope)))
        if peak > max(JUMP, PEAK * float(np.sqrt(np.mean(slope**2)))) and f.lower <= at[i] - h <= f.upper:
            back = -difference(i, -h)
            slope = np.where(slope * back > 0.0, np.sign(slope) * np.minimum(np.abs(slope), np.abs(back)), 0.0)
        return slope * (f.scale / h)

    return np.stack(list(problem.mapper(column, range(len(free)))), axis=1)


def refit(
    problem: Problem,
    model: AxisModel,
    frozen: Sequence[str] = (),
    iterations: int = 8,
    tolerance: float = 1e-3,
) -> Fit:
    """Fit all free parameters by bounded Levenberg-Marquardt.

    Args:
        frozen: effects that keep their values (those that a channel of their own has measured).
        iterations: largest number of accepted steps.
        tolerance: stop when a step gains less than this share of the cost.

    Returns:
        The fit at the best point found.
    """
    free = free_parameters(model, frozen)
    fit = descended(problem, model, free, iterations, tolerance)
    smooth = tuple(f for f in free if f.effect == BASE or not known()[f.effect].mechanism.bounces)
    if 0 < len(smooth) < len(free):  # whose steps fail wherever a gap is to take part in them
        model = descended(problem, fit.model, smooth, 2 * iterations, 0.1 * tolerance).model
        r = problem.residual(model)
        fit = Fit(model, free, r, jacobian(problem, model, free, get(model, free), r))
    return fit


def descended(
    problem: Problem,
    model: AxisModel,
    free: tuple[Free, ...],
    iterations: int,
    tolerance: float,
    slopes: Callable[[Array, Array], Array] | None = None,
) -> Fit:
    """Descend from a model in some of its numbers, within their bounds.

    Args:
        free: the numbers that move.
        iterations, tolerance, slopes: as of ``descend``; None takes the differences of ``jacobian``.
    """
    way = slopes or (lambda x, r: jacobian(problem, model, free, x, r))
    return fitted(model, free, problem.residual, way, iterations, tolerance, left=LEFT)
