"""Polled logs: rows at no fixed rate, each true at its own stamp.

What lies between the rows is interpolated where the rows themselves show that they resolve it: each row is foretold by
its neighbours, over twice the distance that is interpolated later. What has been found must then stand on every other
row alone: two logs of half the rate, of which the interpolation errs by several times as much.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import fields, replace
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline, PchipInterpolator

from sioms.reconcile.effect import Array
from sioms.reconcile.errors import BadInputError
from sioms.reconcile.records import Record, Session
from sioms.reconcile.thresholds import FORETELLS, JITTERS, NEITHER, RESOLVES, STAMPED
from sioms.reconcile.timing import LEAST_SAMPLES, LONGEST, places

#: Fewest rows of a log, and of a part of one; a step of more than so many usual ones is a gap.
FEWEST, GAP = 100, float(LONGEST)
#: Rows that repeat the one before are of a device that is read faster than it has news, where so many do.
STALE = 0.05
#: How many rows to either side tell whether it moves.
ROUND = 3
#: A step of the encoder is no smaller than this share of the travel: below, numbers were rounded as they were printed.
ROUNDED = 1e-7
#: What is interpolated: position as a smooth curve, forces without overshoot.
FORCES = ("force", "feedforward", "external")
#: The sample time of the model may be so many usual steps of the log.
STEPS = 0.8, 1.5


def evened(session: Session, sample_time_s: float) -> tuple[Session, list[str]]:
    """Interpolate polled records to the sample time.

    Returns:
        The session, with ``halves`` where there was something to interpolate, and notes. Marks and a measured force,
        which is read at an instant of its own, are left out there.

    Raises:
        BadInputError: the rows do not resolve the motion or the force.
    """
    every = (*session.records, *session.final)
    rough = [_rough(r, sample_time_s) for r in every]
    if not any(r is not None and r.is_polled for r in rough):
        for record, found in zip(every, rough, strict=True):
            if found is not None and found.is_neither:
                raise BadInputError(
                    f"read record {record.name}: its steps vary, and its rows are true neither at their times nor at "
                    "even steps, as of a device that is read between its own updates; log what the device samples, or "
                    "read it at least twice per update"
                )
        return session, []
    notes: list[str] = []
    parts = [_parts(r, sample_time_s, notes) for r in session.records]
    final = [_parts(r, sample_time_s, notes) for r in session.final]
    whole, *halves = (
        replace(
            session,
            records=tuple(p[i] for part in parts for p in part),
            continuous=session.continuous and all(len(part) == 1 for part in parts),
            final=tuple(p[i] for part in final for p in part),
        )
        for i in range(3)
    )
    return replace(whole, halves=tuple(halves)), notes


class _Rough(NamedTuple):
    """How rough the position of a record of varying steps is.

    Attributes:
        stamped, even: at its stamps, and on the grid of the samples [{x}].
        blurred: what its speed makes of the spread of its steps [{x}].
    """

    stamped: float
    even: float
    blurred: float

    @property
    def is_polled(self) -> bool:
        """Whether the position is the smoother at its stamps."""
        return self.stamped < STAMPED * self.even

    @property
    def is_neither(self) -> bool:
        """Whether neither the stamps nor the grid are when rows were read, and not noise but that makes it rough."""
        return STAMPED * self.even <= self.stamped < self.even / STAMPED and self.stamped < NEITHER * self.blurred


def _rough(r: Record, dt: float) -> _Rough | None:
    """Return how rough the position is; None where the steps do not vary, or columns are not as long as each other."""
    if r.time_s is None or any(len(a) != len(r) for a in r.arrays().values()) or len(r) < FEWEST:
        return None
    rows = _fresh(r)
    t, x = _times(rows), rows.position
    if len(rows) < FEWEST or not np.all(np.isfinite(t)) or np.any(np.diff(t) <= 0.0) or not np.all(np.isfinite(x)):
        return None
    steps = np.diff(t)
    typical = float(np.median(steps))
    if not STEPS[0] < dt / typical < STEPS[1] or float(np.std(steps)) < JITTERS * typical:
        return None
    place = places(t, dt)
    grid = np.arange(len(t)) if place is None or np.any(np.diff(place) <= 0) else place
    speed = _size(np.diff(x)) / typical
    spread = float(np.std(steps[steps < 2.0 * typical]))  # without gaps, and rows that were lost
    return _Rough(_size(foretold(t, x)), _size(foretold(grid.astype(np.float64), x)), speed * spread)


def _times(r: Record) -> Array:
    return np.zeros(0) if r.time_s is None else r.time_s


def _fresh(r: Record) -> Record:
    """Return the rows of their own instant; those that repeat the one before, while it moves, are old news.

    That a device has no news is seen where it passes more than two steps of the encoder a row: slower motion repeats
    rows anyway. Of a device that is seen so, they are old news in slower motion as well.
    """
    rows = r.only(np.concatenate([[True], np.diff(_times(r)) != 0.0]))
    values = [a for a in (rows.position, rows.force, rows.force_measured) if a is not None]
    again = np.concatenate([[False], np.all([np.diff(a) == 0.0 for a in values], axis=0)])
    x = np.pad(rows.position, ROUND, mode="edge")
    passed = np.abs(x[2 * ROUND :] - x[: -2 * ROUND])
    moved = np.abs(np.diff(rows.position))
    steps = moved[moved > ROUNDED * np.ptp(rows.position)]
    stale = np.mean(again & (passed > 4.0 * ROUND * np.min(steps, initial=np.inf)))
    return rows.only(~(again & (passed > 0.0))) if stale > STALE else rows


def foretold(t: Array, x: Array) -> Array:
    """Return by how much each row differs from the cubic through two rows to either side, shape (n - 4,)."""
    return _against(t, x, (-2, -1, 1, 2))


def _against(t: Array, x: Array, near: Sequence[int]) -> Array:
    reach = max(near)
    n = len(t)
    at = t[reach : n - reach]
    others = [t[reach + k : n - reach + k] for k in near]
    out = x[reach : n - reach].copy()
    for i, k in enumerate(near):
        weight = np.ones_like(at)
        for j, other in enumerate(others):
            if j != i:
                weight *= (at - other) / (others[i] - other)
        out -= weight * x[reach + k : n - reach + k]
    return out


def _size(a: Array) -> float:
    return float(np.sqrt(np.mean(a**2)))


def _parts(r: Record, dt: float, notes: list[str]) -> list[tuple[Record, Record, Record]]:
    """Return each part of a record without a gap on the grid: of all rows, and of every other one twice."""
    rows = _fresh(r)
    t = _times(rows)
    typical = float(np.median(np.diff(t)))
    cuts = np.flatnonzero(np.diff(t) > GAP * typical) + 1
    spans = [(a, b) for a, b in pairwise([0, *cuts.tolist(), len(rows)]) if t[b - 1] - t[a] >= LEAST_SAMPLES * dt]
    if not spans:
        raise BadInputError(
            f"read record {r.name}: it was polled at no fixed rate, with {len(cuts)} gaps of more than "
            f"{GAP * typical:.3g} s, and no part between them is as long as {LEAST_SAMPLES * dt:.3g} s; record longer, "
            "or without gaps"
        )
    _check(rows, spans, typical)
    said = f"record {r.name}: polled, in steps of {np.diff(t).min():.3g} to {np.diff(t).max():.3g} s; interpolated"
    if len(rows) < len(r):
        said += f"; {len(r) - len(rows)} rows repeat the one before and are left out"
    if len(spans) > 1:
        said += f"; read as {len(spans)} records, by its gaps"
    notes.append(said + "; what is named stands on every other row as well")
    return [_split(rows.cut(a, b), dt, "" if len(spans) == 1 else f".{i + 1}") for i, (a, b) in enumerate(spans)]


def _check(rows: Record, spans: Sequence[tuple[int, int]], typical: float) -> None:
    """Check that the rows resolve what lies between them.

    Raises:
        BadInputError: they do not; with what would be needed.
    """
    t = _times(rows)
    where = f"read record {rows.name}: it was polled at no fixed rate, some {1.0 / typical:.3g} times a second, and "
    place = np.concatenate([foretold(t[a:b], rows.position[a:b]) for a, b in spans])
    share = _size(place) / max(float(np.std(rows.position)), 1e-300)
    if share > RESOLVES:
        raise BadInputError(
            f"{where}it moves faster than that: neighbours foretell the position of a row only to {100 * share:.0f} % "
            f"of its spread; needs {100 * RESOLVES:.0f} % or less: poll {_oftener(share / RESOLVES):.2g} times as "
            "often, or move more slowly"
        )
    force = np.concatenate([foretold(t[a:b], rows.force[a:b]) for a, b in spans])
    share = _size(force) / max(float(np.std(rows.force)), 1e-300)
    if np.ptp(rows.force) > 0.0 and share > FORETELLS:
        raise BadInputError(
            f"{where}the force changes faster than that: its neighbours foretell a row only to {100 * share:.0f} % of "
            f"its variation; needs {100 * FORETELLS:.0f} % or less: poll {_oftener(share / FORETELLS):.2g} times as "
            "often, move more slowly, or log what the drive samples at a fixed rate"
        )


def _oftener(excess: float) -> float:
    """Return how many times as often rows have to be read for an error to be so much smaller: it goes with the square
    of their distance where there are jumps of the acceleration.
    """
    return float(np.ceil(2.0 * np.sqrt(excess)) / 2.0)


def _split(rows: Record, dt: float, suffix: str) -> tuple[Record, Record, Record]:
    t = _times(rows)
    grid = np.arange(t[2], t[-3], dt)
    each = (slice(None), slice(0, None, 2), slice(1, None, 2))
    first, second, third = (_on(rows.only(which), grid, dt, suffix) for which in each)
    return first, second, third


def _on(rows: Record, grid: Array, dt: float, suffix: str) -> Record:
    t = _times(rows)

    def laid(name: str, way: Callable[[Array, Array], Any]) -> Array | None:
        a = getattr(rows, name)
        return None if a is None else np.asarray(way(t, a)(grid), dtype=np.float64)

    smooth = {name: laid(name, CubicSpline) for name in ("position", "command")}
    forces = {name: laid(name, PchipInterpolator) for name in FORCES}
    given: dict[str, Any] = dict.fromkeys((f.name for f in fields(Record)), None) | smooth | forces
    return Record(**{**given, "name": rows.name + suffix, "time_s": dt * np.arange(len(grid), dtype=np.float64)})
