"""Stops that wait to be passed on, taken in turn by who asks: nobody's flood keeps another's stop out or back."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Iterator
from typing import NamedTuple

from sioms.client.cell_verbs import Asked

EACH = 8
"""Stops of one certificate that wait at most; of more the first ones do the same."""


class Stop(NamedTuple):
    """A stop that is to be told to the daemon and answered.

    Attributes:
        name: of the session that it came from.
        frame: as it came.
        begun: what ``Ways.begin`` returned for it; came_ns: when that was.
    """

    name: str
    frame: bytes
    begun: Asked | None = None
    came_ns: int = 0


class StopQueue:
    """Stops by the number of who asks.

    Concurrency: ``put`` and ``close`` in any thread, iteration in one.
    """

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._of: dict[str, deque[Stop]] = {}
        self._is_closed = False

    def has_room(self, number: str) -> bool:
        """Tell whether there is room for a stop."""
        return len(self._of.get(number, ())) < EACH

    def put(self, number: str, stop: Stop) -> bool:
        """Add a stop; return whether there was room for it."""
        with self._changed:
            waiting = self._of.setdefault(number, deque())
            if len(waiting) >= EACH:
                return False
            waiting.append(stop)
            self._changed.notify()
        return True

    def close(self) -> None:
        """Have the iteration end; stops that wait are not passed on any more."""
        with self._changed:
            self._is_closed = True
            self._changed.notify()

    def __iter__(self) -> Iterator[tuple[str, Stop]]:
        """Wait for stops and return them with the number of who asks; one of each number before a second of any."""
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._of or self._is_closed)
                if self._is_closed:
                    return
                number = next(iter(self._of))
                waiting = self._of.pop(number)
                stop = waiting.popleft()
                if waiting:
                    self._of[number] = waiting
            yield number, stop
