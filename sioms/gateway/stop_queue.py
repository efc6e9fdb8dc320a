"""Stops that wait to be passed on, taken in turn by who asks: nobody's flood keeps another's stop out or back."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Iterator

EACH = 8
"""Stops of one certificate that wait at most; of more the first ones do the same."""


class StopQueue:
    """Stops by the number of who asks.

    Concurrency: ``put`` and ``close`` in any thread, iteration in one.
    """

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._of: dict[str, deque[tuple[str, bytes]]] = {}
        self._is_closed = False

    def put(self, number: str, name: str, frame: bytes) -> bool:
        """Add a stop; return whether there was room for it."""
        with self._changed:
            waiting = self._of.setdefault(number, deque())
            if len(waiting) >= EACH:
                return False
            waiting.append((name, frame))
            self._changed.notify()
        return True

    def close(self) -> None:
        """Have the iteration end; stops that wait are not passed on any more."""
        with self._changed:
            self._is_closed = True
            self._changed.notify()

    def __iter__(self) -> Iterator[tuple[str, str, bytes]]:
        """Wait for stops and return them: number, name, frame; one of each number before a second of any."""
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._of or self._is_closed)
                if self._is_closed:
                    return
                number = next(iter(self._of))
                waiting = self._of.pop(number)
                name, frame = waiting.popleft()
                if waiting:
                    self._of[number] = waiting
            yield number, name, frame
