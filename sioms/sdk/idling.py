"""At what rate a driver ticks whom nobody looks at, and who is at rest."""

from __future__ import annotations

IDLE_NS = 40_000_000
"""Time between two ticks of an idle device, or the longest multiple of its period below."""
REST_NS = 1_000_000_000
"""How long nothing must have happened before a device is idle."""
LEASES = 4
"""Ticks of an idle device in a reader's lease, at least."""


class Idling:
    """Whether a driver is idle. It becomes so when it has been at rest for REST_NS, and ends being so at once.

    Args:
        period_ns: between two ticks [ns].
        lease_ns: how old its stamp of life may get [ns].

    Attributes:
        periods: how many periods lie between two ticks now.
        restless_ns: when something happened last [ns].
        rest_ns: how long nothing must have happened then [ns]; for ever where periods are long already.
    """

    def __init__(self, period_ns: int, lease_ns: int) -> None:
        self.periods = 1
        self._most = min(IDLE_NS, lease_ns // LEASES) // period_ns
        self.restless_ns = 0
        self.rest_ns = REST_NS if self._most > 1 else 2**62

    def wake(self, now_ns: int) -> bool:
        """Something has happened; return whether it was idle."""
        self.restless_ns = now_ns
        was_idle, self.periods = self.periods > 1, 1
        return was_idle

    def rest(self, now_ns: int) -> bool:
        """Nothing has happened in a tick; return whether it has become idle by that."""
        if self.periods > 1 or now_ns - self.restless_ns < self.rest_ns:
            return False
        self.periods = self._most
        return True
