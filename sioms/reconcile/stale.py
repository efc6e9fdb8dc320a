"""Columns that a device refreshes less often than rows come: a row that repeats old news tells nothing of its instant.

Taken for news, a current that is new in every other row is half a row late on the whole, and a drive's lag so much too
long.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sioms.reconcile.effect import Array

#: Share of rows that repeat the one before, in this share of the shortest runs, from which on a column may be refreshed
#: less often than rows come.
REPEATS, USUAL = 0.2, 0.95
#: Most rows from one refresh to the next, share of all changes that come at a multiple of them, and fewest changes.
LONGEST, IN_STEP, FEWEST = 50, 0.98, 30
#: The usual change of what is held is more than so many of its least ones; of what is counted coarsely it is one or
#: two.
OF_LEAST = 4.0


class News(NamedTuple):
    """Rows of a column at which it is new; how many rows lie between them, 1 where all are new, 0 where that varies."""

    rows: NDArray[np.int64]
    every: int


def news(column: Array) -> News:
    """Return the rows at which a column is new; all of them where it is not held, or counted coarsely."""
    everything = np.arange(len(column))
    steps = np.abs(np.diff(column))
    at = np.flatnonzero(steps > 0.0) + 1
    runs = np.sort(np.diff(at))[: int(USUAL * len(at))]  # at a limit, or at rest, a column stays for long, but seldom
    if len(at) < FEWEST or len(runs) > (1.0 - REPEATS) * np.sum(runs):
        return News(everything, 1)
    for every in range(LONGEST, 1, -1):
        times = np.bincount(at % every, minlength=every)
        if times.max() >= IN_STEP * len(at):
            return News(everything[int(np.argmax(times)) :: every], every)
    moved = steps[at - 1]
    if np.median(moved) > OF_LEAST * np.quantile(moved, 0.05):
        return News(at, 0)
    return News(everything, 1)
