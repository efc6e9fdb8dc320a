"""How long an overdue answer is waited for: by the state of the process that owes it.

On a machine with too much to do a process that needs a millisecond may get it after ten seconds; it is not hung then.
Nothing of this is loaded, or costs anything, before an answer has taken a second.
"""

from __future__ import annotations

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Callable
    from typing import TypeAlias

    Seen: TypeAlias = tuple[str, int, int]

GRACE_S = 2.0
"""How much longer than its own time-out an answer may take from a process that is stopped or does nothing."""
MOST_S = 30.0
"""The same for a process that works, or waits for a processor [s]."""
LOOK_S = 0.25
_STOPPED = "TtZX"
_GETS_ITS_TURN = "RD"


def look_at(pid: int) -> Seen:
    """Return a process' state as in proc(5), its processor time and its time in the run queue.

    The latter two are only good for telling whether they have changed.

    Raises:
        OSError: it has gone, or is none of those that one may see.
    """
    with open(f"/proc/{pid}/stat", encoding="ascii", errors="replace") as file:
        fields = file.read().rpartition(") ")[2].split()
    try:
        with open(f"/proc/{pid}/schedstat", encoding="ascii") as file:
            used, queued, *_ = file.read().split()
    except OSError:  # a kernel that does not count it
        used = queued = "0"
    # Of all threads, in steps of 10 ms; of the first one, in nanoseconds.
    return fields[0], int(used) + int(fields[11]) + int(fields[12]), int(queued)


class Overdue:
    """A request whose answer is overdue.

    Args:
        pid: the process that owes the answer, 0 when nobody knows: then GRACE_S is all it gets.
        through: one that it waits for, 0: none; whether that gets on counts as well, unless the first is stopped.
        due_s: the moment of its time-out [s, time.monotonic].
        enough: tells whether the answer is not needed any more; it is asked at each look.
        look: as look_at.
    """

    __slots__ = ("_due_s", "_enough", "_look", "_pids", "_progress_s", "_seen")

    def __init__(
        self,
        pid: int,
        due_s: float,
        enough: Callable[[], bool] | None = None,
        look: Callable[[int], Seen] = look_at,
        *,
        through: int = 0,
    ) -> None:
        self._pids = [each for each in (pid, through) if each] if pid else []
        self._due_s = due_s + GRACE_S
        self._progress_s = due_s
        self._enough = enough
        self._look = look
        self._seen: dict[int, Seen] = {}

    def until(self, now_s: float) -> float:
        """Look at the process; return how long to wait before the next look [s, time.monotonic], 0: no longer."""
        if self._enough is not None and self._enough():
            return 0.0
        until_s = max(self._due_s, self._alive_s(now_s) + GRACE_S)
        until_s = min(until_s, self._due_s - GRACE_S + MOST_S)
        if now_s >= until_s:
            return 0.0
        look_s = now_s + LOOK_S
        return min(until_s, look_s if self._enough is not None else max(look_s, self._due_s))

    def _alive_s(self, now_s: float) -> float:
        """Return when they last did something, or could not because others had the processors."""
        alive_s = 0.0
        for pid in self._pids:
            try:
                seen = self._look(pid)
            except (OSError, ValueError, IndexError):
                break
            if seen[0] in _STOPPED:
                break
            before = self._seen.get(pid)
            self._seen[pid] = seen
            if seen[0] in _GETS_ITS_TURN or (before is not None and before[1:] != seen[1:]):
                self._progress_s = now_s
            alive_s = self._progress_s
        return alive_s
