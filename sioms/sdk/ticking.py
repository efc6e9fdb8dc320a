"""When a driver process ticks: on time, early after a stop, seldom at rest, and by compiled steps while it waits.

docs/decisions/0870-when-a-device-ticks.md

Concurrency: the one thread of the driver process.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from typing import Protocol

from sioms.protocol.latch import Latch

from .attachments import Attachments
from .blocks import AnyBlock
from .driver import Driver
from .engine import Engine
from .held import Held
from .idling import Idling
from .orders import Orders
from .pages import Pages
from .quiet import QuietRun
from .quiet_step import RESTED, STIRS, Quiet
from .rt import TimerFd
from .statistics import TickStatistics
from .tick_engine import TickEngine

SURE = 4
"""One tick in so many leaves time for clients' work however long it took."""


class Process(Protocol):
    """What a tick asks of its process."""

    def heed(self) -> None:
        """Heed what is asked for."""

    def heed_requests(self) -> None:
        """Look at the stop-request file."""

    def publish(self, block: AnyBlock, stamp_ns: int) -> None:
        """Publish a block."""

    def after_publication(self, now_ns: int, shown: Sequence[AnyBlock]) -> None:
        """Look at what a publication of some blocks may have brought about."""

    def _miss_daemon(self) -> None:
        """End what clients own, as the daemon is silent."""

    def _maybe_end(self, now_ns: int) -> None:
        """End, where that is wanted and all is quiet."""


class Ticking(Process):
    """The ticks of a process; ``Runtime`` is one, and makes what they work with.

    Attributes:
        tick: number of the last one.
        looked_ns: all that was asked for before has been heeded [ns].
        period_ns: of ticks at the full rate [ns].
    """

    blocks: Sequence[AnyBlock]
    clients: Attachments
    driver: Driver
    engine: Engine
    held: Mapping[str, Held]
    latch: Latch
    pages: Pages
    statistics: TickStatistics
    _daemon_lease_ns: int
    _idling: Idling
    _keep_ns: int
    _lead_ns: int
    _orders: Orders
    _quiet: QuietRun | None
    _scheduled_ns: int
    _stops_workcell: bool
    period_ns: int

    def __init__(self) -> None:
        self.tick = self.looked_ns = 0
        self._timer, self._line_timer = TimerFd(), TimerFd()
        self._line_due_ns: int | None = None
        self._daemon_late = False
        self._ending_ns = self._kept_ns = 0
        self._is_ticking = False
        """Whether there is yet to be a tick of what is heeded now."""
        self._ticked_ns = 0
        self._brakes = False
        """Whether steps have begun the stop that is being heeded."""
        self._braked_ns = 0
        """When something was stopped last [ns]."""
        self._announced = self._slack_ns = self._spare_until_ns = self._expired = 0

    @property
    def pause_s(self) -> float | None:
        """How long the process may wait at most [s]; None for ever."""
        raise NotImplementedError

    def has_time(self) -> bool:
        """Whether what can be done in pieces may do another before the next tick."""
        return time.monotonic_ns() < self._spare_until_ns

    def lend(self) -> QuietRun | None:
        """Let steps tick while the process waits; return None when they may not, or there are none."""
        early_ns = 0 if self._announced else self._line_due_ns or 0
        if self._quiet is None or self._ending_ns or self._daemon_late or self.pause_s is not None:
            return None
        watched = bool(self.clients.handles) or self._orders.is_used
        lent = self._quiet.lend(
            self._scheduled_ns, self.tick, watched, self._announced, self._slack_ns, early_ns, self._ticked_ns,
            self.looked_ns, self._braked_ns,
        )  # fmt: skip
        return self._quiet if lent else None

    def take_back(self, quiet: QuietRun) -> list[int]:
        """Go on after ``lend``; return the descriptors that are ready."""
        ready = quiet.take_back()
        self._resume(quiet.record)
        quiet.desk.take_back(self.tick)
        if quiet.record.heeded_ns:
            self.heed_requests()
            self._brakes = False
        return ready

    def _resume(self, quiet: Quiet) -> None:
        """Go on behind ticks that have been done by steps."""
        self._expired = quiet.expired
        self._announced, self._slack_ns = quiet.announced, quiet.worked_ns
        due_ns = quiet.scheduled_ns + quiet.announced * self.period_ns if quiet.announced else quiet.early_ns
        self._line_due_ns = due_ns or None
        self._brakes, self._braked_ns = quiet.brakes > 0, quiet.braked_ns
        if not quiet.done:
            return
        self.tick, self.looked_ns = quiet.number, quiet.heeded_ns or quiet.began_ns
        self._scheduled_ns, self._ticked_ns = quiet.scheduled_ns, quiet.ticked_ns
        if quiet.slackens and isinstance(self.engine, TickEngine):
            self.engine.slack(time.monotonic_ns(), self._scheduled_ns + self.period_ns)
        if quiet.told == STIRS:
            self._wake()
        elif quiet.told == RESTED:
            self._be_idle(time.monotonic_ns())
        self._spare_until_ns = self._spare_until(self._scheduled_ns)

    def _on_timer(self) -> None:
        expired, self._expired = self._expired or self._timer.expirations(), 0
        if not expired:
            return
        if self._lead_ns and self._idling.periods == 1 and isinstance(self.engine, TickEngine):
            began_ns = time.monotonic_ns()
            if self._announced and self._scheduled_ns + self._announced * self.period_ns > began_ns:
                return  # see quiet_step.announce
            self._announced += expired
            due_ns = self._scheduled_ns + self._announced * self.period_ns
            self.engine.slack(began_ns, due_ns)
            self._slack_ns = time.monotonic_ns() - began_ns
            self.set_line_timer(due_ns)
        else:
            self._tick_on_time(expired)

    def _on_line_timer(self) -> None:
        self._line_timer.expirations()
        if self._line_due_ns is None or self._line_due_ns > time.monotonic_ns():
            return  # it has been set anew since it expired
        self._line_due_ns = None
        if self._announced:
            self._tick_on_time(self._announced)
        elif isinstance(self.engine, TickEngine):
            self._early_tick()
        else:
            self.engine.line_due()

    def _tick_on_time(self, expired: int) -> None:
        self._announced = 0
        self._is_ticking = True
        try:
            self._usual_tick(expired)
        finally:
            self._is_ticking = False

    def _usual_tick(self, expired: int) -> None:
        periods = self._idling.periods
        self._scheduled_ns += expired * periods * self.period_ns
        self.statistics.skipped += (expired - 1) * periods
        scheduled_ns = self._scheduled_ns
        engine, slack_ns = self.engine, self._slack_ns
        if isinstance(engine, TickEngine):
            self._line_due_ns = None  # an early tick that has not come by now comes with this one
        began_ns = time.monotonic_ns()
        self.tick += 1
        self._look_around(began_ns)
        if began_ns - self.latch.daemon_alive_ns > self._daemon_lease_ns:
            self._miss_daemon()
        elif self._daemon_late:
            self._daemon_late = False
        self.clients.check_leases(began_ns)
        if self.held and began_ns - self._kept_ns > self._keep_ns:
            self._kept_ns = began_ns
            for held in self.held.values():
                held.keep()
        ticked_ns = self._tick_and_publish(scheduled_ns)
        self._spare_until_ns = self._spare_until(ticked_ns)
        self.after_publication(ticked_ns, self.blocks if engine.publishes else ())
        ended_ns = time.monotonic_ns()
        self.statistics.record(scheduled_ns, began_ns, self.driver.inputs_ns, ticked_ns, ended_ns)
        if self._ending_ns:
            self._maybe_end(ended_ns)
        elif isinstance(engine, TickEngine):
            if not self._lead_ns:
                engine.slack(ended_ns, scheduled_ns + self.period_ns)
                slack_ns = time.monotonic_ns() - ended_ns
            self.statistics.record_slack(slack_ns)
            if not self.clients.handles:
                self._rest(engine, ended_ns)

    def _look_around(self, began_ns: int) -> None:
        """Heed what is asked for; what was asked for before ``began_ns`` is done with this tick."""
        self.heed()
        self.looked_ns = began_ns

    def _tick_and_publish(self, scheduled_ns: int) -> int:
        """Return when the tick itself was done."""
        engine = self.engine
        self._ticked_ns = scheduled_ns
        engine.tick(scheduled_ns)
        self._is_ticking = False
        if self._lead_ns and self._braked_ns >= scheduled_ns:  # it does not show in a tick for an instant before
            self._tick_soon()
        ticked_ns = time.monotonic_ns()
        self.pages.alive(ticked_ns)
        if isinstance(engine, TickEngine) and engine.publishes:
            for block in self.blocks:
                self.publish(block, block.stamp_ns or scheduled_ns)
        return ticked_ns

    def _spare_until(self, ticked_ns: int) -> int:
        """Return until when pieces of clients' work may begin after a tick [ns].

        The first half of the period holds tick and pieces together, so that what clients have the tick do leaves them
        less; one tick in SURE leaves a quarter in any case, else a tick that is always long would leave them nothing.
        """
        quarter_ns = ticked_ns + self.period_ns // 4
        half_ns = self._scheduled_ns + self.period_ns // 2
        return quarter_ns if self.tick % SURE == 0 else min(quarter_ns, half_ns)

    def tick_early(self) -> None:
        """Have a tick as soon as there can be one: what has been stopped shall not wait for its turn."""
        if self._brakes:  # by steps, which have seen to that
            return
        self._braked_ns = time.monotonic_ns()
        if self._lead_ns and not self._is_ticking and not self._announced:  # the next of frequent ticks comes as soon
            self._tick_soon()

    def set_line_timer(self, when_ns: int | None) -> None:
        """Have the engine's ``line_due`` called at a time, None = not; of a TickEngine, an early tick."""
        if when_ns != self._line_due_ns:  # most bytes that come change nothing about it
            self._line_due_ns = when_ns
            self._line_timer.set(0 if when_ns is None else max(when_ns, 1))

    def _tick_soon(self) -> None:
        """Have a tick off the grid, unless the next one comes as soon; see ``quiet_step.tick_soon``.

        A loop that is closed here measures velocities over the time between two ticks; a quarter of the usual one is
        the least that it gets.
        """
        early_ns = max(time.monotonic_ns(), self._ticked_ns + self.period_ns // 4)
        if early_ns <= self._last_early_ns:
            self.set_line_timer(early_ns)

    @property
    def _last_early_ns(self) -> int:
        """When a tick off the grid may be at the latest [ns]."""
        return self._scheduled_ns + self.period_ns - self.period_ns // 4

    def _early_tick(self) -> None:
        now_ns = time.monotonic_ns()
        if now_ns > self._last_early_ns:
            return  # see quiet_step.early_tick
        self._is_ticking = True
        try:
            self.tick += 1
            self._look_around(now_ns)
            self.after_publication(self._tick_and_publish(now_ns), self.blocks if self.engine.publishes else ())
        finally:
            self._is_ticking = False

    def _rest(self, engine: TickEngine, now_ns: int) -> None:
        """Tick seldom when nobody looks and nothing has happened for a while."""
        if self._orders.is_used or self._stops_workcell or not engine.is_at_rest():
            self._wake()
        else:
            self._be_idle(now_ns)

    def _be_idle(self, now_ns: int) -> None:
        if self._idling.rest(now_ns):
            idle_ns = self._idling.periods * self.period_ns
            self._beat(self._scheduled_ns + idle_ns, idle_ns)

    def _wake(self) -> None:
        """Tick at the full rate again, beginning now: something has happened, or is going to."""
        now_ns = time.monotonic_ns()
        if not self._idling.wake(now_ns):
            return
        self._scheduled_ns += (now_ns - self._scheduled_ns) // self.period_ns * self.period_ns
        self._beat(self._scheduled_ns + self.period_ns - self._lead_ns, self.period_ns)
        if not self._is_ticking:
            self._tick_soon()

    def _beat(self, first_ns: int, period_ns: int) -> None:
        """Have the timer announce ticks from an instant on. What it has announced before, and has yet to come, is of
        another beat: counted from the new one it would lie ahead for ever.
        """
        self._timer.set(first_ns, period_ns)
        self._expired = self._announced = 0
