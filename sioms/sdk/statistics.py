"""Where the time of a tick goes: the figures behind table F.7 of the dissertation, always on."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence

import numpy as np

from .driver import Driver
from .engine import Engine
from .handles import Handle
from .quiet_step import RING

PHASES = ("late_ns", "input_ns", "control_ns", "publish_ns", "busy_ns", "total_ns", "spent_ns")
"""Scheduled to begun; to the readings being there; to the outputs being set; to all being published; all from begun;
all from scheduled; all from begun, with what is done in the slack between two ticks."""
_SIZE = RING
REPORT_NS = 20_000_000
"""How old statistics may be that are told: to sort them takes longer than anything else a reader can ask for."""


class TickStatistics:
    """A ring of the last ticks' times. Recording costs about half a microsecond.

    Attributes:
        ticks: ticks done.
        skipped: ticks that never ran because the ones before took too long.
        longest_ns: longest total.
        ring: times of the last ticks, (phases, kept ticks) [ns].
    """

    def __init__(self) -> None:
        self.ring = np.zeros((len(PHASES), _SIZE), dtype=np.int64)
        self._ring = [phase.data for phase in self.ring]  # quicker for single numbers
        self.ticks = 0
        self.skipped = 0
        self.longest_ns = 0

    def record(self, scheduled_ns: int, began_ns: int, inputs_ns: int, ticked_ns: int, ended_ns: int) -> None:
        """Note one tick by its instants; ``inputs_ns`` before ``began_ns`` means that it is not known."""
        if inputs_ns < began_ns:
            inputs_ns = began_ns
        total_ns = ended_ns - scheduled_ns
        i = self.ticks & (_SIZE - 1)
        ring = self._ring
        ring[0][i] = began_ns - scheduled_ns
        ring[1][i] = inputs_ns - began_ns
        ring[2][i] = ticked_ns - inputs_ns
        ring[3][i] = ended_ns - ticked_ns
        ring[4][i] = ended_ns - began_ns
        ring[5][i] = total_ns
        ring[6][i] = ended_ns - began_ns
        self.ticks += 1
        if total_ns > self.longest_ns:
            self.longest_ns = total_ns

    def record_slack(self, slack_ns: int) -> None:
        """Note what was done in the slack before or after the tick that was recorded last."""
        self._ring[6][(self.ticks - 1) & (_SIZE - 1)] += slack_ns

    def summary(
        self, last: int = _SIZE, percentiles: Sequence[float] = (50.0, 90.0, 99.0, 99.9, 100.0)
    ) -> dict[str, object]:
        """Return counts, and percentiles of each phase [ns].

        Args:
            last: over so many of the last ticks, as far as they are kept.
            percentiles: which ones.
        """
        n = min(self.ticks, _SIZE, last)
        newest = self.ticks & (_SIZE - 1)
        result: dict[str, object] = {
            "ticks": self.ticks,
            "skipped": self.skipped,
            "longest_ns": self.longest_ns,
        }
        chosen = np.arange(newest - n, newest)
        for phase, kept in zip(PHASES, self.ring, strict=True):
            # By numpy: sorting thousands of Python numbers takes longer than axes may go without a tick.
            ranks = [min(n - 1, int(n * p / 100)) for p in percentiles]
            values = np.partition(np.take(kept, chosen, mode="wrap"), ranks) if n else kept
            result[phase] = {str(p): int(values[rank]) for p, rank in zip(percentiles, ranks, strict=True) if n}
        return result


class Reports:
    """What GET_STATISTICS tells.

    Args:
        statistics: of the ticks.
        engine, driver: whose counters are told, too.
        handles: of the process.
    """

    def __init__(
        self, statistics: TickStatistics, engine: Engine, driver: Driver, handles: Mapping[int, Handle]
    ) -> None:
        self._statistics, self._engine, self._driver, self._handles = statistics, engine, driver, handles
        self._summaries: dict[int, tuple[int, dict[str, object]]] = {}
        self._summed_ns: dict[int, int] = {}

    def __call__(self, uid: int, last: int, *, fresh: bool) -> dict[str, object] | None:
        """Return what GET_STATISTICS tells: times of the last ticks, link counters, handles.

        Args:
            uid: who asks; times are sorted once in REPORT_NS for each user.
            last: over so many ticks.
            fresh: whether they may be sorted now; None is returned when it is not, or he has had his turn.
        """
        now_ns = time.monotonic_ns()
        self._summaries = {n: kept for n, kept in self._summaries.items() if now_ns - kept[0] < REPORT_NS}
        if last not in self._summaries:
            if not fresh or now_ns - self._summed_ns.get(uid, -REPORT_NS) < REPORT_NS:
                return None
            self._summed_ns[uid] = now_ns
            self._summaries[last] = (now_ns, self._statistics.summary(last))
        report = dict(self._summaries[last][1])
        report["tick_hz"] = self._engine.tick_hz
        report["handles"] = len(self._handles)
        counters = getattr(self._engine, "counters", None)
        if counters is not None:
            report["link"] = {name: getattr(counters, name) for name in counters.__struct_fields__}
        if counters := self._driver.counters():
            report["stream"] = dict(counters)
        return report
