"""When a dead driver is started again. Pure.

One restart at once in any five seconds; a driver that dies again within them waits with growing
pauses, and after the fifth death within a minute the device is in fault until somebody resets it.
Motion never resumes by itself after a restart.
"""

from __future__ import annotations

from dataclasses import dataclass, field

WINDOW_NS = 60_000_000_000
QUIET_NS = 5_000_000_000
LIMIT = 5
FIRST_PAUSE_NS = 250_000_000
TOO_OFTEN = f"{LIMIT} deaths within a minute"


@dataclass(slots=True)
class Restarts:
    """The deaths of one driver."""

    deaths_ns: list[int] = field(default_factory=list)

    def died(self, now_ns: int) -> int | None:
        """Note a death.

        Returns:
            When to start again [ns], or None: too often, the device is in fault.
        """
        self.deaths_ns = [t for t in self.deaths_ns if now_ns - t < WINDOW_NS]
        recent = sum(now_ns - t < QUIET_NS for t in self.deaths_ns)
        self.deaths_ns.append(now_ns)
        if len(self.deaths_ns) >= LIMIT:
            return None
        return now_ns if recent == 0 else now_ns + (FIRST_PAUSE_NS << (recent - 1))

    def forget(self) -> None:
        """Start with a clean record (after a reset)."""
        self.deaths_ns.clear()
