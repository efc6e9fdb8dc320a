"""Lay records on the grid of the sample time by their time stamps: stamps jitter, samples are lost.

Stamps that lie beside the grid by less than half a step are taken for late notes of samples that were in time, and so
are worse ones where as many samples share a place as places are empty. A few lost samples, or rows with a value that is
no number, are interpolated, a longer gap parts the record.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from sioms.reconcile.effect import Array
from sioms.reconcile.records import Record, Session

#: Longest gap that is interpolated [samples], largest share of all samples, and least length of a record, or of what a
#: gap leaves of one.
LONGEST, MOST, LEAST_SAMPLES = 5, 0.2, 250
#: As many samples more or fewer than their stamps say are the jitter of the first and the last of them.
WANDER = 2
#: Share of a stamp's deviation by which the clock that counts the samples follows the stamps.
FOLLOW = 0.05


def on_grid(session: Session, sample_time_s: float) -> tuple[Session, list[str]]:
    """Put every record that has usable time stamps on an even grid.

    Returns:
        The session, in which a longer gap has made two records of one (the heat state no longer carries over), and
        notes on what was lost. Records whose stamps do not fit the sample time are left as they are, for ``check`` to
        refuse.
    """
    notes: list[str] = []
    parts = [_pieces(r, sample_time_s, notes) for r in session.records]
    final = [_pieces(r, sample_time_s, notes) for r in session.final]
    whole = all(len(p) == 1 for p in parts)
    return replace(
        session,
        records=tuple(r for p in parts for r in p),
        continuous=session.continuous and whole,
        final=tuple(r for p in final for r in p),
    ), notes


def _pieces(record: Record, dt: float, notes: list[str]) -> list[Record]:
    where = f"record {record.name}"
    whole = _whole(record, dt)
    if whole is None or whole.time_s is None or (place := places(whole.time_s, dt)) is None:
        return [record]
    place, said = _told_apart(whole, place)
    gaps = np.diff(place) - 1
    cuts = np.flatnonzero(gaps > LONGEST) + 1
    edges = [0, *cuts.tolist(), len(whole)]
    kept = [(a, b) for a, b in pairwise(edges) if place[b - 1] - place[a] + 1 >= LEAST_SAMPLES]
    lost = int(sum(np.maximum(gaps[a : b - 1], 0).sum() for a, b in kept))
    if not kept or lost > MOST * len(whole):
        return [record]
    if said:
        notes.append(f"{where}: {said}")
    if lost:
        notes.append(f"{where}: {lost} of {len(whole) + lost} samples were lost and are interpolated")
    if len(cuts):
        longer = "one gap" if len(cuts) == 1 else f"{len(cuts)} gaps"
        notes.append(f"{where}: {longer} of more than {LONGEST} samples; read as {len(kept)} records")
    return [
        _filled(whole.cut(a, b), place[a:b] - place[a], "" if len(kept) == 1 else f".{i + 1}", dt)
        for i, (a, b) in enumerate(kept)
    ]


def _whole(record: Record, dt: float) -> Record | None:
    """Return the rows whose values are all numbers; None where they tell of no time, or are too few."""
    arrays = record.arrays()
    if len(record) < LEAST_SAMPLES or any(len(a) != len(record) for a in arrays.values()):
        return None
    good = np.all([np.isfinite(a) for a in arrays.values()], axis=0)
    if good.mean() < 1.0 - MOST or (good.all() and record.time_s is None):
        return None
    if record.time_s is None:
        record = replace(record, time_s=dt * np.arange(len(record), dtype=np.float64))
    return record if good.all() else record.only(good)


def _told_apart(record: Record, place: NDArray[np.int64]) -> tuple[NDArray[np.int64], str]:
    """Say what samples are whose stamps put them in one place: rows written twice, or late stamps.

    Returns:
        The places, and a sentence, empty where no two samples share one.
    """
    shared = np.flatnonzero(np.diff(place) == 0)
    if not len(shared):
        return place, ""
    twice = np.all([a[shared] == a[shared + 1] for a in record.arrays().values()], axis=0)
    if not twice.any() and abs(int(place[-1]) - len(place) + 1) <= WANDER:
        even = np.arange(len(place))
        return even, "the time stamps jitter by more than half a step; no sample is taken to be lost"
    return place, f"{len(shared)} rows are of the same time as the row before, which counts"


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
    if len(record) == len(place) == len(grid):
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
