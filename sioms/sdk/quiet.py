"""Lets a driver process go on by compiled steps while nothing but motion happens: quiet_step.py and its conditions.

Concurrency: the one thread of the driver process.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from sioms.native.language import library
from sioms.native.system import MOST_EVENTS

from .driver import Driver, QuietSteps, TickDriver
from .idling import Idling
from .quiet_step import Quiet, run
from .statistics import TickStatistics

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from .attachments import Attachments
    from .desk import WriteDesk
    from .handles import Waits
    from .pages import Pages
    from .stops import Stops


class QuietRun:
    """Ticks by steps while the process waits.

    Args:
        steps: the driver's.
        poll, timer, line_timer, control: descriptors of the loop's epoll, of its timers and of the daemon's socket.
        latch: words of the latch page.
        period_ns: of the tick.
        lead_ns: how long before a tick its slack is, 0: after it.
        daemon_lease_ns: how long the daemon may be silent.
        idling: of the process.
        instants: of a tick, as its step notes them.
        pages, stops, waits, clients, statistics: parts of the process.
        desk: where writes come in.

    Attributes:
        record: after ``take_back``: ``done`` ticks, ``expired`` when the timer has been read and the tick is the
            loop's, ``slackens`` when the slack of the last tick is, ``announced`` when the slack of the next one is
            done, and what is ``told``.
    """

    def __init__(
        self, steps: QuietSteps, poll: int, timer: int, line_timer: int, control: int, latch: NDArray[np.int64],
        period_ns: int, lead_ns: int, daemon_lease_ns: int, idling: Idling, instants: NDArray[np.int64],
        pages: Pages, stops: Stops, waits: Waits, clients: Attachments, statistics: TickStatistics,
        desk: WriteDesk,
    ) -> None:  # fmt: skip
        self.desk = desk
        self._idling = idling
        self._steps, self._pages, self._stops, self._waits = steps, pages, stops, waits
        self._clients, self._statistics = clients, statistics
        self._ready = np.zeros(MOST_EVENTS, dtype=np.int64)
        self.record = Quiet(
            poll=poll, timer=timer, line_timer=line_timer, ready=self._ready, latch=latch, is_stopped=0, stopped=0,
            resets=0, ended=0, orders=0, daemon_lease_ns=daemon_lease_ns, until_ns=0, period_ns=period_ns, periods=1,
            lead_ns=lead_ns, announced=0, worked_ns=0, watched=1, rest_ns=idling.rest_ns, restless_ns=0, told=0,
            device=steps.record,
            tick=steps.tick, slack=steps.slack, rest=steps.rest, stop=steps.stop, desk=desk.record,
            request=desk.request, early_ns=0, heeded_ns=0, brakes=0, braked_ns=0, patient=0, known=0, control=control,
            called=0, spare=np.zeros(MOST_EVENTS, dtype=np.int64), instants=instants, scheduled_ns=0, ticked_ns=0,
            began_ns=0, number=0, waiting=0, left=0, done=0, expired=0, slackens=0,
            ring=statistics.ring.reshape(-1), ticks=0, skipped=0, longest_ns=0,
        )  # fmt: skip

    def lend(
        self, scheduled_ns: int, number: int, watched: bool, announced: int = 0, worked_ns: int = 0,
        early_ns: int = 0, ticked_ns: int = 0, looked_ns: int = 0, braked_ns: int = 0,
    ) -> bool:  # fmt: skip
        """Let steps tick from now on, until ``take_back``; return False when the loop has to.

        Args:
            scheduled_ns, number: of the last tick.
            watched: whether somebody looks at the device.
            announced, worked_ns: whether the slack of the next tick is done, and how long that took [ns].
            early_ns: when an early tick is due, 0: none is [ns].
            ticked_ns: when the last tick was, early ones too [ns].
            looked_ns: all that was asked for before has been heeded [ns].
            braked_ns: when something was stopped last [ns].
        """
        record, statistics, idling = self.record, self._statistics, self._idling
        until_ns = self._waits.until_ns()
        if not until_ns or not self._steps.is_ready(watched, self._waits.any) or not self._pages.lend():
            return False
        self.desk.lend()
        record.until_ns = min(until_ns, self._clients.until_ns())
        record.stopped, record.resets, record.ended, record.orders = self._stops.seen
        record.is_stopped = self._stops.stopped
        record.scheduled_ns, record.number = scheduled_ns, number
        record.watched, record.periods, record.restless_ns = watched, idling.periods, idling.restless_ns
        record.announced, record.worked_ns = announced, worked_ns
        record.early_ns, record.ticked_ns, record.began_ns, record.heeded_ns = early_ns, ticked_ns, looked_ns, 0
        record.ticks, record.longest_ns = statistics.ticks, statistics.longest_ns
        record.skipped = statistics.skipped
        record.waiting = record.left = record.done = record.expired = record.slackens = record.told = 0
        record.brakes = record.patient = record.called = 0
        record.braked_ns = braked_ns
        return True

    def run(self) -> None:
        """Wait for events, and tick meanwhile; between ``lend`` and ``take_back``."""
        run(self.record)

    @property
    def ready(self) -> list[int]:
        """Descriptors that are ready for the loop."""
        found: list[int] = self._ready[: self.record.waiting].tolist()
        return found

    def take_back(self) -> list[int]:
        """Go on from where the steps have come; return the descriptors that are ready."""
        record, statistics = self.record, self._statistics
        statistics.ticks, statistics.longest_ns = record.ticks, record.longest_ns
        statistics.skipped = record.skipped
        self._idling.restless_ns = record.restless_ns
        self._pages.take_back()
        self._steps.resume()
        return self.ready


def quiet_run(
    driver: Driver, poll: int, timer: int, line_timer: int, control: int, latch: NDArray[np.int64], period_ns: int,
    lead_ns: int, daemon_lease_ns: int, idling: Idling, pages: Pages, stops: Stops, waits: Waits,
    clients: Attachments, statistics: TickStatistics, desk: WriteDesk,
) -> QuietRun | None:  # fmt: skip
    """Return what ticks by compiled steps, see QuietRun; None for a driver that has none, or without a library."""
    if library is None or not isinstance(driver, TickDriver) or any(block.spec.writable for block in driver.blocks):
        return None
    instants = np.zeros(2, dtype=np.int64)
    steps = driver.quiet_steps(pages, instants)
    return None if steps is None else QuietRun(
        steps, poll, timer, line_timer, control, latch, period_ns, lead_ns, daemon_lease_ns, idling, instants, pages,
        stops, waits, clients, statistics, desk,
    )  # fmt: skip
