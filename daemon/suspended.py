"""Clients whose processes are stopped, as by Ctrl-Z: they control nothing, and cannot say so."""

from __future__ import annotations

from collections.abc import Iterable

LOOK_S = 0.1
_STOPPED = b"T"


def is_stopped(pid: int) -> bool:
    """Tell whether a process is stopped by a signal; one that may not be looked at is not."""
    try:
        with open(f"/proc/{pid}/stat", "rb") as file:
            return file.read(512).rpartition(b") ")[2][:1] == _STOPPED
    except OSError:
        return False


class Suspended:
    """Which processes are stopped, and have been for a while: a shell may stop one for a moment only."""

    def __init__(self) -> None:
        self._before: set[int] = set()

    def look(self, pids: Iterable[int]) -> set[int]:
        """Return those of some processes that are stopped, and were so at the last look."""
        now = {pid for pid in set(pids) if pid > 0 and is_stopped(pid)}
        lasting, self._before = now & self._before, now
        return lasting
