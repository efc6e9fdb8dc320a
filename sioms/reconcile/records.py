"""Recordings of one axis, in SI units, as arrays. No files here: the tools read them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sioms.reconcile.effect import Array


@dataclass(frozen=True, slots=True)
class Record:
    """One recording at a constant sample time; arrays have shape (n,).

    Attributes:
        position: measured, [{x}].
        force: command of the controller, held over each sample, [{F}].
        command: position command, [{x}], or None.
        force_measured: drive current times the nominal constant, mean over each sample, or None.
        index: True where an index mark was passed during the sample, or None.
        time_s: time stamps, or None where the sample time is taken on trust.
    """

    name: str
    position: Array
    force: Array
    command: Array | None = None
    force_measured: Array | None = None
    index: NDArray[np.bool_] | None = None
    time_s: Array | None = None

    def __len__(self) -> int:
        return len(self.position)

    def cut(self, start: int, stop: int) -> Record:
        """Return samples start..stop."""

        def part(a: Array | None) -> Array | None:
            return None if a is None else a[start:stop]

        index = None if self.index is None else self.index[start:stop]
        return replace(self, position=self.position[start:stop], force=self.force[start:stop],
                       command=part(self.command), force_measured=part(self.force_measured), index=index,
                       time_s=part(self.time_s))


@dataclass(frozen=True, slots=True)
class Session:
    """Records of one axis in the order in which they were made.

    Attributes:
        continuous: the heat state carries over from each record to the next.
        final: whole records that take no part in any choice, each of a session of its own; without them the
            last part of every record is kept for the final statement.
    """

    records: tuple[Record, ...]
    continuous: bool = True
    final: tuple[Record, ...] = ()

    @property
    def samples(self) -> int:
        """Number of samples altogether."""
        return sum(len(r) for r in self.records)

    def subset(self, which: Sequence[int]) -> Session:
        """Return some of the records; the heat state no longer carries over where one is missing."""
        whole = list(which) == list(range(len(self.records)))
        return Session(tuple(self.records[i] for i in which), self.continuous and whole)
