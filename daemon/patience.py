"""Whether a process that is waited for is slow or stuck: by the processor time it has had, not by the clock.

On a machine with too much to do a process that needs a second may take a minute; nothing is wrong with it then.
"""

from __future__ import annotations

import time
from collections.abc import Callable

LIMIT_S = 30.0
"""Processor time, or time asleep, without a result after which a process counts as stuck [s]."""


class Patience:
    """Watches one process that owes a result.

    Args:
        pid: the process.
        limit_s: as LIMIT_S.
        processor_s: returns the processor time of the process [s]; raises OSError when it has gone.
        state: returns its state as in proc(5): R, S, D, T ...
    """

    def __init__(
        self, pid: int, limit_s: float = LIMIT_S, processor_s: Callable[[int], float] | None = None,
        state: Callable[[int], str] | None = None,
    ) -> None:  # fmt: skip
        self._pid = pid
        self._limit_s = limit_s
        self._processor_s = processor_s or _processor_s
        self._state = state or _state
        self.renew(0.0)

    def renew(self, now_s: float) -> None:
        """Begin anew: it has brought a result."""
        self._used_s = self._asleep_s = 0.0
        self._seen_s = self._read(0.0)
        self._now_s = now_s

    def stuck(self, now_s: float) -> str:
        """Look at it, now and then; return why it counts as stuck, '' while it may go on."""
        passed_s, self._now_s = now_s - self._now_s, now_s
        seen_s = self._read(self._seen_s)
        used_s, self._seen_s = seen_s - self._seen_s, seen_s
        self._used_s += used_s
        if used_s < 1e-3 and self._state(self._pid) not in "RD":  # neither waits for a processor nor for a disk
            self._asleep_s += passed_s
        if self._used_s > self._limit_s:
            return f"it has used {self._used_s:.0f} s of processor time and is not done"
        if self._asleep_s > self._limit_s:
            return f"it has waited for something else for {self._asleep_s:.0f} s"
        return ""

    def _read(self, otherwise: float) -> float:
        try:
            return self._processor_s(self._pid)
        except OSError:
            return otherwise


def _processor_s(pid: int) -> float:
    return time.clock_gettime((~pid << 3) | 2)  # clock_getcpuclockid(3)


def _state(pid: int) -> str:
    try:
        with open(f"/proc/{pid}/stat", encoding="ascii", errors="replace") as file:
            return file.read().rpartition(") ")[2][:1]
    except OSError:
        return "S"
