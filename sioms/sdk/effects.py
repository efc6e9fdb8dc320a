"""When what somebody asked for took effect, and which publication shows it
(docs/decisions/0090-read-your-own-writes.md).

Concurrency: the one thread of a driver process. No request is served in the middle of a tick, so a tick that
begins after an effect shows the whole of it.
"""

from __future__ import annotations

import time


class Effects:
    """The instant of the last effect: of a request, a stop, a fault.

    Attributes:
        last_ns: no later effect is known [ns, CLOCK_MONOTONIC]; every answer to a client carries it.
    """

    __slots__ = ("last_ns",)

    def __init__(self) -> None:
        self.last_ns = 0

    def note(self) -> None:
        """Note that what readings show changes now."""
        self.last_ns = time.monotonic_ns()
