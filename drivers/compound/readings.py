"""Where held axes are, all at one instant.

Devices show their axes at instants of their own; one that the machine has kept waiting shows them late, for as long as
that lasts. What a coordinate is made of must be of one time, so each device's readings are kept until all have come as
far, and are interpolated at the stamp of the one that is last.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from sioms.protocol.flags import AxisStatus
from sioms.sdk.driver import HeldNode, InputNode
from sioms.sdk.exchange import LinkError

_STOPPED = int(AxisStatus.EMERGENCY_STOP)
LATCHED = _STOPPED | int(AxisStatus.FAULT)


class Reading(NamedTuple):
    """What the held axes show.

    Args:
        joints: where they were at ``stamp_ns``.
        load: the force [N] or torque [N m] with which each drives.
        status: their status bits together.
        latched: which node is stopped or in fault, in words; empty when none is.
        stamp_ns: the instant up to which all have been read [ns].
    """

    joints: list[float]
    load: list[float]
    status: int
    latched: str
    stamp_ns: int


class Past:
    """Positions over time, from the instant on that is asked for next."""

    def __init__(self) -> None:
        self._kept: deque[tuple[int, list[float]]] = deque()

    @property
    def last(self) -> tuple[int, list[float]]:
        """The last positions and their instant [ns]; none are (0, [])."""
        return self._kept[-1] if self._kept else (0, [])

    def add(self, stamp_ns: int, positions: list[float]) -> None:
        """Keep positions, unless there are some of that instant already."""
        if stamp_ns > self.last[0]:
            self._kept.append((stamp_ns, positions))

    def at(self, stamp_ns: int) -> list[float]:
        """Return the positions of an instant, no earlier than any that has been asked for; beyond those that are kept
        the nearest.
        """
        kept = self._kept
        while len(kept) > 1 and kept[1][0] <= stamp_ns:
            kept.popleft()
        begin_ns, positions = kept[0]
        if len(kept) == 1 or stamp_ns <= begin_ns:
            return list(positions)
        end_ns, after = kept[1]
        part = (stamp_ns - begin_ns) / (end_ns - begin_ns)
        return [a + part * (b - a) for a, b in zip(positions, after, strict=True)]


class Readings:
    """Reads the held axes.

    Args:
        names: of the nodes, in the order of the map.
        inputs: their pages.
        held: the nodes as they are held.
    """

    def __init__(self, names: Sequence[str], inputs: Mapping[str, InputNode], held: Mapping[str, HeldNode]) -> None:
        self._nodes = [(name, inputs[name], held[name], Past()) for name in names]

    def take(self, now_ns: int) -> Reading:
        """Read all.

        A stop or fault from before the end of a reset that has been sent does not count.

        Raises:
            LinkError: one is lost, or no number.
        """
        load: list[float] = []
        status, latched = 0, ""
        for name, node, held, past in self._nodes:
            reading = node.read(now_ns)
            if reading is None:
                raise LinkError(f"{name}: its position is not known; want its device up")
            positions = reading["value"].tolist()
            if not all(map(math.isfinite, positions)):
                raise LinkError(f"{name}: its position is not a finite number")
            past.add(node.stamp_ns, positions)
            load += reading["force"].tolist()
            shown = int(np.bitwise_or.reduce(reading["status"].astype(np.int64)))
            if node.as_of_ns < held.shows_reset_ns:
                shown &= ~LATCHED
            status |= shown
            if shown & LATCHED:
                latched = f"{name}: {'emergency stop' if shown & _STOPPED else 'an axis is in fault'}"
        stamp_ns = min(past.last[0] for *_, past in self._nodes)
        joints = [position for *_, past in self._nodes for position in past.at(stamp_ns)]
        return Reading(joints, load, status, latched, stamp_ns)
