"""What a row of a log tells of the force between it and the next: held by the loop, or a point of what a faster loop
made.

A log with the period of the loop holds every force over its sample, exactly. One that is slower has points of a force
that has moved on meanwhile; held until the next row it comes half a sample late, which passes for elasticity, for
another inertia, for friction. And a log may pair the position of a row with the force of the row before.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.signal import lfilter

from sioms.reconcile.blocks import better
from sioms.reconcile.effect import Array
from sioms.reconcile.effects import known
from sioms.reconcile.fit import Fit, Problem, block_ids, refit
from sioms.reconcile.model import AxisModel
from sioms.reconcile.records import Record, Session
from sioms.reconcile.thresholds import SURE

#: What most axes may lack, fitted along so that it does not pass for time.
USUAL = ("payload", "viscous", "coulomb", "offset", "gravity")
#: Half periods of the loop that are tried, and times by which a log may be late with the force, in samples of the log.
LATE, BEHIND = (0.0, 0.1, 0.2, 0.3, 0.4), (-8.0, -5.6, -4.0, -2.8, -2.0, -1.4, -1.0)
#: Reading the rows as points leaves at most this share, and as late ones, which few logs have, this one.
LESS, MUCH_LESS = 0.85, 0.5
#: Accepted steps of a fit, which is at its end when so many more leave more than this share.
STEPS, SETTLED, MOST_FITS = 4, 0.98, 5
#: Beyond so many times its median a fourth difference is that of a step.
STANDS_OUT = 3.0
#: For so long an unknown force shows in the innovations.
MEMORY_S = 0.5


@dataclass(frozen=True, slots=True)
class Sampling:
    """How the rows of a log tell the force.

    Attributes:
        late: half a period of the loop, in samples of the log: the force comes so late after the points of the log;
            below 0 the log is late with it. None: the row after the present one holds the force.
        left: share of the squares that the force held over its sample leaves.
        curved: how the force goes within a sample counts, too; of rows that were polled that is not known.
    """

    late: float | None
    left: float = 1.0
    curved: bool = False

    def text(self, sample_time_s: float) -> str:
        """Say it."""
        share = f"; read so, {100 * self.left:.0f} % is left of what a force held from row to row leaves"
        if self.late is None:
            return f"the force of a row acts before its position: it is taken from the row after{share}"
        if self.late < 0.0:
            return (
                f"the log tells the force late, by some {-1e3 * self.late * sample_time_s:.2g} ms (a filter?): it is "
                f"read as a curve that much earlier{share}, and a delay or lag does not show"
            )
        period = f"a period of some {2e3 * self.late * sample_time_s:.2g} ms" if self.late else "none that can be told"
        return (
            f"the log is slower than the loop that makes the force ({period} fits best{share}): the force is read as a "
            "curve through the rows, and a delay or lag below half a sample does not show. loop_time_s in columns.toml "
            "would tell the period"
        )


def read_as(session: Session, sampling: Sampling) -> Session:
    """Return the session with the mean force of every sample [{F}] in the place of the logged one, and how it goes
    within the sample, in all its records.

    What the loop makes, and the drive's current with it, comes ``sampling.late``; a force from outside is nobody's loop
    and is read as it was measured.
    """

    def mean(signal: Array | None, late: float | None) -> Array | None:
        return None if signal is None else _mean(signal, late)

    def read(r: Record) -> Record:
        late = sampling.late
        outer = None if late is None else 0.0
        return replace(
            r,
            force=_mean(r.force, late),
            force_measured=mean(r.force_measured, late),
            feedforward=mean(r.feedforward, late),
            external=mean(r.external, outer),
            bends=None
            if late is None or not sampling.curved
            else _bends(r.force, late) + (0.0 if r.external is None else _bends(r.external, 0.0)),
        )

    halves = tuple(read_as(half, sampling) for half in session.halves)
    records, final = tuple(map(read, session.records)), tuple(map(read, session.final))
    return replace(session, records=records, final=final, halves=halves)


def _mean(signal: Array, late: float | None) -> Array:
    """Mean of a signal over every sample, shape (n,): of a cubic spline through the rows, ``late`` samples earlier, or
    the next row.
    """
    if late is None:
        return np.append(signal[1:], signal[-1])
    return np.asarray(np.diff(_curve(signal).antiderivative()(np.arange(len(signal) + 1) - late)))


def _bends(signal: Array, late: float) -> Array:
    """First two Legendre coefficients of that spline in every sample, shape (n, 2)."""
    at, weight = np.polynomial.legendre.leggauss(4)
    inside = _curve(signal)(np.arange(len(signal))[:, None] + 0.5 * (at + 1.0) - late)
    return np.asarray(inside @ np.stack([1.5 * weight * at, 1.25 * weight * (3.0 * at**2 - 1.0)], axis=1))


def _curve(signal: Array) -> CubicSpline:
    return CubicSpline(np.arange(-1, len(signal) + 1), np.concatenate([signal[:1], signal, signal[-1:]]))


def trusted(problem: Problem, model: AxisModel) -> Problem:
    """Let samples count less where the force between the rows is not known: where its fourth difference stands out.

    A step of the force between two rows leaves an error of 0.29 of it in the mean (it may be anywhere between them) and
    a fourth difference of three of it.

    Args:
        problem: whose noise says how large the innovation is that is expected.
        model: through which a force shows in the innovation.
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
        problem: whose force is the logged one.
        model: what is known; what most axes may lack is fitted along.
        frozen: effects that keep their values.
    """
    held = _settled(problem, _usual(model), frozen)

    def fitted(late: float | None) -> Fit:
        other = replace(problem, session=read_as(problem.session, Sampling(late)))
        return refit(other, held.model, frozen, STEPS)

    ids = block_ids(problem, model.sample_time_s)
    best, late, found = held, None, False
    readings: tuple[tuple[tuple[float | None, ...], float], ...] = (
        (LATE, LESS),
        ((None, *BEHIND), MUCH_LESS),
    )
    for lates, most in readings:  # beginning with what is the more likely
        fits = [fitted(late) for late in lates]
        i = int(np.argmin([f.cost for f in fits]))
        loss, other = (np.bincount(ids, weights=f.residual**2).astype(np.float64) for f in (fits[i], best))
        gain, sure = better(loss, other)
        if gain > 1.0 - most and sure > SURE:
            best, late, found = fits[i], _between(lates, [f.cost for f in fits], i), True
    return Sampling(late, best.cost / held.cost) if found else None


def _settled(problem: Problem, model: AxisModel, frozen: Sequence[str]) -> Fit:
    """Fit until nothing more is gained: what is compared with it begins where it ends."""
    fit = refit(problem, model, frozen, STEPS)
    for _ in range(MOST_FITS):
        further = refit(problem, fit.model, frozen, STEPS)
        if further.cost > SETTLED * fit.cost:
            break
        fit = further
    return fit


def _between(lates: Sequence[float | None], costs: Sequence[float], i: int) -> float | None:
    """Place of the least of a parabola through the lowest cost, the i-th, and its neighbours, if it has two."""
    if not 0 < i < len(lates) - 1 or None in (near := lates[i - 1 : i + 2]):
        return lates[i]
    at = np.array(near, dtype=np.float64)
    a, b, _ = np.polyfit(at, costs[i - 1 : i + 2], 2)
    return float(np.clip(-0.5 * b / a, at[0], at[2]))


def _usual(model: AxisModel) -> AxisModel:
    for name in USUAL:
        effect = known()[name]
        if name in model.effects or not model.applicable(effect) or any(n in model.effects for n in effect.replaces):
            continue
        start = {p.symbol: p.start * (1.0 if p.fixed else model.scale(p)) for p in effect.parameters}
        model = model.with_effect(name, start)
    return model
