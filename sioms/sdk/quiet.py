"""Lets a driver process go on by compiled steps while nothing but motion happens: quiet_step.py and its conditions.

Concurrency: the one thread of the driver process.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from sioms.native.language import library
from sioms.native.system import MOST_EVENTS

from .driver import Driver, QuietSteps, TickDriver
from .quiet_step import Quiet, run
from .statistics import TickStatistics

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from .attachments import Attachments
    from .handles import Waits
    from .pages import Pages
    from .stops import Stops


class QuietRun:
    """Waits, and ticks by steps.

    Args:
        steps: the driver's.
        poll, timer: descriptors of the loop's epoll and of its timer.
        latch: words of the latch page.
        period_ns: of the tick.
        daemon_lease_ns: how long the daemon may be silent.
        instants: of a tick, as its step notes them.
        pages, stops, waits, clients, statistics: parts of the process.

    Attributes:
        record: after ``wait``: ``done`` ticks, ``expired`` when the timer has been read and the tick is the loop's,
            ``slackens`` when the slack of the last tick is.
    """

    def __init__(
        self, steps: QuietSteps, poll: int, timer: int, latch: NDArray[np.int64], period_ns: int, daemon_lease_ns: int,
        instants: NDArray[np.int64], pages: Pages, stops: Stops, waits: Waits, clients: Attachments,
        statistics: TickStatistics,
    ) -> None:  # fmt: skip
        self._steps, self._pages, self._stops, self._waits = steps, pages, stops, waits
        self._clients, self._statistics = clients, statistics
        self._ready = np.zeros(MOST_EVENTS, dtype=np.int64)
        self.record = Quiet(
            poll=poll, timer=timer, ready=self._ready, latch=latch, stopped=0, resets=0, orders=0,
            daemon_lease_ns=daemon_lease_ns, until_ns=0, period_ns=period_ns, device=steps.record, tick=steps.tick,
            slack=steps.slack, instants=instants, scheduled_ns=0, began_ns=0, number=0, done=0, expired=0, slackens=0,
            ring=statistics.ring.reshape(-1), ticks=0, longest_ns=0,
        )  # fmt: skip

    def wait(self, scheduled_ns: int, number: int) -> list[int] | None:
        """Wait for events, and tick meanwhile.

        Args:
            scheduled_ns, number: of the last tick.

        Returns:
            descriptors that are ready; None, and nothing has been waited for, when the loop has to tick.
        """
        record, statistics = self.record, self._statistics
        until_ns = self._waits.until_ns()
        if not until_ns or not self._steps.is_ready() or not self._pages.lend():
            return None
        record.until_ns = min(until_ns, self._clients.until_ns())
        record.stopped, record.resets, record.orders = self._stops.seen
        record.scheduled_ns, record.number = scheduled_ns, number
        record.ticks, record.longest_ns = statistics.ticks, statistics.longest_ns
        count = run(record)
        statistics.ticks, statistics.longest_ns = record.ticks, record.longest_ns
        self._pages.take_back()
        self._steps.resume()
        ready: list[int] = self._ready[:count].tolist()
        return ready


def quiet_run(
    driver: Driver, poll: int, timer: int, latch: NDArray[np.int64], period_ns: int, daemon_lease_ns: int, pages: Pages,
    stops: Stops, waits: Waits, clients: Attachments, statistics: TickStatistics,
) -> QuietRun | None:  # fmt: skip
    """Return what ticks by compiled steps, see QuietRun; None for a driver that has none, or without a library."""
    if library is None or not isinstance(driver, TickDriver) or any(block.spec.writable for block in driver.blocks):
        return None
    instants = np.zeros(2, dtype=np.int64)
    steps = driver.quiet_steps(pages, instants)
    return None if steps is None else QuietRun(
        steps, poll, timer, latch, period_ns, daemon_lease_ns, instants, pages, stops, waits, clients, statistics,
    )  # fmt: skip
