"""Samples of an axis, and the moves in them.

A move is a run of samples without a gap in which the axis follows a position. What is pressed, stopped, in fault or at
the limit of the drive's force says nothing of the axis's own friction and mass, and is left out.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

#: Rest that is kept before and after a move, the shortest move, and where a longer one is cut [s].
MARGIN_S, SHORTEST_S, LONGEST_S = 0.05, 0.1, 4.0
#: Stamps of neighbours differ by this share of a tick at most.
JITTER = 0.5
#: At such a share of its limit the drive does not give what was asked for.
LIMITED = 0.98
#: Samples that are waited with for the end of a move [s].
MOST_S = 20.0


@dataclass(frozen=True, slots=True)
class Samples:
    """Readings of one axis in the order of time, shape (n,) each.

    Attributes:
        time_s: of the axis's clock.
        position, force, command, speed: measured position, force of the drive, commanded position and velocity.
        moving: whether a command is being carried out.
        usable: whether the axis follows its position: no force mode, no stop, no fault.
    """

    time_s: Array
    position: Array
    force: Array
    command: Array
    speed: Array
    moving: Flags
    usable: Flags

    def __len__(self) -> int:
        return len(self.time_s)

    def part(self, first: int, last: int) -> Samples:
        """Return some of them."""
        return Samples(*(getattr(self, f.name)[first:last] for f in fields(self)))

    def and_then(self, later: Samples) -> Samples:
        """Return these and later ones."""
        return Samples(*(np.concatenate([getattr(self, f.name), getattr(later, f.name)]) for f in fields(self)))


class Cutter:
    """Cuts samples that come in pieces into moves.

    Args:
        tick_s: period of the samples.
        force_max: limit of the drive, inf for none.

    Concurrency: one thread.
    """

    def __init__(self, tick_s: float, force_max: float) -> None:
        self._tick_s, self._most = tick_s, LIMITED * force_max
        self._kept: Samples | None = None

    def feed(self, samples: Samples) -> Iterator[Samples]:
        """Take samples; yield the moves that have ended, with a little rest on either side."""
        if not len(samples):
            return
        all_ = samples if self._kept is None else self._kept.and_then(samples)
        good = all_.usable & (np.abs(all_.force) < self._most) & np.isfinite(all_.position) & np.isfinite(all_.force)
        step = np.diff(all_.time_s)
        torn = np.flatnonzero((np.abs(step / self._tick_s - 1.0) > JITTER) | (good[1:] != good[:-1])) + 1
        bounds = [0, *torn.tolist(), len(all_)]
        for first, last in pairwise(bounds[:-1]):
            if good[first]:
                yield from self._moves(all_.part(first, last), True)[0]
        rest = all_.part(bounds[-2], len(all_))
        if not good[-1]:
            self._kept = None
            return
        moves, taken = self._moves(rest, False)
        yield from moves
        self._kept = rest.part(taken, len(rest))

    def _moves(self, run: Samples, ended: bool) -> tuple[list[Samples], int]:
        """Return the moves of a run without a gap, and how many samples are not needed any more."""
        margin = max(round(MARGIN_S / self._tick_s), 2)
        longest, least = round(LONGEST_S / self._tick_s), max(round(SHORTEST_S / self._tick_s), 8)
        edges = np.flatnonzero(np.diff(run.moving.astype(np.int8), prepend=0, append=0))
        found: list[Samples] = []
        taken = 0
        for first, last in edges.reshape(-1, 2).tolist():
            if not ended and last + margin > len(run):
                if len(run) - first < longest + margin:
                    return found, max(0, min(first - margin, len(run)))
                last = first + longest * ((len(run) - first - margin) // longest)  # it goes on
                ended_at = last
            else:
                ended_at = 0
            for start in range(first, last, longest):
                stop = min(start + longest, last)
                if stop - start >= least:
                    found.append(run.part(max(0, start - margin), min(stop + margin, len(run))))
            taken = max(last - margin, 0)
            if ended_at:
                return found, taken
        return found, max(taken, len(run) - margin)
