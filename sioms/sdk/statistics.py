"""Where the time of a tick goes: the figures behind table F.7 of the dissertation, always on."""

from __future__ import annotations

from collections.abc import Sequence

PHASES = ("late_ns", "driver_ns", "publish_ns", "total_ns")
_SIZE = 8192


class TickStatistics:
    """A ring of the last ticks' times. Recording costs about a microsecond.

    Attributes:
        ticks: ticks done.
        skipped: ticks that never ran because the ones before took too long.
        longest_ns: longest total.
    """

    def __init__(self) -> None:
        self._ring = [[0] * _SIZE for _ in PHASES]
        self.ticks = 0
        self.skipped = 0
        self.longest_ns = 0

    def record(self, late_ns: int, driver_ns: int, publish_ns: int, total_ns: int) -> None:
        """Note one tick."""
        i = self.ticks & (_SIZE - 1)
        ring = self._ring
        ring[0][i] = late_ns
        ring[1][i] = driver_ns
        ring[2][i] = publish_ns
        ring[3][i] = total_ns
        self.ticks += 1
        if total_ns > self.longest_ns:
            self.longest_ns = total_ns

    def summary(self, percentiles: Sequence[float] = (50.0, 99.0, 99.9, 100.0)) -> dict[str, object]:
        """Return counts, and percentiles of each phase over the last ticks [ns]."""
        n = min(self.ticks, _SIZE)
        result: dict[str, object] = {
            "ticks": self.ticks,
            "skipped": self.skipped,
            "longest_ns": self.longest_ns,
        }
        for phase, ring in zip(PHASES, self._ring, strict=True):
            values = sorted(ring[:n])
            result[phase] = {str(p): values[min(n - 1, int(n * p / 100))] for p in percentiles} if n else {}
        return result
