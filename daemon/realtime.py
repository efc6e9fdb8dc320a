"""How much of the machine the drivers' real-time processes may take, all together.

A process in a real-time class runs before all ordinary ones. Drivers that need more than the machine has leave nothing
for clients, shells and the person who wants to stop them; so the greediest of them become ordinary processes again.
"""

from __future__ import annotations

import os
import resource
import time
from collections.abc import Callable, Mapping
from contextlib import suppress

SHARE = 0.7
"""Of all processors together, what real-time drivers may use."""
LOOKS = 3
"""Looks in a row with more than that after which the greediest is made an ordinary process."""
LOOK_S = 1.0
HIGHEST = 99
"""Highest priority of SCHED_FIFO."""


class Budget:
    """Looks at what real-time drivers use.

    Args:
        log: the daemon's log.
        processors: how many there are.
    """

    def __init__(self, log: Callable[..., None], processors: int | None = None) -> None:
        self._log = log
        self._processors = processors or len(os.sched_getaffinity(0))
        self._seen: dict[int, float] = {}
        self._seen_s = 0.0
        self._over = 0

    def look(self, now_s: float, used_s: Mapping[str, tuple[int, float]]) -> tuple[str, int] | None:
        """Take the processor times of all real-time drivers; return the name and pid of one that must yield.

        Args:
            now_s: the time [s].
            used_s: pid and processor time since its start [s] of each driver that runs in a real-time class.
        """
        passed_s, self._seen_s = now_s - self._seen_s, now_s
        fresh_s = {n: (pid, used - self._seen[pid]) for n, (pid, used) in used_s.items() if pid in self._seen}
        self._seen = dict(used_s.values())
        total = sum(each for _, each in fresh_s.values()) / max(passed_s, 1e-3)
        self._over = self._over + 1 if total > SHARE * self._processors else 0
        if self._over < LOOKS:
            return None
        self._over = 0
        name = max(fresh_s, key=lambda each: fresh_s[each][1])
        pid, used = fresh_s[name]
        self._log(
            "warning", "real time given up", device=name,
            why=f"drivers in real-time classes use {total:.2f} of {self._processors} processors, this one "
            f"{used / max(passed_s, 1e-3):.2f}; at most {SHARE:g} of the machine may be theirs",
        )  # fmt: skip
        return name, pid


def realtime_use(pids: Mapping[str, int]) -> dict[str, tuple[int, float]]:
    """Return pid and processor time [s] of those processes that run in a real-time class, by name."""
    found = {}
    for name, pid in pids.items():
        try:
            if pid and os.sched_getscheduler(pid) & ~os.SCHED_RESET_ON_FORK in (os.SCHED_FIFO, os.SCHED_RR):
                found[name] = (pid, time.clock_gettime((~pid << 3) | 2))  # clock_getcpuclockid(3)
        except OSError:
            continue  # it has just ended
    return found


def run_at(thread: int, priority: int) -> None:
    """Give a thread (0: the one that asks) a priority under SCHED_FIFO; what it starts does not inherit it.

    Raises:
        OSError: it may not have it.
    """
    os.sched_setscheduler(thread, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(priority))


def run_ahead(thread: int = 0) -> int:
    """Give a thread of ours the highest priority that there is, or that we may have; return it, 0 for none."""
    for priority in (HIGHEST, resource.getrlimit(resource.RLIMIT_RTPRIO)[0]):
        with suppress(OSError):
            run_at(thread, priority)
            return priority
    return 0


def end_promptly(thread: int = 0) -> None:
    """Have a thread of ours (0: the one that asks) run ahead of all drivers, where the loop does.

    A killed process is dead, and its drivers halt, when its last thread has had a processor to end on. And while a
    thread has the interpreter's lock, the loop waits for it: nobody who waits for the loop may come before it.
    """
    with suppress(OSError):
        if os.sched_getscheduler(os.getpid()) & ~os.SCHED_RESET_ON_FORK == os.SCHED_FIFO:
            run_ahead(thread)


def make_ordinary(pid: int) -> None:
    """Take a process out of its real-time class; one that has ended, or is not ours, is left."""
    try:
        os.sched_setscheduler(pid, os.SCHED_OTHER, os.sched_param(0))
    except OSError:
        return
