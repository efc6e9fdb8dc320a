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

from sioms.descriptors import is_exiting
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
from .rt import ChangeWatch, settle
from .statistics import Reports, TickStatistics
from .stops import Reason, Stop, Stops
from .tick_engine import TickEngine
from .ticking import Ticking

STOP_GRACE_NS = 2_000_000_000
"""How long axes may take to stop before the process ends all the same."""
SETTLE_NS = 20_000_000
"""An axis whose loop is closed here follows its command by so much; only then is the loop given up."""
FAIL_GRACE_NS = 500_000_000
"""How long a failed driver's line may take to send the stops."""


class Runtime(Ticking):
    """A driver process, or its part for one device; the driver sees it as its ``Kit``.

    Concurrency: one thread.
    """

    def __init__(
        self, driver: type[Driver], device: str, settings: Any, generation: int, options: Mapping[str, Any],
        fds: Sequence[int],
    ) -> None:  # fmt: skip
        super().__init__()
        self.device = device
        self.running = True
        self.journal = JournalWriter(memoryview(mmap.mmap(fds[6], HEADER + JOURNAL_SIZE)))
        self.effects = Effects()
        self.waits = Waits(self.effects, self.journal, self.log)
        self.outputs = Outputs()
        self.statistics = TickStatistics()
        self._control = Control(fds[0], self._watch_room)
        self.tell = self._control.tell
        latch = mmap.mmap(fds[1], LATCH_SIZE, prot=mmap.PROT_READ)  # the daemon alone writes it
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
        self._stopped = options["stopped"]
        self._phase = float(options["phase"])
        self._daemon_lease_ns = int(float(options["daemon_lease_s"]) * 1e9)
        self._moved_ns = 0
        self.driver = driver.variant(settings)(device, settings, self)
        self.blocks = list(self.driver.blocks)
        self._kept = keep_positions(str(options["state_folder"]), device, self.blocks, self.log)
        self._keep_ns = lease_ns // 4
        self.pages = Pages(device, self.blocks, lease_ns, generation, self._link_changed)
        handles: dict[int, Handle] = {}
        self.stops = Stops(
            device, self.blocks, self.outputs, self.effects, self.waits, self.pages, handles, self.log, self.tell,
            self.latch, int(options["resets"]), request, StopJournal(fds[5]), options["stop_sources"], self.journal,
        )  # fmt: skip
        self.pages.before = self.waits.before = self.stops.before_telling
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
        self.sees_requests = False
        self.busy = np.zeros(1, dtype=np.int64)
        self._quiet = None

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
            self.blocks, self.clients, self.stops, self.pages, self._request_fd, self.turns.gives_way, self.period_ns,
            self.busy,
        )  # fmt: skip
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

    def exiting(self, ready: Iterable[int]) -> int:
        """Return the process of an owner whose end descriptors tell, as ``losses``, if all of it is about to end; 0: it
        is not, or that is not to be seen.
        """
        owners = (self.clients.gone(fd) for fd in ready)
        return next((owner.pid for owner in owners if owner is not None and is_exiting(owner.pid)), 0)

    def losses_of(self, pid: int) -> list[Callable[[], None]]:
        """Return what is to be done first about a process that is about to end, as ``losses``."""
        return [partial(self.clients.drop, handle) for handle in self.clients.of_process(pid)]

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
        if self._quiet is not None:
            self._quiet.desk.close()
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

    def heed(self) -> None:
        """Heed the daemon's orders, then the latch and the stop-request file; cheap when there is nothing new."""
        if self.stops.heed_orders():
            for order in self._control.orders():
                self._wake()
                self._orders.obey(order, [])
        self.stops.heed()

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
