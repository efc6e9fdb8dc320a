"""Whether somebody supervises the workcell, where ``supervisor_lease_s`` asks for that: a fleet's supervisor, mostly.

Without one the workcell is stopped, and stays so. Nothing resumes when one comes: that takes a reset.

Concurrency: the daemon's loop.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable

    from .loop import Loop, Timer
    from .sessions import Session


class Supervision:
    """Who supervises, and until when.

    Args:
        loop: of the daemon.
        lease_s: tells how long a supervisor may be silent [s], 0 = none is asked for.
        stop: stops the workcell, and says why.
    """

    def __init__(self, loop: Loop, lease_s: Callable[[], float], stop: Callable[[str], None]) -> None:
        self._loop, self._lease_s, self._stop = loop, lease_s, stop
        self._until_ns: dict[Session, int] = {}
        self._timer: Timer | None = None

    @property
    def missing(self) -> bool:
        """Whether a supervisor is asked for and there is none."""
        return self._lease_s() > 0 and not self._until_ns

    def take_up(self) -> None:
        """Stop if the configuration, which may be another one now, asks for a supervisor that is not there."""
        if self.missing:
            self._stop("no supervisor: start `sioms supervise`")

    def renew(self, session: Session, lease_s: float) -> float:
        """Take a session for a supervisor.

        Args:
            session: whose word it is.
            lease_s: how long that holds at most [s].

        Returns:
            How long a supervisor may be silent here [s]; 0 = none is asked for.
        """
        allowed_s = self._lease_s()
        if allowed_s > 0:
            self._until_ns[session] = time.monotonic_ns() + int(min(allowed_s, lease_s) * 1e9)
            self._look_later()
        return allowed_s

    def end_session(self, session: Session) -> None:
        """Forget a session; the last supervisor's end stops the workcell."""
        if self._until_ns.pop(session, None) is not None and self.missing:
            self._stop(f"supervisor {session} has gone")

    def _look_later(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
        self._timer = self._loop.at(min(self._until_ns.values()), self._look) if self._until_ns else None

    def _look(self) -> None:
        now_ns = time.monotonic_ns()
        late = [session for session, until_ns in self._until_ns.items() if until_ns <= now_ns]
        for session in late:
            del self._until_ns[session]
        if late and self.missing:
            self._stop(f"supervisor {late[-1]} was silent for longer than {self._lease_s():g} s")
        self._look_later()
