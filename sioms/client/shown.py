"""What the open nodes of this process owe to acknowledgements: no reading older than what was acknowledged.

An acknowledgement carries the instant of its effect, a snapshot the instant up to which it shows everything
(``sioms.protocol.page``). All nodes of a device learn of an acknowledgement that any of them has got, all nodes
of the process of what the daemon has acknowledged: a stop, a reset, a signal. A node that has shown all it owes pays
one comparison for that in ``read``; what it owes only grows, so that settling it takes no lock.

Concurrency: any thread.
"""

from __future__ import annotations

import os
from _thread import allocate_lock

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Callable
    from typing import Protocol

    from sioms.protocol.clock import Clock

    class Owing(Protocol):
        """A node, as far as it owes something."""

        owed_ns: int

        @property
        def clock(self) -> Clock | None:
            """That of its stamps, None for that of this machine."""


MOST_DEVICES = 256
"""Driver processes remembered without an open node; those of before a restart are of no use any more."""

_lock = allocate_lock()
_nodes: dict[int, list[Owing]] = {}
_last_ns: dict[int, int] = {}
_everywhere_ns = 0


def _unlock() -> None:
    """Begin with a free lock in a forked child: the thread that held it is not there."""
    global _lock
    _lock = allocate_lock()


os.register_at_fork(after_in_child=_unlock)


def join(node: Owing, device: int) -> None:
    """Let an open node of a driver process owe what has been acknowledged so far."""
    with _lock:
        _nodes.setdefault(device, []).append(node)
        everywhere_ns = _everywhere_ns if node.clock is None else node.clock.everywhere_ns
        node.owed_ns = max(_last_ns.get(device, 0), everywhere_ns)


def leave(node: Owing, device: int) -> None:
    """Forget a node that is closed."""
    with _lock:
        nodes = _nodes.get(device, [])
        if node in nodes:
            nodes.remove(node)
        if not nodes:
            _nodes.pop(device, None)
            for old in [d for d in _last_ns if d not in _nodes][: max(0, len(_last_ns) - MOST_DEVICES)]:
                del _last_ns[old]


def acknowledged(device: int, as_of_ns: int) -> None:
    """Let the nodes of a driver process show nothing that ends before an instant."""
    with _lock:
        if as_of_ns > _last_ns.get(device, 0):
            _last_ns[device] = as_of_ns
            for node in _nodes.get(device, ()):
                if as_of_ns > node.owed_ns:
                    node.owed_ns = as_of_ns


def acknowledged_by_daemon(as_of_ns: int, clock: Clock | None = None) -> None:
    """Let all nodes that go by a clock, None for that of this machine, show nothing that ends before an instant."""
    global _everywhere_ns
    with _lock:
        if clock is None:
            _everywhere_ns = max(_everywhere_ns, as_of_ns)
        else:
            clock.everywhere_ns = max(clock.everywhere_ns, as_of_ns)
        for nodes in _nodes.values():
            for node in nodes:
                if node.clock is clock:
                    node.owed_ns = max(node.owed_ns, as_of_ns)


def clock_acknowledged(clock: Clock) -> Callable[[int], None]:
    """Return what a session with a cell of another clock tells of what has been acknowledged."""
    return lambda as_of_ns: acknowledged_by_daemon(as_of_ns, clock)
