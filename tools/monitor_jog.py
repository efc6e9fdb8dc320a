"""Jogging by keys: an axis is chosen, taken, moved while a key repeats, and let go.

A terminal tells no release of a key. A jog therefore ends by itself when its key has not come again for a moment, and
the node is
held by a lease: a monitor that hangs, is stopped by Ctrl-Z or killed halts the axis, too.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from sioms.client.workcell import Workcell
from sioms.protocol.flags import NodeClass

from .monitor_view import Jog, NodeView

FIRST_NS, AGAIN_NS = 600_000_000, 200_000_000
"""How long a jog goes on after its key: terminals repeat it for the first time after half a second, then thirty times a
second.
"""
LEASE_S = 0.5
SPEEDS = (0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0)
"""Speeds, as shares of the axis' limit."""
STEP_S = 0.1
"""A step is as long as the jog's way in this time."""
_LEFT, _RIGHT = ("\x1b[D", "\x1bOD"), ("\x1b[C", "\x1bOC")
KEYS = (*_LEFT, *_RIGHT, "<", ">", "+", "-")


class Jogger:
    """The axis that the keys move.

    Concurrency: the thread of the keys.
    """

    def __init__(self) -> None:
        self._which: tuple[str, int] | None = None
        self._node: Any = None
        self._index = SPEEDS.index(0.1)
        self._way = 0
        self._until_ns = 0
        self._limit = 1.0

    @property
    def shown(self) -> Jog | None:
        """What is chosen, for the picture."""
        if self._which is None:
            return None
        return Jog(*self._which, self._speed, self._speed * STEP_S, self._node is not None)

    @property
    def _speed(self) -> float:
        return SPEEDS[self._index] * self._limit

    def choose(self, nodes: Sequence[NodeView]) -> str:
        """Go on to the next axis of the workcell; let go of the one before; return what to tell."""
        said = self.let_go()
        axes = [
            (node.name, axis, channel.limits.get("velocity", 1.0))
            for node in nodes
            if node.info is not None and node.info.node_class is NodeClass.AXIS and _takes_commands(node)
            for axis, channel in enumerate(node.info.channels)
        ]
        if not axes:
            self._which = None
            return "no axis to jog"
        places = [axis[:2] for axis in axes]
        at = places.index(self._which) + 1 if self._which in places else 0
        name, axis, self._limit = axes[at % len(axes)]
        self._which = (name, axis)
        return said

    def take(self, cell: Workcell | None) -> str:
        """Open the chosen axis, or let go of it; return what to tell."""
        if self._node is not None:
            return self.let_go()
        if self._which is None:
            return "choose an axis first: tab"
        if cell is None:
            return "no daemon to open the axis with"
        name, axis = self._which
        try:
            info = cell.info(name)
            single = f"{name}.{info.channels[axis].name}"
            there = {entry.name for entry in cell.nodes()}
            self._node = cell.open(single if single in there else name, "rw", lease=LEASE_S)
        except OSError as error:
            return error.strerror or str(error)
        return ""

    def let_go(self) -> str:
        """Close the axis, which halts it; return what to tell."""
        node, self._node, self._way = self._node, None, 0
        if node is None:
            return ""
        try:
            node.close()
        except OSError as error:
            return error.strerror or str(error)
        return ""

    def press(self, key: str, now_ns: int) -> str:
        """Obey one of KEYS; return what to tell."""
        if key in ("+", "-"):
            self._index = max(0, min(len(SPEEDS) - 1, self._index + (1 if key == "+" else -1)))
            return self._go(self._way) if self._way else ""
        if self._node is None:
            return "take the axis first: c"
        if key in ("<", ">"):
            return self._step(1 if key == ">" else -1)
        way = 1 if key in _RIGHT else -1
        self._until_ns = now_ns + (AGAIN_NS if way == self._way else FIRST_NS)
        return self._go(way) if way != self._way else ""

    def beat(self, now_ns: int) -> str:
        """Renew the lease, and end a jog whose key has not come again; return what to tell. To be
        called every 0.1 s.
        """
        if self._node is None:
            return ""
        try:
            self._node.keepalive()
            if self._way and now_ns > self._until_ns:
                return self.halt()
        except OSError as error:
            self._node, self._way = None, 0
            return f"the axis was taken away: {error.strerror or error}"
        return ""

    def halt(self) -> str:
        """Stop the jog; return what to tell."""
        if not self._way or self._node is None:
            return ""
        self._way = 0
        return self._told(self._node.stop)

    def _go(self, way: int) -> str:
        self._way = way
        return self._told(lambda: self._node.jog(way * self._speed, self._axis))

    def _step(self, way: int) -> str:
        said = self.halt()
        return said or self._told(lambda: self._node.tweak(way * self._speed * STEP_S, self._axis))

    @property
    def _axis(self) -> int:
        return 0 if len(self._node.info.channels) == 1 or self._which is None else self._which[1]

    def _told(self, do: Any) -> str:
        try:
            do()
        except OSError as error:
            self._way = 0
            return error.strerror or str(error)
        return ""


def _takes_commands(node: NodeView) -> bool:
    """Whether a node can be opened for writing; the monitor reads it through its read-only companion."""
    return node.info is not None and (not node.info.read_only or node.info.name != node.name)
