"""Recordings of one axis, in SI units, as arrays. No files here: the tools read them."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sioms.reconcile.effect import Array


@dataclass(frozen=True, slots=True)
class Record:
    """One recording at a constant sample time; arrays have shape (n,).

    Attributes:
        position: measured, [{x}].
        force: command to the drive, held over each sample, [{F}].
        command: position command, [{x}], or None.
        force_measured: drive current times the nominal constant, mean over each sample, or None.
        index: True where an index mark was passed during the sample, or None.
        time_s: time stamps, or None where the sample time is taken on trust.
        filled: True where a sample was lost and is interpolated, or None.
        feedforward: the part of ``force`` that is no feedback (a feed-forward, an injected test signal), or None.
        external: known force that acts on the axis beside the drive's, held over each sample, [{F}], or None.
        bends: how the known forces go within each sample about their means: what their slope and their bend make at its
            end, of the first two Legendre polynomials, shape (n, 2), [{F}], or None where they are held.
        trust: factor on the residual of each sample, less than 1 where the force is known to worse than the drive's
            noise, or None.
    """

    name: str
    position: Array
    force: Array
    command: Array | None = None
    force_measured: Array | None = None
    index: NDArray[np.bool_] | None = None
    time_s: Array | None = None
    filled: NDArray[np.bool_] | None = None
    feedforward: Array | None = None
    external: Array | None = None
    bends: Array | None = None
    trust: Array | None = None

    def __len__(self) -> int:
        return len(self.position)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return the channels that there are, by their names."""
        named = {f.name: getattr(self, f.name) for f in fields(self) if f.name != "name"}
        return {name: a for name, a in named.items() if a is not None}

    def cut(self, start: int, stop: int) -> Record:
        """Return samples start..stop."""
        return self.only(slice(start, stop))

    def only(self, which: slice | NDArray[np.bool_]) -> Record:
        """Return some of the samples."""
        parts: dict[str, Any] = {name: a[which] for name, a in self.arrays().items()}
        return Record(self.name, **parts)


@dataclass(frozen=True, slots=True)
class Session:
    """Records of one axis in the order in which they were made.

    Attributes:
        continuous: the heat state carries over from each record to the next.
        final: whole records that take no part in any choice, each of a session of its own; without them the
            last part of every record is kept for the final statement.
        loop_time_s: period of the loop that makes the force; None where nobody said (``sampling``).
        halves: of polled records, which are interpolated, the same from every other row, and from the others.
    """

    records: tuple[Record, ...]
    continuous: bool = True
    final: tuple[Record, ...] = ()
    loop_time_s: float | None = None
    halves: tuple[Session, ...] = ()

    @property
    def samples(self) -> int:
        """Number of samples altogether."""
        return sum(len(r) for r in self.records)
