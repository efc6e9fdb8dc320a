"""A port of input lines from the kernel's edge events, without I/O: levels, stamps, and how many events were lost.

The kernel numbers the events of a request (GPIO character device, version 2: ``seqno`` from 1 on); when its buffer is
full it drops the oldest, so a gap in the numbers is the number of edges that nobody can tell any more.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Edge:
    """An edge of one line.

    Args:
        bit: of the line in its port.
        rising: to active, after active-low has been taken into account.
        stamp_ns: when it happened, by the kernel [ns, CLOCK_MONOTONIC].
        number: of the event among all of the request.
    """

    bit: int
    rising: bool
    stamp_ns: int
    number: int


class EdgePort:
    """The port's value, event by event.

    Attributes:
        value: present bits.
        seen: events taken.
        lost: events that the kernel had to drop.

    Example:
        >>> port = EdgePort(0b00)
        >>> port.take([Edge(1, True, 100, 1), Edge(0, True, 150, 2), Edge(1, False, 160, 5)])
        [(2, 100), (3, 150), (1, 160)]
        >>> port.lost
        2
    """

    def __init__(self, value: int) -> None:
        self.value = value
        self.seen = self.lost = 0
        self._number = 0

    def take(self, edges: Iterable[Edge]) -> list[tuple[int, int]]:
        """Return the values that the port took and when [ns], one for each edge that changed it."""
        values = []
        for edge in edges:
            self.lost += max(0, edge.number - self._number - 1)
            self._number = max(self._number, edge.number)
            self.seen += 1
            value = self.value | 1 << edge.bit if edge.rising else self.value & ~(1 << edge.bit)
            if value != self.value:  # an edge before the first look is in the first value already
                self.value = value
                values.append((value, edge.stamp_ns))
        return values

    def correct(self, value: int) -> bool:
        """Take the levels as they were read after a loss; return whether they differ from what the edges tell."""
        changed = value != self.value
        self.value = value
        return changed
