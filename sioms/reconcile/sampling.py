"""What a row of a log tells of the force between it and the next: held by the loop, or a point of what a faster loop made.

A log with the period of the loop holds every force over its sample, exactly. One that is slower has points of a force that has moved on
meanwhile; held until the next row it comes half a sample late, which passes for elasticity, for another inertia, for friction. And a log may
pair the position of a row with the force of the row before.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.signal import lfilter

from sioms.reconcile.blocks import better, block_ids
from sioms.reconcile.effect import Array
from sioms.reconcile.effects import known
from sioms.reconcile.fit import Fit, Problem, refit
from sioms.reconcile.model import AxisModel
from sioms.reconcile.records import Record, Session
from sioms.reconcile.rules import SURE

#: What most axes may lack, fitted along so that it does not pass for time.
USUAL = ("payload", "viscous", "coulomb", "offset", "gravity")
#: Half periods of the loop that are tried, in samples of the log.
LATE = (0.0, 0.1, 0.2, 0.3, 0.4)
#: Reading the rows as points leaves at most this share, and as those of the position before, which few logs do, this one.
LESS, MUCH_LESS = 0.85, 0.5
STEPS = 4
#: Beyond so many times its median a fourth difference is that of a step.
STANDS_OUT = 3.0
#: For so long an unknown force shows in the innovations.
MEMORY_S = 0.5


@dataclass(frozen=True, slots=True)
class Sampling:
    """How the rows of a log tell the force.

    Attributes:
        late: half a period of the loop, in samples of the log: the force comes so late after the points of the log. None: the
            row after the present one holds the force.
        left: share of the squares that the force held over its sample leaves.
    """

    late: float | None
    left: float = 1.0

    def text(self, sample_time_s: float) -> str:
        """Say it."""
        share = f"; read so, {100 * self.left:.0f} % is left of what a force held from row to row leaves"
        if self.late is None:
            return f"the force of a row acts before its position: it is taken from the row after{share}"
        return (
            f"the log is slower than the loop that makes the force (a period of some {2e3 * self.late * sample_time_s:.2g} ms fits best"
            f"{share}): the force is read as a curve through the rows, and a delay or lag below half a sample does not show. "
            "loop_time_s in columns.toml would tell the period"
        )


def read_as(session: Session, sampling: Sampling) -> Session:
    """Return the session with the mean force of every sample in the place of the logged one."""

    def mean(r: Record, signal: Array | None, late: float | None) -> Array | None:
        return None if signal is None else _mean(signal, late)

    def read(r: Record) -> Record:
        late = sampling.late
        outer = None if late is None else 0.0
        return replace(
            r,
            force=_mean(r.force, late),
            force_measured=mean(r, r.force_measured, late),
            feedforward=mean(r, r.feedforward, late),
            external=mean(r, r.external, outer),
        )

    return replace(session, records=tuple(map(read, session.records)), final=tuple(map(read, session.final)))


def _mean(signal: Array, late: float | None) -> Array:
    """Mean of a signal over every sample, shape (n,): of a cubic spline through the rows, ``late`` samples earlier, or the next row."""
    if late is None:
        return np.append(signal[1:], signal[-1])
    n = len(signal)
    curve = CubicSpline(np.arange(-1, n + 1), np.concatenate([signal[:1], signal, signal[-1:]]))
    return np.asarray(np.diff(curve.antiderivative()(np.arange(n + 1) - late)))


def trusted(problem: Problem, model: AxisModel) -> Problem:
    """Let samples count less where the force between the rows is not known: where its fourth difference stands out.

    A step of the force between two rows leaves an error of 0.29 of it in the mean (it may be anywhere between them) and a fourth difference
    of three of it.
    """
    impulse = problem.answer(model, np.eye(max(round(MEMORY_S / model.sample_time_s), 10), 1)[:, 0])
    expected = problem.noise.innovation

    def known(r: Record) -> Record:
        rough = np.abs(np.pad(np.diff(r.force, 4), 2, mode="edge"))
        rough = np.maximum(rough - STANDS_OUT * float(np.median(rough)), 0.0)
        doubt = 0.1 * np.maximum(rough, np.append(rough[1:], rough[-1]))
        variance: Array = lfilter(impulse**2, [1.0], doubt**2)
        return replace(r, trust=expected / np.sqrt(expected**2 + variance))

    records = tuple(known(r) for r in problem.session.records)
    return replace(problem, session=replace(problem.session, records=records))


def sampling_of(problem: Problem, model: AxisModel, frozen: Sequence[str] = ()) -> Sampling | None:
    """Return how else than held from row to row the force is to be read, if that leaves much less; None: it is held.

    Args:
        model: what is known; what most axes may lack is fitted along.
    """
    start = _usual(model)
    held = refit(problem, start, frozen, STEPS)

    def fitted(sampling: Sampling) -> Fit:
        other = replace(problem, session=read_as(problem.session, sampling))
        return refit(other, held.model, frozen, STEPS)

    tried = [Sampling(late) for late in (*LATE, None)]
    fits = list(problem.mapper(fitted, tried))
    costs = [f.cost for f in fits]
    best = int(np.argmin(costs))
    ids = block_ids(problem, model.sample_time_s)
    loss, loss_held = (np.bincount(ids, weights=f.residual**2).astype(np.float64) for f in (fits[best], held))
    gain, sure = better(loss, loss_held)
    late = tried[best].late
    if gain < 1.0 - (MUCH_LESS if late is None else LESS) or sure < SURE:
        return None
    if late is not None:
        late = _lowest(LATE, costs[:-1])
    return Sampling(late, costs[best] / held.cost)


def _lowest(at: tuple[float, ...], costs: list[float]) -> float:
    """Place of the least of a parabola through the lowest cost and its neighbours."""
    i = int(np.clip(np.argmin(costs), 1, len(at) - 2))
    a, b, _ = np.polyfit(at[i - 1 : i + 2], costs[i - 1 : i + 2], 2)
    return float(np.clip(-0.5 * b / a, 0.0, 0.5)) if a > 0.0 else at[int(np.argmin(costs))]


def _usual(model: AxisModel) -> AxisModel:
    for name in USUAL:
        effect = known()[name]
        if (
            name in model.effects
            or not model.applicable(effect)
            or any(n in model.effects for n in effect.replaces)
        ):
            continue
        start = {p.symbol: p.start * (1.0 if p.fixed else model.scale(p)) for p in effect.parameters}
        model = model.with_effect(name, start)
    return model
