"""Sessions with the daemon on behalf of those who call: their rights, their quotas, their names in messages."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any, TypeVar

from sioms.client.workcell import Workcell

from .callers import Caller, acting_as
from .tree import Tree

T = TypeVar("T")
FRESH_S = 1.0
"""How long a list of nodes holds [s]."""
MOST_USERS = 64
"""Users, by all their groups, whose sessions are kept."""


class Seen:
    """What one user sees: a session for looking and reading, and the nodes that he may read."""

    def __init__(self, connect: Callable[[str], Workcell]) -> None:
        self._connect, self._cell = connect, connect("sioms mount")
        self._tree, self._until_s = Tree(), 0.0
        self._lock = threading.Lock()

    def ask(self, what: Callable[[Workcell], T]) -> T:
        """Do something with the session; if the daemon is another by now, with a new one.

        Files that are open stay with the old one, and tell that it has ended.
        """
        cell = self._cell
        try:
            return what(cell)
        except OSError:
            if not cell._channel.ended:
                raise
        with self._lock:
            if self._cell is cell:
                self._cell = self._connect("sioms mount")
            cell = self._cell
        return what(cell)

    def tree(self) -> Tree:
        """Return the files there are."""
        if time.monotonic() > self._until_s:
            self._tree = Tree(self.ask(lambda cell: cell.nodes()))
            self._until_s = time.monotonic() + FRESH_S
        return self._tree

    def close(self) -> None:
        """End the session."""
        with suppress(OSError):
            self._cell.close()


class Sessions:
    """The sessions of all users.

    Args:
        connect: makes a session of a name.

    Concurrency: any number of threads.
    """

    def __init__(self, connect: Callable[[str], Any] = lambda name: Workcell(name=name)) -> None:
        self._connect = connect
        self._seen: dict[tuple[int, int, tuple[int, ...]], Seen] = {}
        self._lock = threading.Lock()

    def of(self, who: Caller) -> Seen:
        """Return what a user sees.

        Raises:
            OSError: no daemon is there, or he may not connect.
        """
        key = who.uid, who.gid, who.groups
        with self._lock:
            seen = self._seen.get(key)
        if seen is None:
            seen = Seen(lambda name: self.new(who, name))
            with self._lock:
                self._seen[key] = seen
                while len(self._seen) > MOST_USERS:
                    self._seen.pop(next(iter(self._seen))).close()
        return seen

    def new(self, who: Caller, name: str) -> Workcell:
        """Begin a session with somebody's rights."""
        with acting_as(who):
            cell: Workcell = self._connect(name)
        return cell
