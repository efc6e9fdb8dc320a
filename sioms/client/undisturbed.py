"""What a signal must not interrupt half way, in the blocking face: all cells of a fleet are told to stop, or none."""

from __future__ import annotations

import os
import signal
import threading
from typing import Any, Self

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class Undisturbed:
    """Puts off the handlers of signals in a ``with`` block, until ``end`` or the end of the block; then calls them.

    Python calls them in the main thread alone; in any other there is nothing to put off. A signal that comes before the
    block has begun raises there, where nothing has been done yet.

    Concurrency: one thread.
    """

    def __init__(self) -> None:
        self._before: dict[int, Any] = {}
        self._came: list[int] = []

    def __enter__(self) -> Self:
        if threading.current_thread() is threading.main_thread():
            for number in SIGNALS:
                if callable(before := signal.getsignal(number)):
                    self._before[number] = before  # first: it is put back in any case
                    signal.signal(number, self._note)
        return self

    def __exit__(self, *_: object) -> None:
        self.end()

    def end(self) -> None:
        """Call the handlers that have been put off, and put off none any more."""
        while self._before:
            number = next(iter(self._before))
            signal.signal(number, self._before[number])
            del self._before[number]
        came, self._came = self._came, []
        for number in came:
            os.kill(os.getpid(), number)

    def _note(self, number: int, _: object) -> None:
        if number not in self._came:
            self._came.append(number)
