"""The lowest real-time class, for threads that a busy machine must not keep waiting."""

from __future__ import annotations

import os
import threading
import time
from contextlib import suppress
from typing import Self

SHARE = 0.25
"""Of a processor, what threads that somebody else keeps busy may take in the real-time class."""
ORDINARY_S = 1.0
"""How long they are ordinary ones when they have taken more [s]."""
ORDINARY, PROMPT = os.SCHED_OTHER | os.SCHED_RESET_ON_FORK, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK
"""Classes of threads. Who is not privileged may leave the real-time class, and may not take back the flag."""
_LEAST, _NONE = os.sched_param(1), os.sched_param(0)
MOMENT_NS = 50_000_000
"""How long threads of a library that pass a stop on are prompt [ns]."""


def be_prompt() -> bool:
    """Have this thread run ahead of all ordinary ones, and behind all drivers, where the system allows it.

    ``LimitRTPRIO`` of a unit, or ``rtprio`` of limits.conf, does. What the thread starts is ordinary again.

    Returns:
        Whether it does so from now on.
    """
    try:
        os.sched_setscheduler(0, PROMPT, os.sched_param(1))
    except OSError:
        return False
    return True


class Briefly:
    """Has the thread that uses it in a ``with`` block be prompt there, unless it is in another class than the ordinary
    one already. It must not fork there.

    Concurrency: one thread; another one has its own.
    """

    _entered = False

    def __enter__(self) -> Self:
        try:
            self._before = os.sched_getscheduler(0)
            if self._before & ~os.SCHED_RESET_ON_FORK == os.SCHED_OTHER:
                self._entered = True
                os.sched_setscheduler(0, os.SCHED_FIFO | self._before, _LEAST)
        except OSError:
            self._entered = False
        except BaseException:  # of a signal's handler: nobody would call __exit__
            self.__exit__()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        if self._entered:
            os.sched_setscheduler(0, self._before, _NONE)  # back, and with the flag that it had: it is never refused
            self._entered = False


class Hurry:
    """Threads of a library that are prompt for a moment, while they pass a stop on.

    Concurrency: any threads.
    """

    def __init__(self) -> None:
        self._threads: dict[int, bool] = {}
        self._until_ns = 0
        self._lock = threading.Lock()

    def meet(self) -> None:
        """Have the thread that calls be one of them, from now on."""
        self._threads.setdefault(threading.get_native_id(), False)

    def begin(self) -> None:
        """Have them be prompt for a moment; ``look`` ends it."""
        with self._lock:
            self._until_ns = time.monotonic_ns() + MOMENT_NS
            for thread, is_prompt in list(self._threads.items()):
                if not is_prompt:
                    self._threads[thread] = _move(thread, os.SCHED_OTHER, PROMPT, 1)

    def look(self) -> None:
        """Have them be ordinary again when the moment has passed."""
        if not self._until_ns or time.monotonic_ns() < self._until_ns:
            return
        with self._lock:
            self._until_ns = 0
            for thread, is_prompt in list(self._threads.items()):
                if is_prompt:
                    _move(thread, os.SCHED_FIFO, ORDINARY, 0)
                    self._threads[thread] = False


def _move(thread: int, before: int, policy: int, priority: int) -> bool:
    """Give a thread of this process a class if it has that of ``before``; return whether it has it now."""
    try:
        os.stat(f"/proc/self/task/{thread}")  # its number may be another process's by now
        if os.sched_getscheduler(thread) & ~os.SCHED_RESET_ON_FORK != before:
            return False
        os.sched_setscheduler(thread, policy, os.sched_param(priority))
    except OSError:  # it has ended, or has no right to the class
        return False
    return True


class BoundedPrompt:
    """Threads that are prompt as long as they take little: what others send must not take a processor.

    Concurrency: ``enter`` in the threads that are meant, ``look`` in one that calls it about ten times a second.
    """

    def __init__(self) -> None:
        self._ran_ns: dict[int, int] = {}
        self._looked_ns = time.monotonic_ns()
        self._ordinary_until_ns = 0

    def enter(self) -> None:
        """Have the thread that calls be one of them, and as prompt as these are now; again: nothing."""
        thread = threading.get_native_id()
        if thread not in self._ran_ns:
            may = self._ordinary_until_ns or be_prompt()
            self._ran_ns[thread] = _ran_ns(thread) if may else -1

    def look(self) -> None:
        """Make them ordinary when they have taken more than their share since the last look, and prompt again later."""
        now_ns = time.monotonic_ns()
        took = 0
        for thread, before in list(self._ran_ns.items()):
            if before < 0:
                continue  # it has no right to the class
            ran_ns = _ran_ns(thread)
            if ran_ns < 0:
                del self._ran_ns[thread]  # it has ended
                continue
            took += ran_ns - before
            self._ran_ns[thread] = ran_ns
        lasted_ns, self._looked_ns = now_ns - self._looked_ns, now_ns
        if took > SHARE * lasted_ns:
            self._set(ORDINARY, 0)
            self._ordinary_until_ns = now_ns + int(ORDINARY_S * 1e9)
        elif self._ordinary_until_ns and now_ns > self._ordinary_until_ns:
            self._ordinary_until_ns = 0
            self._set(PROMPT, 1)

    def _set(self, policy: int, priority: int) -> None:
        for thread, ran_ns in list(self._ran_ns.items()):  # another thread may enter
            if ran_ns >= 0:
                with suppress(OSError):
                    os.sched_setscheduler(thread, policy, os.sched_param(priority))


def _ran_ns(thread: int) -> int:
    """Return how long a thread of this process has run [ns]; -1: it has ended."""
    try:
        with open(f"/proc/self/task/{thread}/schedstat", "rb") as file:
            return int(file.read().split()[0])
    except OSError:
        return -1
