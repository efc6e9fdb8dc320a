"""Nodes that a bridge holds for clients of its own, each for as long as its client renews its lease.

The lease is that of the node, so that the driver halts its axes when the client, the bridge or the daemon between
them is silent: docs/decisions/0395
"""

from __future__ import annotations

import errno
import threading
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass
from time import monotonic
from typing import Any

from sioms.bridges.prompt import Prompt
from sioms.client.workcell import Workcell

LEASE_S = (0.2, 10.0)
"""Shortest and longest lease [s]."""


@dataclass(slots=True)
class Lent:
    """A node that is held for a client.

    Attributes:
        who: the client.
        lease_s: longest silence allowed to it [s].
        cell, node: its session and its node.
        until_s: when the lease runs out.
    """

    who: str
    lease_s: float
    cell: Any
    node: Any
    until_s: float

    def renew(self) -> None:
        """Renew the lease at the driver; raises OSError where it has run out there."""
        self.node.keepalive()
        self.node.read()
        self.until_s = monotonic() + self.lease_s


class Leases:
    """All nodes that are held for clients.

    Args:
        prompt: tells how old what a client has said may be.
        connect: makes a session of a name.

    Concurrency: any number of threads.
    """

    def __init__(self, prompt: Prompt, connect: Callable[[str], Any] = lambda name: Workcell(name=name)) -> None:
        self._prompt, self._connect = prompt, connect
        self._lent: dict[str, Lent] = {}
        self._locks: defaultdict[str, threading.Lock] = defaultdict(threading.Lock)

    def put(self, name: str, who: str, lease_s: float) -> None:
        """Take a node for a client, renew its lease, or with 0 let go of it: its axes halt.

        Raises:
            OSError: EBUSY, another client holds it; EINVAL, no such lease; what opening raises.
        """
        with self._locks[name]:
            lent = self._of(name, who)
            if lease_s == 0:
                self._end(name)
                return
            low, high = LEASE_S
            if not low <= lease_s <= high:
                raise OSError(errno.EINVAL, f"lease {lease_s:g} s; want {low:g} to {high:g} s, or 0 to let go")
            if lent is None:
                self._take(name, who, lease_s)
            elif lease_s != lent.lease_s:
                text = f"lease {lease_s:g} s; it was taken for {lent.lease_s:g} s: put that, or 0 first"
                raise OSError(errno.EINVAL, text)
            else:
                try:
                    lent.renew()
                except OSError:
                    self._end(name)
                    raise

    def move(self, name: str, who: str, channel: str, position: float) -> None:
        """Go to a position [unit of the axis] instead of what the axis does, and renew the lease.

        Raises:
            OSError: EBUSY, another client holds the node; EPERM, none does; what moving raises.
        """
        with self._locks[name]:
            lent = self._of(name, who)
            if lent is None:
                text = (
                    f"{name} is not held by you, or your lease has run out; put to its LEASE first, and again in time"
                )
                raise OSError(errno.EPERM, text)
            lent.node.move(position, channel, replace=True)
            lent.until_s = monotonic() + lent.lease_s  # any request renews it at the driver

    def shown(self, name: str) -> tuple[float, int, str]:
        """Return the lease of a node [s], 0 where it is free, a severity of 0, and who holds it."""
        lent = self._lent.get(name)
        return (lent.lease_s, 0, f"held by {lent.who}") if lent else (0.0, 0, "")

    def sweep(self) -> None:
        """Let go of nodes whose clients were silent."""
        for name in list(self._lent):
            if self._locks[name].acquire(blocking=False):  # else a put is under way, which looks itself
                try:
                    self._current(name)
                finally:
                    self._locks[name].release()

    def _current(self, name: str) -> Lent | None:
        lent = self._lent.get(name)
        if lent is not None and monotonic() > lent.until_s:
            self._end(name)
            return None
        return lent

    def _of(self, name: str, who: str) -> Lent | None:
        lent = self._current(name)
        if lent is not None and lent.who != who:
            raise OSError(errno.EBUSY, f"{name} is held by {lent.who}, until that client lets go or is silent")
        return lent

    def _take(self, name: str, who: str, lease_s: float) -> None:
        cell = self._connect(f"sioms epics for {who}")
        try:
            node = self._prompt.date(cell.open(name, "rw", lease=lease_s), asked_before=True)
        except BaseException:
            cell.close()
            raise
        self._lent[name] = Lent(who, lease_s, cell, node, monotonic() + lease_s)

    def _end(self, name: str) -> None:
        if (lent := self._lent.pop(name, None)) is not None:
            lent.cell.close()
