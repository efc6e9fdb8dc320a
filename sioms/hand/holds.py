"""Find the holds in what a hand's devices told all along: rows of grasps, as a survey records them.

A hold is a time in which both fingers are touched, no joint moves and no load changes. Each tells one row, the mean of
its last second: a damper's swings are averaged, and two rows of one hold would count what is one reading twice. A
grasp is what lies between two losses of contact. How the object was moved between holds does not matter
(docs/reconcile-hand.md, What is compared).

Pure: arrays in, rows out.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

BLOCK_S = 0.25
"""What is told is averaged over blocks of this length in the hand's time [s], which are judged by their means."""
MEANT = 4  # blocks that a row is the mean of
BEFORE, AFTER = 2, 1  # steady blocks that go before these, while what moved settles, and after them
STILL = (5e-5, 5e-5, 5e-3)
"""By how much x, y [m] and th [rad] of a module may go on from block to block: drives that move bear by their
damping what their stiffness does not."""
EVEN, EVEN_N = 0.08, 0.03
"""By which share, or by how many newtons, a load may change from block to block: in a hold it swings by some per
cent."""
JOINTS, COMMANDS, PLACES, LOADS, WRISTS = slice(0, 6), slice(10, 16), slice(6, 8), slice(8, 10), slice(16, 20)
TOLD = 20  # joints, places, loads, commands and wrists, as `sioms.hand.survey.Told` has them


@dataclass(frozen=True, slots=True, eq=False)
class Stream:
    """What one device told; immutable.

    Args:
        time_s: of each reading, in the hand's time, rising [s], shape (n,).
        values: where each tells what, shape (n, k); nan where it does not.
        columns: places of these in a row of what is told.
        touched: of a finger, whether anything touches it at each reading; None for other devices.
    """

    time_s: Floats
    values: Floats
    columns: tuple[int, ...]
    touched: NDArray[np.bool_] | None = None


def holds(streams: Sequence[Stream]) -> list[list[float]]:
    """Return the time [s], the number of the grasp from 0 and what was told of each hold.

    Args:
        streams: of both modules and both fingers, and of wrists where there are any.
    """
    first, last = (f(s.time_s[i] for s in streams if len(s.time_s)) for f, i in ((max, 0), (min, -1)))
    if not all(len(s.time_s) for s in streams) or last <= first:
        return []
    count = int((last - first) / BLOCK_S)
    told = np.full((count, TOLD), math.nan)
    touched: NDArray[np.bool_] = np.ones(count, dtype=np.bool_)
    for stream in streams:
        block = np.floor((stream.time_s - first) / BLOCK_S).astype(np.int64)
        inside = (block >= 0) & (block < count)
        told[:, list(stream.columns)] = _means(block[inside], stream.values[inside], count)
        if stream.touched is not None:
            lost = np.bincount(block[inside], ~stream.touched[inside], count) > 0
            touched[lost] = False
    grasp = np.cumsum(np.diff(touched, prepend=False) & touched) - 1
    return [
        [first + BLOCK_S * end, float(grasp[end - 1]), *np.mean(told[end - MEANT : end], axis=0).tolist()]
        for end in _ends(touched & _steady(told))
    ]


def _means(block: NDArray[np.int64], values: Floats, count: int) -> Floats:
    """Return means over blocks, nan where fewer than half of the readings of a block tell, shape (count, k)."""
    read = np.maximum(np.bincount(block, minlength=count), 1)
    out = np.empty((count, values.shape[1]))
    for k in range(values.shape[1]):
        tells = np.isfinite(values[:, k])
        known = np.bincount(block[tells], minlength=count)
        with np.errstate(invalid="ignore", divide="ignore"):
            out[:, k] = np.bincount(block[tells], values[tells, k], count) / known
        out[2 * known < read, k] = math.nan
    return out


def _steady(told: Floats) -> NDArray[np.bool_]:
    """Say of which blocks joints and loads are as in the block before, shape (blocks,)."""
    moved = np.abs(np.diff(told[:, JOINTS], axis=0, prepend=math.nan))
    load = told[:, LOADS]
    changed = np.abs(np.diff(load, axis=0, prepend=math.nan))
    even = (changed < np.maximum(EVEN * np.abs(load), EVEN_N)).all(axis=1)
    placed = np.isfinite(told[:, PLACES]).all(axis=1)
    return np.asarray((moved < np.tile(STILL, 2)).all(axis=1) & even & placed, dtype=np.bool_)


def _ends(good: NDArray[np.bool_]) -> Iterator[int]:
    """Yield where the rows of long enough runs of good blocks end."""
    edges = np.flatnonzero(np.diff(good.astype(np.int64), prepend=0, append=0))
    for start, end in edges.reshape(-1, 2):
        if end - start >= BEFORE + MEANT + AFTER:
            yield int(end) - AFTER
