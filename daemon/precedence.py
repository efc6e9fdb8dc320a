"""The daemon's place among its drivers' real-time processes: it works ahead of all of them, and waits beside them.

Who waits beside the drivers is woken when a tick is done, and delays none. But drivers that leave no pause, or fill
each other's pauses, would never let it. So a thread looks whether the loop waits for what has come, and then puts it
ahead of them. It is a thread in Python: it gets the interpreter's lock because whoever has that lock works, and so is
ahead of all drivers, too.
"""

from __future__ import annotations

import select
import threading
import time
from collections.abc import Callable, Iterable
from contextlib import suppress

from .realtime import end_promptly, run_at

BESIDE = 50
"""Least SCHED_FIFO priority at which the daemon waits: that of a driver."""
LOOK_S = 0.025
"""The loop is put ahead when two looks have found it in the same wait, with something to do."""
HOLD_NS = 10_000_000
"""It waits ahead for so long from then on: with a look every LOOK_S it has a sixth of a processor in any case."""


class Precedence:
    """Where the daemon's loop stands.

    Args:
        epoll_fd: what the loop waits for.
        ahead: SCHED_FIFO priority that is above those of all drivers; the caller has it.
        stand: gives a thread (0: the one that calls) a SCHED_FIFO priority.

    Attributes:
        most: the highest priority that a driver may have.

    Concurrency: made and called by the thread of the loop; ``look`` by another one.
    """

    def __init__(self, epoll_fd: int, ahead: int, stand: Callable[[int, int], None] = run_at) -> None:
        self.most = ahead - 1
        self._ahead = ahead
        self._beside = min(BESIDE, self.most)
        self._stand = stand
        self._loop = threading.get_native_id()
        self._poll = select.poll()
        self._poll.register(epoll_fd, select.POLLIN)
        self._waits = self._due_ns = self._hold_ns = 0
        self._watched = threading.Event()
        self._thread: threading.Thread | None = None
        self._is_beside = True
        stand(0, self._beside)

    def adopt(self, priorities: Iterable[int]) -> None:
        """Take the priorities of all drivers, 0 for those that are ordinary processes and need none before them."""
        given = [each for each in priorities if each]
        self._beside = min(max([BESIDE, *given]), self.most)
        if not given:
            self._watched.clear()
            self._is_beside = True
            self._stand(0, self._beside)
            return
        self._watched.set()
        if self._thread is None:
            thread = threading.Thread(target=self._watch, daemon=True, name="precedence")
            with suppress(RuntimeError):  # no memory, or no more threads: then the loop waits ahead
                thread.start()
                self._thread = thread
        self.work()

    def wait(self, due_ns: int) -> None:
        """Stand beside the drivers, before a wait; call ``work`` behind it.

        Args:
            due_ns: when it ends at the latest [ns, CLOCK_MONOTONIC].
        """
        self._waits += 1
        self._due_ns = due_ns
        if self._thread is not None and not self._is_beside and time.monotonic_ns() >= self._hold_ns:
            self._is_beside = True
            self._stand(0, self._beside)

    def work(self) -> None:
        """Stand ahead of the drivers."""
        self._due_ns = 0
        if self._is_beside and self._watched.is_set():
            self._is_beside = False
            self._stand(0, self._ahead)

    def look(self, before: int) -> int:
        """Put the loop ahead when it is kept from a processor.

        Args:
            before: what the last look has returned.

        Returns:
            The number of the wait that should have ended; 0 where none should.
        """
        number, due_ns = self._waits, self._due_ns
        if not due_ns or not (time.monotonic_ns() >= due_ns or self._poll.poll(0)):
            return 0
        if number == before:
            self._hold_ns = time.monotonic_ns() + HOLD_NS
            self._stand(self._loop, self._ahead)
        return number

    def _watch(self) -> None:
        end_promptly()
        found = 0
        while self._watched.wait():
            time.sleep(LOOK_S)
            found = self.look(found)
