"""The driver process: its tick, its clients, its pages, its stops.

One thread and one epoll: the tick comes from a timer descriptor, so a client's write is served at
once and not with the next tick. Whatever goes wrong ends in stopped motion: the client's end of
file or death, its silence beyond its lease, the daemon's end of file or silence, the emergency-stop
latch, an exception of the driver itself.
"""

from __future__ import annotations

import errno
import mmap
import os
import select
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from functools import partial
from typing import Any

import numpy as np

from sioms.protocol import driver_verbs
from sioms.protocol.flags import PageState
from sioms.protocol.journal import HEADER, JOURNAL_SIZE, JournalWriter, Note
from sioms.protocol.latch import LATCH_SIZE, Latch
from sioms.protocol.markers import TABLE_SIZE, MarkerTable
from sioms.protocol.stopfile import StopRequest
from sioms.protocol.stopjournal import StopJournal
from sioms.protocol.text import printable
from sioms.turns import Turns

from .alarm_watch import AlarmWatch
from .attachments import SHARES, Attachments
from .blocks import AnyBlock, AxisBlock
from .control import Control
from .desk import WriteDesk
from .driver import AtLimitError, Driver
from .effects import Effects
from .engines import make_engine
from .exchange import HookError
from .failing import TRIES, fail, free_reserve
from .handles import LOOKS_A_MS, Handle, Waits
from .held import Held
from .idling import Idling
from .inputs import Input
from .markers import Markers
from .orders import Orders
from .outputs import Outputs
from .pages import Pages
from .parts import Parts, Service
from .persistence import keep_positions
from .quiet import QuietRun, quiet_run
from .quiet_step import RESTED, STIRS, Quiet
from .rt import ChangeWatch, TimerFd, settle
from .statistics import Reports, TickStatistics
from .stops import Reason, Stop, Stops
from .tick_engine import TickEngine

STOP_GRACE_NS = 2_000_000_000
"""How long axes may take to stop before the process ends all the same."""
SETTLE_NS = 20_000_000
"""An axis whose loop is closed here follows its command by so much; only then is the loop given up."""
FAIL_GRACE_NS = 500_000_000
"""How long a failed driver's line may take to send the stops."""
SURE = 4
"""One tick in so many leaves time for clients' work however long it took."""


class Runtime:
    """A driver process, or its part for one device; the driver sees it as its ``Kit``.

    Concurrency: one thread.
    """

    def __init__(
        self, driver: type[Driver], device: str, settings: Any, generation: int, options: Mapping[str, Any],
        fds: Sequence[int],
    ) -> None:  # fmt: skip
        self.device = device
        self.tick = 0
        self.running = True
        self.journal = JournalWriter(memoryview(mmap.mmap(fds[6], HEADER + JOURNAL_SIZE)))
        self.effects = Effects()
        self.waits = Waits(self.effects, self.journal, self.log)
        self.looked_ns = 0
        self.outputs = Outputs()
        self.statistics = TickStatistics()
        self._control = Control(fds[0], self._watch_room)
        self.tell = self._control.tell
        latch = mmap.mmap(fds[1], LATCH_SIZE)
        self.latch, self._latch_words = Latch(memoryview(latch)), np.frombuffer(latch, dtype=np.int64, count=8)
        request, self._request_fd = StopRequest(fds[2], fds[3]), fds[2]
        table = MarkerTable(memoryview(mmap.mmap(fds[4], TABLE_SIZE)))
        self.markers = Markers(table, lambda number: self.tell(driver_verbs.MarkerSignalled(number)))
        description = driver.describe(device, settings)
        self.inputs: dict[str, Input] = {name: Input(name) for name in description.reads}
        lease_ns = int(float(options.get("lease_s") or description.lease_s) * 1e9)
        self.held: dict[str, Held] = {
            name: Held(name, lease_ns, self.now_ns, self.tell, partial(self._watch_held, name), self.unwatch)
            for name in description.holds
        }
        self._description = description
        self._epoll = select.epoll()
        self._callbacks: dict[int, Callable[[], None]] = {}
        self.turns = Turns(self._epoll, SHARES)
        self._timer = TimerFd()
        self._line_timer = TimerFd()
        self._line_due_ns: int | None = None
        self._stopped = options["stopped"]
        self._phase = float(options["phase"])
        self._daemon_lease_ns = int(float(options["daemon_lease_s"]) * 1e9)
        self._daemon_late = False
        self._ending_ns = 0
        self._moved_ns = 0
        self._is_ticking = False
        """Whether there is yet to be a tick of what is heeded now."""
        self._ticked_ns = 0
        self._brakes = False
        """Whether steps have begun the stop that is being heeded."""
        self._braked_ns = 0
        """When something was stopped last [ns]."""
        self.driver = driver.variant(settings)(device, settings, self)
        self.blocks = list(self.driver.blocks)
        self._kept = keep_positions(str(options["state_folder"]), device, self.blocks, self.log)
        self._keep_ns, self._kept_ns = lease_ns // 4, 0
        self.pages = Pages(device, self.blocks, lease_ns, generation, self._link_changed)
        handles: dict[int, Handle] = {}
        self.stops = Stops(
            device, self.blocks, self.outputs, self.effects, self.waits, self.pages, handles, self.log, self.tell,
            self.latch, int(options["resets"]), request, StopJournal(fds[5]), options["stop_sources"], self.journal,
        )  # fmt: skip
        self.pages.before = self.stops.note_faults
        self.alarms = AlarmWatch(self.blocks, options["alarms"], self.tell, self.stops.stop_by_alarm)
        self.pages.watch = self.alarms.look if options["alarms"] else None
        parts = Parts(self, self.blocks, self.outputs, self.effects, self.waits, self.pages, self.stops, self.log)
        self.engine = self.stops.engine = make_engine(parts, self.driver, self._description.tick_hz)
        service = Service(
            self, self.blocks, self.outputs, self.effects, self.waits, self.pages, self.stops, self.log,
            self.driver, self.engine, Reports(self.statistics, self.engine, self.driver, handles),
        )  # fmt: skip
        self.clients = Attachments(handles, service, self.turns, self.tell, self.journal)
        self._orders = Orders(
            self.blocks, self.clients, self.stops, self.inputs, self.held, self.latch, self.log, self.end,
            self._stop_held,
        )  # fmt: skip
        self.period_ns = int(1e9 / self.engine.tick_hz)
        self.waits.a_look = max(LOOKS_A_MS, LOOKS_A_MS * self.period_ns // 1_000_000)
        self._idling = Idling(self.period_ns, lease_ns)
        self._stops_workcell = bool(options["stop_sources"])
        self._lead_ns = self.engine.lead_ns if isinstance(self.engine, TickEngine) else 0
        self._announced = self._slack_ns = self._spare_until_ns = 0
        self._expired, self.sees_requests = 0, False
        self._quiet: QuietRun | None = None

    # --- services to the driver (Kit) ------------------------------------------------------------

    def log(self, level: str, text: str) -> None:
        """Write a line to the daemon's log."""
        self.tell(driver_verbs.LogLine(level, printable(text.replace("\n", " "), 1000)))

    def emergency_stop(self, source: str) -> None:
        """Stop the whole workcell."""
        self.stops.stop_workcell(source)

    def publish(self, block: AnyBlock, stamp_ns: int) -> None:
        """Publish a block and wake who subscribed to it."""
        self.pages.publish(block, stamp_ns, self.tick, self.engine.as_of_ns(block, stamp_ns))

    # --- what parts know of the loop (engine.Loop) -----------------------------------------------

    def now_ns(self) -> int:
        """Return the time [ns, CLOCK_MONOTONIC]."""
        return time.monotonic_ns()

    def as_of_ns(self) -> int:
        """Return an instant before which all that was asked for has been heeded: now, unless there is something new."""
        now_ns = time.monotonic_ns()  # first: what comes after the look may have come before a later instant
        return now_ns if self.stops.is_up_to_date else self.looked_ns

    def deadline(self, timeout_s: float | None) -> int | None:
        """Return when a time-out that begins now ends [ns]."""
        return None if timeout_s is None else time.monotonic_ns() + int(min(max(timeout_s, 0.0), 1e6) * 1e9)

    def has_time(self) -> bool:
        """Whether what can be done in pieces may do another before the next tick."""
        return time.monotonic_ns() < self._spare_until_ns

    def watch(self, fd: int, callback: Callable[[], None]) -> None:
        """Call back when a descriptor is readable or hung up."""
        self._callbacks[fd] = callback
        self._epoll.register(fd, select.EPOLLIN)

    def unwatch(self, fd: int) -> None:
        """Stop watching; call before closing."""
        if self._callbacks.pop(fd, None) is not None:
            self._epoll.unregister(fd)

    def _watch_held(self, name: str, fd: int) -> None:
        """Hear what is held where ticks are seldom; frequent ones hear it as soon, and then each answer costs none."""
        if self._lead_ns:
            self.watch(fd, partial(self._hear_held, name))

    def _hear_held(self, name: str) -> None:
        """Take answers; when one axis of a device made of devices is lost or stopped, the others are stopped at once.

        A node that was stopped at its own limit leaves the others to a tick, which brakes them together.
        """
        trouble = self.held[name].hear()
        if trouble is None:
            return
        if isinstance(trouble, AtLimitError):
            self.tick_early()
        else:
            self._stop_held()

    def _stop_held(self) -> None:
        """Stop all that is held, and have a tick that says why."""
        for held in self.held.values():
            held.stop()
        self._wake()
        self.tick_early()

    def set_line_timer(self, when_ns: int | None) -> None:
        """Have the engine's ``line_due`` called at a time, None = not; of a TickEngine, an early tick."""
        if when_ns != self._line_due_ns:  # most bytes that come change nothing about it
            self._line_due_ns = when_ns
            self._line_timer.set(0 if when_ns is None else max(when_ns, 1))

    def _link_changed(self, blocks: Sequence[AnyBlock], state: PageState, reason: str) -> None:
        self.journal.note(Note.LINK, time.monotonic_ns(), state.name, printable(reason))
        self.tell(driver_verbs.LinkChanged(int(state), printable(reason)))
        self.alarms.lose(blocks, state, printable(reason))

    def after_publication(self, now_ns: int, shown: Sequence[AnyBlock]) -> None:
        """Look at what a publication of some blocks may have brought about."""
        self.stops.take_events()
        self.waits.check(now_ns, shown)
        self.stops.look_at_inputs()
        self.alarms.react()

    # --- life ------------------------------------------------------------------------------------

    def run(self, priority: int, user: str) -> int:
        """Tick until told to end; return the exit status."""
        self._watch_requests()  # before that user may not look at it any more
        settle(priority, user, self.log)
        try:
            self.start()
            self._loop()
        except Exception as error:  # any failure of a driver: stop first, report second
            self.fail(error)
            return 1
        return 0

    def start(self) -> None:
        """Be stopped as the process before this one was, tick for the first time, and tell the daemon."""
        self.watch(self._control.fileno(), self._control_readable)
        self._watch_room(self._control.waits_for_room)  # a driver may have told much while it was opened
        self.watch(self._timer.fd, self._on_timer)
        self.watch(self._line_timer.fd, self._on_line_timer)
        self.watch(self.clients.timestamps.fd, self.clients.timestamps.look_at_clock)
        phase_ns = int(self._phase * self.period_ns)
        self._scheduled_ns = (time.monotonic_ns() - phase_ns) // self.period_ns * self.period_ns + phase_ns
        self._timer.set(self._scheduled_ns + 2 * self.period_ns - self._lead_ns, self.period_ns)
        self.turns.gives_way = os.sched_getscheduler(0) == os.SCHED_FIFO
        self.looked_ns = time.monotonic_ns()
        self.stops.restore(self._stopped)
        self.stops.look()
        self._tick_and_publish(self._scheduled_ns)  # who opens a node at once finds readings
        self._scheduled_ns += self.period_ns
        self._quiet = self._make_quiet()
        self._tell_ready()

    def _make_quiet(self) -> QuietRun | None:
        """Return what ticks by compiled steps; None where a tick has to look at more than they do."""
        if self._stops_workcell or self.pages.watch or not self.sees_requests:
            return None
        desk = WriteDesk(
            self.blocks, self.clients, self.stops, self.pages, self._request_fd, self.turns.gives_way, self.period_ns
        )
        return quiet_run(
            self.driver, self._epoll.fileno(), self._timer.fd, self._line_timer.fd, self._control.fileno(),
            self._latch_words, self.period_ns, self._lead_ns, self._daemon_lease_ns, self._idling, self.pages,
            self.stops, self.waits, self.clients, self.statistics, desk,
        )  # fmt: skip

    def _watch_requests(self) -> None:
        """Wake up when somebody asks for a stop; a tick would see it, too, but later."""
        try:
            watch = ChangeWatch(self._request_fd)
        except OSError as error:
            self.log("debug", f"stops through the stop-request file are seen in ticks: {error.strerror}")
            return

        def asked() -> None:
            watch.drain()
            self.heed_requests()

        self.watch(watch.fd, asked)
        self.sees_requests = True

    @property
    def stopped_ns(self) -> int:
        """Since when the workcell is stopped, by the latch, 0: it is not [ns]."""
        return self.latch.stopped_ns

    def heed_requests(self) -> None:
        """Look at the stop-request file, which has changed."""
        self._wake()
        self.stops.heed()

    def _loop(self) -> None:
        while self.running:
            self.serve(self._wait())

    def serve(self, ready: Iterable[int]) -> None:
        """Do what descriptors that are ready ask for, and serve one request after all that."""
        callbacks, turns = self._callbacks, self.turns
        for fd in ready:
            callback = callbacks.get(fd)
            if callback is not None:
                callback()
            else:
                turns.mark(fd)
        turns.serve()
        if self._control.is_behind:
            self._control_readable()

    def losses(self, ready: Iterable[int]) -> list[Callable[[], None]]:
        """Return what is to be done first about descriptors that tell of the end of the daemon, or of the owner of all
        axes: each of it stops them.
        """
        found: list[Callable[[], None]] = []
        for fd in ready:
            if fd == self._control.fileno() and self._control.has_ended:
                found.append(self._control_readable)
            elif (handle := self.clients.gone(fd)) is not None:
                found.append(partial(self.clients.drop, handle))
        return found

    @property
    def pause_s(self) -> float | None:
        """How long the process may wait at most before ``serve`` has to be called again [s]; None for ever."""
        return 0.0 if self._control.is_behind else self.turns.pause_s

    @property
    def poll_fd(self) -> int:
        """Descriptor that is readable when there is something to serve."""
        return self._epoll.fileno()

    @property
    def timers(self) -> tuple[int, int]:
        """Descriptors of the timers of ticks."""
        return self._timer.fd, self._line_timer.fd

    def ready_but(self, known: Sequence[int]) -> list[int]:
        """Return the descriptors that are ready, without those that are known to be."""
        return [fd for fd, _ in self._epoll.poll(0) if fd not in known]

    def release(self) -> None:
        """Close what is open, when the process goes on with other devices; the daemon hears of it last."""
        self.clients.end_all(errno.EIO, "its driver has ended")
        for held in self.held.values():
            held.detach()
        for kept in self._kept:
            kept.let_go()
        for timer in (self._timer, self._line_timer):
            timer.close()
        self.clients.close()
        self.stops.release()
        self._epoll.close()
        self._control.close()

    def _wait(self) -> list[int]:
        """Wait for events; return the descriptors that are ready."""
        quiet = self.lend()
        if quiet is None:
            return [fd for fd, _ in self._epoll.poll(self.pause_s)]
        quiet.run()
        return self.take_back(quiet)

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

    def tick_early(self) -> None:
        """Have a tick as soon as there can be one: what has been stopped shall not wait for its turn."""
        if self._brakes:  # by steps, which have seen to that
            return
        self._braked_ns = time.monotonic_ns()
        if self._lead_ns and not self._is_ticking and not self._announced:  # the next of frequent ticks comes as soon
            self._tick_soon()

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

    def _spare_until(self, ticked_ns: int) -> int:
        """Return until when pieces of clients' work may begin after a tick [ns].

        The first half of the period holds tick and pieces together, so that what clients have the tick do leaves them
        less; one tick in SURE leaves a quarter in any case, else a tick that is always long would leave them nothing.
        """
        quarter_ns = ticked_ns + self.period_ns // 4
        half_ns = self._scheduled_ns + self.period_ns // 2
        return quarter_ns if self.tick % SURE == 0 else min(quarter_ns, half_ns)

    def _look_around(self, began_ns: int) -> None:
        """Heed what is asked for; what was asked for before ``began_ns`` is done with this tick."""
        self.heed()
        self.looked_ns = began_ns

    def heed(self) -> None:
        """Heed the daemon's orders, then the latch and the stop-request file; cheap when there is nothing new."""
        if self.stops.heed_orders():
            for order in self._control.orders():
                self._wake()
                self._orders.obey(order, [])
        self.stops.heed()

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

    def fail(self, error: Exception) -> None:
        """Stop first, report second: the driver has raised what it should not have."""
        for _ in range(TRIES):
            try:
                free_reserve()
                fail(error, self.stops, self.engine, self._run_line, self.log)
                return
            except MemoryError:
                continue

    def _run_line(self) -> None:
        """Let the line send what is left to send; nothing else runs any more."""
        until_ns = time.monotonic_ns() + FAIL_GRACE_NS
        others = {self._control.fileno(), self._timer.fd}
        while not self.engine.is_quiet() and time.monotonic_ns() < until_ns:
            for fd, _ in self._epoll.poll(0.005):
                callback = self._callbacks.get(fd)
                if callback is not None and fd not in others:
                    with suppress(HookError):  # one failure is being told already
                        callback()

    def end(self, reason: str) -> None:
        """Stop everything, make outputs safe, and let the process end when all is quiet."""
        if self._ending_ns:
            return
        self._ending_ns = time.monotonic_ns()
        self.stops.safe_stop(Reason(Stop.CONTROLLED, reason))
        self.clients.end_all(errno.EIO, reason)
        self._end_reason = reason
        self._closing = False

    def _maybe_end(self, now_ns: int) -> None:
        """Go on ticking until the axes rest, then close the device, then leave."""
        late = now_ns - self._ending_ns > STOP_GRACE_NS
        if not self._closing:
            axes = [b for b in self.blocks if isinstance(b, AxisBlock)]
            if any(not b.bank.is_idle(np.arange(b.n)) for b in axes):
                self._moved_ns = now_ns
            if now_ns - self._moved_ns < SETTLE_NS and not late:
                return
            self.engine.close()
            self._closing = True
        if self.engine.is_quiet() or late:
            for kept in self._kept:
                kept.close()
            self.pages.close(self._end_reason)
            self.running = False

    # --- pages and links -------------------------------------------------------------------------

    def _miss_daemon(self) -> None:
        if self._daemon_late or self._ending_ns:
            return
        self._daemon_late = True
        silent = f"the daemon has been silent for more than {self._daemon_lease_ns / 1e9:g} s"
        self.clients.end_all(errno.ETIMEDOUT, silent, exclusive_only=True)

    # --- the daemon ------------------------------------------------------------------------------

    def _tell_ready(self) -> None:
        self._control.tell_ready(self.pages.fds)
        for fd in self.pages.fds:
            os.close(fd)

    def _watch_room(self, wanted: bool) -> None:
        if self._control.fileno() in self._callbacks:
            self._epoll.modify(self._control.fileno(), select.EPOLLIN | (select.EPOLLOUT if wanted else 0))

    def _control_readable(self) -> None:
        """Obey one message of the daemon; the tick has its turn before the next."""
        self._control.send_rest()
        try:
            received = self._control.take()
        except EOFError:
            self.unwatch(self._control.fileno())
            self.end("the daemon has gone")
            return
        if received is not None:
            self._wake()
            self._orders.obey(*received)
