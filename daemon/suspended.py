"""Clients whose processes are stopped, as by Ctrl-Z, or frozen, as by ``systemctl freeze`` or ``docker pause``: they
control nothing, and cannot say so.
"""

from __future__ import annotations

from collections.abc import Iterable

LOOK_S = 0.1
_STOPPED = b"T"
_FREEZERS = (
    (b"", "/sys/fs/cgroup", "cgroup.events", b"frozen 1"),
    (b"", "/sys/fs/cgroup/unified", "cgroup.events", b"frozen 1"),
    (b"freezer", "/sys/fs/cgroup/freezer", "freezer.state", b"FROZEN"),
)
"""Hierarchies of control groups: name in /proc/PID/cgroup, where they are as a rule, which file tells of being frozen
(by a group above, too), and what it says then.
"""


def is_stopped(pid: int) -> bool:
    """Tell whether a process is stopped by a signal; one that may not be looked at is not."""
    return _read(f"/proc/{pid}/stat").rpartition(b") ")[2][:1] == _STOPPED


def is_frozen(pid: int, known: dict[str, bool]) -> bool:
    """Tell whether a process is frozen by its control group; one that may not be looked at is not.

    Args:
        pid: of the process.
        known: what has been found out about groups in this look.
    """
    found = False
    for line in _read(f"/proc/{pid}/cgroup").splitlines():
        _, _, rest = line.partition(b":")
        names, _, place = rest.partition(b":")
        for name, root, file, words in _FREEZERS:
            if name not in names.split(b","):
                continue
            path = f"{root}{place.decode('utf-8', 'replace')}/{file}"
            if path not in known:
                known[path] = words in _read(path)
            found |= known[path]
    return found


def _read(path: str) -> bytes:
    try:
        with open(path, "rb") as file:
            return file.read(4096)
    except (OSError, ValueError):
        return b""


class Suspended:
    """Which processes are stopped, and have been for a while: a shell may stop one for a moment only."""

    def __init__(self) -> None:
        self._before: set[int] = set()

    def look(self, pids: Iterable[int]) -> set[int]:
        """Return those of some processes that are stopped or frozen, and were so at the last look."""
        known: dict[str, bool] = {}
        now = {pid for pid in set(pids) if pid > 0 and (is_stopped(pid) or is_frozen(pid, known))}
        lasting, self._before = now & self._before, now
        return lasting
