"""Lay records on the grid of the sample time by their time stamps: stamps jitter, samples are lost.

Stamps that lie beside the grid by less than half a step are taken for late notes of samples that were in time. A few
lost samples are interpolated, a longer gap parts the record.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from sioms.reconcile.effect import Array
from sioms.reconcile.records import Record, Session

#: Longest gap that is interpolated [samples], largest share of all samples, and least length of a record, or of what a gap leaves of one.
LONGEST, MOST, LEAST_SAMPLES = 5, 0.2, 250
#: Share of a stamp's deviation by which the clock that counts the samples follows the stamps.
FOLLOW = 0.05


def on_grid(session: Session, sample_time_s: float) -> tuple[Session, list[str]]:
    """Put every record that has usable time stamps on an even grid.

    Returns:
        The session, in which a longer gap has made two records of one (the heat state no longer carries over), and notes on
        what was lost. Records whose stamps do not fit the sample time are left as they are, for ``check`` to refuse.
    """
    notes: list[str] = []
    parts = [_pieces(r, sample_time_s, notes) for r in session.records]
    final = [_pieces(r, sample_time_s, notes) for r in session.final]
    whole = all(len(p) == 1 for p in parts)
    return Session(
        tuple(r for p in parts for r in p), session.continuous and whole, tuple(r for p in final for r in p)
    ), notes


def _pieces(record: Record, dt: float, notes: list[str]) -> list[Record]:
    arrays = [
        a
        for a in (
            record.force,
            record.command,
            record.force_measured,
            record.time_s,
            record.feedforward,
            record.external,
        )
        if a is not None
    ]
    usable = len(record) >= LEAST_SAMPLES and all(
        len(a) == len(record) and np.all(np.isfinite(a)) for a in (record.position, *arrays)
    )
    if record.time_s is None or not usable:
        return [record]
    place = places(record.time_s, dt)
    if place is None:
        return [record]
    gaps = np.diff(place) - 1
    cuts = np.flatnonzero(gaps > LONGEST) + 1
    edges = [0, *cuts.tolist(), len(record)]
    kept = [(a, b) for a, b in pairwise(edges) if place[b - 1] - place[a] + 1 >= LEAST_SAMPLES]
    lost = int(sum(gaps[a : b - 1].sum() for a, b in kept))
    if not kept or lost > MOST * len(record):
        return [record]
    if lost:
        notes.append(
            f"record {record.name}: {lost} of {len(record) + lost} samples were lost and are interpolated"
        )
    if len(cuts):
        notes.append(
            f"record {record.name}: {len(cuts)} gaps of more than {LONGEST} samples; read as {len(kept)} records"
        )
    return [
        _filled(record.cut(a, b), place[a:b] - place[a], "" if len(kept) == 1 else f".{i + 1}", dt)
        for i, (a, b) in enumerate(kept)
    ]


def places(time: Array, dt: float) -> NDArray[np.int64] | None:
    """Number the samples by their stamps on a grid of (nearly) ``dt``; None where they step otherwise or go back."""
    steps = np.diff(time)
    typical = float(np.median(steps))
    if not np.all(np.isfinite(time)) or np.any(steps < -0.5 * dt) or not 0.98 < typical / dt < 1.02:
        return None
    place, clock, out = 0, float(time[0]), np.zeros(len(time), dtype=np.int64)
    for i, stamp in enumerate(time.tolist()):
        ahead = (stamp - clock) / typical
        steps_on = round(ahead)
        place += steps_on
        clock += (steps_on + FOLLOW * (ahead - steps_on)) * typical
        out[i] = place
    return out


def _filled(record: Record, place: NDArray[np.int64], suffix: str, dt: float) -> Record:
    """Interpolate what is missing between the places: position by a cubic spline, the rest by straight lines."""
    place, first = np.unique(place, return_index=True)
    grid = np.arange(place[-1] + 1)
    if record.time_s is None or len(grid) == len(record):
        return replace(record, name=record.name + suffix, time_s=grid * dt)

    def line(a: Array | None) -> Array | None:
        return None if a is None else np.interp(grid, place, a[first])

    index = None if record.index is None else np.isin(grid, place[record.index[first]])
    return Record(
        record.name + suffix,
        CubicSpline(place, record.position[first])(grid),
        np.interp(grid, place, record.force[first]),
        line(record.command),
        line(record.force_measured),
        index,
        grid * dt,
        ~np.isin(grid, place),
        line(record.feedforward),
        line(record.external),
    )
