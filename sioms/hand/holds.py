"""Find the holds in what a hand's devices told all along: rows of grasps, as a survey records them.

A hold is a time in which both fingers are touched and, on the average of a second, no joint moves and no load changes:
while the hand stands, loads swing against each other once a second by up to a fifth, for the object sticks to the
platen. Each hold tells one row, the mean of a second near its end: two rows of one hold would count what is one reading
twice. A grasp is what lies between two losses of contact. How the object was moved between holds does not matter
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
"""What is told is averaged over blocks of this length in the hand's time [s]."""
MEANT = 4  # blocks that a mean is of, by which a hold is judged, and its row
STEADY = 4  # means, each a block later than the one before, that must agree: a hold of 1.75 s
STILL = (1e-4, 1e-4, 8e-3)
"""By how much the means of x, y [m] and th [rad] of a module may go on in a block: drives that move bear by their
damping what their stiffness does not."""
EVEN, EVEN_N = 0.06, 0.03
"""By which share, or by how many newtons, the mean of a load may change in a block."""
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
    if not all(len(stream.time_s) for stream in streams):
        return []
    first = max(float(stream.time_s[0]) for stream in streams)
    count = max(0, int((min(float(stream.time_s[-1]) for stream in streams) - first) / BLOCK_S))
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
    mean = _moving(told)
    good = _moving(touched[:, None].astype(np.float64))[:, 0] == 1.0
    return [
        [first + BLOCK_S * (end + 1), float(grasp[end]), *mean[end].tolist()] for end in _ends(good & _steady(mean))
    ]


def _moving(told: Floats) -> Floats:
    """Return the mean of each block and those before it, nan where there are too few, shape (blocks, k)."""
    if len(told) < MEANT:
        return np.full(told.shape, math.nan)
    windows = np.lib.stride_tricks.sliding_window_view(told, MEANT, axis=0).mean(axis=-1)
    return np.concatenate([np.full((MEANT - 1, told.shape[1]), math.nan), windows])


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


def _steady(mean: Floats) -> NDArray[np.bool_]:
    """Say which means are as those of a block before, shape (blocks,)."""
    changed = np.abs(np.diff(mean, axis=0, prepend=math.nan))
    load = np.abs(mean[:, LOADS])
    even = (changed[:, LOADS] < np.maximum(EVEN * load, EVEN_N)).all(axis=1)
    placed = np.isfinite(mean[:, PLACES]).all(axis=1)
    return np.asarray((changed[:, JOINTS] < np.tile(STILL, 2)).all(axis=1) & even & placed, dtype=np.bool_)


def _ends(good: NDArray[np.bool_]) -> Iterator[int]:
    """Yield the last but one of each long enough run of good means: the last one may have begun to move."""
    edges = np.flatnonzero(np.diff(good.astype(np.int64), prepend=0, append=0))
    for start, end in edges.reshape(-1, 2):
        if end - start >= STEADY - 1:
            yield int(end) - 2
