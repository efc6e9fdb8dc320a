"""Channels first: what the sensor says by itself, before any mechanics is fitted; the drive is in ``current``.

The count lattice and the index marks judge it. What is found here is measured directly, so the later fits keep it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sioms.reconcile.effect import Array
from sioms.reconcile.errors import BadInputError
from sioms.reconcile.model import AxisModel
from sioms.reconcile.records import Record, Session

LATTICE_SHARE = 0.998
#: A scale or a drive effect must be this many standard errors away from nothing.
SIGNIFICANT = 5.0


@dataclass(frozen=True, slots=True)
class Finding:
    """An effect that a channel shows by itself.

    Attributes:
        values: parameters; errors: their standard errors.
        evidence: one sentence with figures.
        doubted: what its law leaves is no noise: another law may do as well, or better.
    """

    effect: str
    values: Mapping[str, float]
    errors: Mapping[str, float]
    evidence: str
    doubted: bool = False


def with_resolution(model: AxisModel, session: Session) -> AxisModel:
    """Fill in a resolution of zero by the smallest step of the recorded position.

    Raises:
        BadInputError: there is no step.
    """
    if model.resolution > 0.0:
        return model
    steps = np.abs(np.concatenate([np.diff(r.position) for r in session.records]))
    top = float(np.nanmax([np.nanmax(np.abs(r.position)) for r in session.records]))
    moved = steps[steps > 1e-9 * max(top, 1e-12)]
    if not len(moved):
        raise BadInputError("read records: position is constant; needs motion")
    return replace(model, resolution=float(np.min(moved)))


def lattice(session: Session, model: AxisModel) -> Finding | None:
    """Find the largest number of which (nearly) all count differences are multiples."""
    steps = np.concatenate([_count_steps(r, model.resolution) for r in session.records])
    moved = np.abs(steps[steps != 0])
    if len(moved) < 20:
        return None
    sizes, times = np.unique(moved, return_counts=True)
    best = 1
    for factor in range(2, int(min(sizes.max(), 4096)) + 1):
        if times[sizes % factor == 0].sum() >= LATTICE_SHARE * times.sum():
            best = factor
    if best == 1:
        return None
    share = times[sizes % best == 0].sum() / times.sum()
    return Finding(
        "encoder_quantisation",
        {"factor": float(best)},
        {"factor": 0.0},
        f"{100 * share:.1f} % of {len(moved)} position changes are multiples of {best} counts",
    )


def _count_steps(record: Record, resolution: float) -> NDArray[np.int64]:
    """Differences in counts of neighbours that were both measured."""
    counts = np.rint(record.position / resolution).astype(np.int64)
    steps: NDArray[np.int64] = counts[1:] - counts[:-1]
    return steps if record.filled is None else steps[~(record.filled[1:] | record.filled[:-1])]


def index_scale(session: Session, model: AxisModel) -> Finding | None:
    """Fit measured against true position of the index marks; None where they agree or are too few."""
    fit = index_fit(session, model)
    if fit is None:
        return None
    gain, error, marks = fit
    if abs(gain - 1.0) < SIGNIFICANT * error or abs(gain - 1.0) < 3e-4:
        return None
    return Finding(
        "encoder_scale",
        {"gain": gain},
        {"gain": error},
        f"{marks} index marks lie {gain:.5f} +- {error:.5f} of their pitch apart",
    )


def index_fit(session: Session, model: AxisModel) -> tuple[float, float, int] | None:
    """Estimate measured over true displacement from index marks.

    Returns:
        (gain, standard error, number of marks), or None with fewer than two distinct marks.
    """
    where, width, record = [], [], []
    for i, r in enumerate(session.records):
        if r.index is None:
            continue
        at = np.flatnonzero(r.index[:-1])
        where.append(0.5 * (r.position[at] + r.position[at + 1]))
        width.append(np.abs(r.position[at + 1] - r.position[at]) + 2.0 * model.resolution)
        record.append(np.full(len(at), i))
    if not where or sum(map(len, where)) < 4:
        return None
    y, s = np.concatenate(where), np.concatenate(width) / np.sqrt(12.0)
    best: tuple[float, float, float] | None = None
    for trial in np.concatenate([[1.0], np.linspace(0.8, 1.25, 451)]):
        n = np.rint(y / (model.pitch * trial))
        if len(np.unique(n)) < 2:
            continue
        g, e, chi = _line(n * model.pitch, y, s)
        if best is None or chi < best[2] * (1.0 - 1e-6):
            best = (g, e, chi)
    if best is None:
        return None
    gain, error, chi = best
    return gain, error * max(1.0, np.sqrt(chi)), len(y)


def _line(x: Array, y: Array, s: Array) -> tuple[float, float, float]:
    """Weighted straight line: slope, its standard error, reduced chi square."""
    w = 1.0 / s**2
    xm, ym = np.average(x, weights=w), np.average(y, weights=w)
    sxx = float(np.sum(w * (x - xm) ** 2))
    slope = float(np.sum(w * (x - xm) * (y - ym))) / sxx
    rest = y - ym - slope * (x - xm)
    return slope, 1.0 / np.sqrt(sxx), float(np.sum(w * rest**2) / max(len(x) - 2, 1))
