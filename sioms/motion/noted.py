"""Ends and begins of motions that compiled steps have found, until the bank tells of them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .queue import CommandQueue
from .types import EventKind


class Noted:
    """When steps have found that motions of n axes ended, began, and left their axes idle [ns]; 0: not, or told.

    Attributes:
        ended_ns, started_ns, idle_ns: (n,) int64, written by steps.
    """

    def __init__(self, n: int) -> None:
        self.ended_ns, self.started_ns, self.idle_ns = (np.zeros(n, dtype=np.int64) for _ in range(3))
        self._kinds = (
            (EventKind.ENDED, self.ended_ns), (EventKind.STARTED, self.started_ns), (EventKind.IDLE, self.idle_ns),
        )  # fmt: skip

    def tell(self, queue: CommandQueue) -> list[int]:
        """Tell of all in their order, of those of a tick together; return the axes on which commands have begun."""
        found: list[tuple[int, EventKind, NDArray[np.int64]]] = []
        begun: list[int] = np.flatnonzero(self.started_ns).tolist()
        for kind, noted_ns in self._kinds:
            axes = np.flatnonzero(noted_ns)
            when_ns = noted_ns[axes]
            found += [(at_ns, kind, axes[when_ns == at_ns]) for at_ns in set(when_ns.tolist())]
            noted_ns[axes] = 0
        for at_ns, kind, axes in sorted(found, key=lambda each: each[0]):  # those of a tick in the order of kinds
            queue.emit(kind, axes, at_ns)
        return begun
