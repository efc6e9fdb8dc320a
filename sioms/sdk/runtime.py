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
import socket
import time
import traceback
from array import array
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from sioms.motion import CommandError, EventKind
from sioms.protocol.flags import Access, PageState, Right
from sioms.protocol.latch import LATCH_SIZE, REQUEST_SIZE, Latch, StopRequest
from sioms.protocol.markers import TABLE_SIZE, MarkerTable
from sioms.protocol.messages import (
    MAX_PACKET,
    MAX_WRITE,
    DriverVerb,
    HandleVerb,
    MalformedMessage,
    decode,
    encode,
)
from sioms.protocol.page import PageWriter, page_size

from .blocks import AnyBlock, AxisBlock, BinaryBlock
from .driver import Driver, LineDriver, StreamDriver, TickDriver
from .engines import Engine, LineEngine, StreamEngine, TickEngine
from .handles import Handle, Waits
from .inputs import Input
from .markers import Markers
from .requests import LATER, ioctl, write
from .rt import TimerFd, become_realtime, name_process
from .statistics import TickStatistics

STOP_GRACE_NS = 2_000_000_000
"""How long axes may take to stop before the process ends all the same."""
PACKETS_A_TURN = 8
PAGE = 4096
_TWO_FDS = socket.CMSG_LEN(2 * 4)


def run(
    driver: type[Driver],
    device: str,
    settings: Any,
    generation: int,
    options: Mapping[str, Any],
    fds: Sequence[int],
) -> int:
    """Be the driver process of a device; returns the exit status when the daemon says so or is gone.

    Args:
        driver: the driver's class.
        device: device name.
        settings: its validated settings.
        generation: number of this process among the device's.
        options: stop_sources, daemon_lease_s, realtime_priority, user, phase of the tick [period].
        fds: control socket, latch page, stop-request page, marker table.
    """
    name_process(f"sioms:{device}")
    runtime = Runtime(driver, device, settings, generation, options, fds)
    return runtime.run(int(options["realtime_priority"]), str(options["user"]))


class Runtime:
    """A driver process; the driver sees it as its ``Kit``.

    Concurrency: one thread.
    """

    def __init__(
        self, driver: type[Driver], device: str, settings: Any, generation: int, options: Mapping[str, Any],
        fds: Sequence[int],
    ) -> None:  # fmt: skip
        self.device = device
        self.tick = 0
        self.running = True
        self.stopped = False
        self.waits = Waits()
        self.outputs: dict[tuple[int, int], float] = {}
        self.statistics = TickStatistics()
        self.line_due: Callable[[], None] = lambda: None
        self._control = socket.socket(fileno=fds[0])
        self._control.setblocking(False)
        self.latch = Latch(memoryview(mmap.mmap(fds[1], LATCH_SIZE)))
        self._request = StopRequest(memoryview(mmap.mmap(fds[2], REQUEST_SIZE)))
        table = MarkerTable(memoryview(mmap.mmap(fds[3], TABLE_SIZE)))
        self.markers = Markers(table, lambda number: self._tell(DriverVerb.MARKER_SIGNALLED, number))
        description = driver.describe(device, settings)
        self.inputs: dict[str, Input] = {name: Input(name) for name in description.inputs}
        self._description = description
        self._generation = generation
        self._epoll = select.epoll()
        self._callbacks: dict[int, Callable[[], None]] = {}
        self._timer = TimerFd()
        self._line_timer = TimerFd()
        self._handles: dict[int, Handle] = {}
        self._leased: list[Handle] = []
        self._links: dict[int, tuple[PageState, str]] = {}
        self._stop_sources = [tuple(source) for source in options["stop_sources"]]
        self._phase = float(options["phase"])
        self._daemon_lease_ns = int(float(options["daemon_lease_s"]) * 1e9)
        self._daemon_late = False
        self._ending_ns = 0
        self.driver = driver(device, settings, self)
        self.blocks = list(self.driver.blocks)
        self._writers = [self._make_page(block) for block in self.blocks]
        self._writer_of = {
            id(block): writer for block, writer in zip(self.blocks, self._writers, strict=True)
        }
        self._subscribers: dict[int, list[Handle]] = {id(block): [] for block in self.blocks}
        self._edges: dict[int, int] = {}
        self.engine = self._make_engine()
        self.period_ns = int(1e9 / self.engine.tick_hz)
        self._seen_stop = (0, self.latch.resets, self._request.word)

    # --- services to the driver (Kit) ------------------------------------------------------------

    def log(self, level: str, text: str) -> None:
        """Write a line to the daemon's log."""
        self._tell(DriverVerb.LOG, level, text[:1000])

    def emergency_stop(self, source: str) -> None:
        """Stop the whole workcell."""
        if self.latch.stop(time.monotonic_ns(), source):
            self._tell(DriverVerb.STOPPED, source)
        self._look_at_latch()

    def publish(self, block: AnyBlock, stamp_ns: int) -> None:
        """Publish a block and wake who subscribed to it."""
        self._writer_of[id(block)].publish(block.payload(), stamp_ns, self.tick)
        subscribers = self._subscribers[id(block)]
        if subscribers:
            self._wake(block, subscribers)

    # --- services to engine and requests ---------------------------------------------------------

    def now_ns(self) -> int:
        """Return the time [ns, CLOCK_MONOTONIC]."""
        return time.monotonic_ns()

    def deadline(self, timeout_s: float | None) -> int | None:
        """Return when a time-out that begins now ends [ns]."""
        return None if timeout_s is None else time.monotonic_ns() + int(min(max(timeout_s, 0.0), 1e6) * 1e9)

    def published(self, block: AnyBlock) -> int:
        """Return the number of a block's newest snapshot."""
        return self._writer_of[id(block)].number

    def watch(self, fd: int, callback: Callable[[], None]) -> None:
        """Call back when a descriptor is readable or hung up."""
        self._callbacks[fd] = callback
        self._epoll.register(fd, select.EPOLLIN)

    def unwatch(self, fd: int) -> None:
        """Stop watching; call before closing."""
        if self._callbacks.pop(fd, None) is not None:
            self._epoll.unregister(fd)

    def set_line_timer(self, when_ns: int | None) -> None:
        """Have ``line_due`` called at a time, None = not."""
        self._line_timer.set(0 if when_ns is None else max(when_ns, 1))

    def set_link(self, blocks: Sequence[AnyBlock], state: PageState, reason: str) -> None:
        """Say how the device behind some blocks is: in their pages, and to the daemon once a change."""
        changed = False
        for block in blocks:
            if self._links.get(id(block)) != (state, reason):
                self._links[id(block)] = (state, reason)
                self._writer_of[id(block)].set_state(state, reason)
                changed = True
        if changed:
            self._tell(DriverVerb.LINK, int(state), reason)

    def is_good(self, blocks: Sequence[AnyBlock]) -> bool:
        """Whether all these blocks have a good link."""
        return all(self._links.get(id(block), (None,))[0] is PageState.GOOD for block in blocks)

    def lose(self, blocks: Sequence[AnyBlock], reason: str) -> None:
        """The device behind some blocks is lost: nothing queued will run, waits end, readers are told."""
        now_ns = time.monotonic_ns()
        for block in blocks:
            if isinstance(block, AxisBlock):
                block.bank.fault(np.arange(block.n), reason, now_ns)
        self.set_link(blocks, PageState.LINK_LOST, reason)
        self._take_events()
        ours = {id(block) for block in blocks}
        self.waits.end_where(lambda w: id(w.handle.block) in ours, errno.EIO, reason)

    def after_publication(self, now_ns: int) -> None:
        """Look at what a publication may have brought about."""
        self._take_events()
        self.waits.check(now_ns)
        for block, channel, bit, active in self._stop_sources:
            port = self.blocks[block]
            if (
                isinstance(port, BinaryBlock)
                and (int(port.data[channel]) >> bit & 1) == active
                and not self.stopped
            ):
                name = port.spec.channels[channel].name
                self.emergency_stop(
                    f"input {self.device} {port.spec.name} {name} bit {bit} reads {active}".replace("  ", " ")
                )

    def end_axis_waits(self, block: AnyBlock, axes: Any, errno_: int, text: str) -> None:
        """End the waits for motion of some axes."""
        ours = {int(a) for a in axes}
        self.waits.end_where(
            lambda w: w.handle.block is block and not ours.isdisjoint(w.channels), errno_, text
        )
        # A write that waits for room must not be taken after its axes were stopped.
        self.waits.end_where(
            lambda w: w.handle.block is block and w.cancelled is not None and not ours.isdisjoint(int(c) for c in w.handle.channels),
            errno_, text,
        )  # fmt: skip

    def stop_node(self, block: AnyBlock, channels: Any, source: str) -> None:
        """Emergency stop of some channels: latched until reset."""
        if isinstance(block, AxisBlock):
            block.bank.emergency_stop(channels, time.monotonic_ns())
            self.engine.stop([block])
            self.end_axis_waits(block, channels, errno.ECANCELED, f"emergency stop by {source}")
        else:
            self._make_safe(block, channels)

    def reset_node(self, block: AnyBlock, channels: Any, what: str) -> None:
        """Clear the latched stop and faults of some channels."""
        if self.stopped:
            raise OSError(
                errno.EPERM, f"{what}: the whole workcell is stopped ({self.latch.source}); reset that"
            )
        if isinstance(block, AxisBlock):
            self._reset_axes(block, channels)

    def _reset_axes(self, block: AxisBlock, channels: Any) -> None:
        block.bank.reset(np.array(channels, dtype=np.intp))
        self.engine.commands_written(block)

    def statistics_report(self, last: int) -> dict[str, object]:
        """Return what GET_STATISTICS tells: times of the last ticks, link counters, handles."""
        report = self.statistics.summary(last)
        report["tick_hz"] = self.engine.tick_hz
        report["handles"] = len(self._handles)
        counters = getattr(self.engine, "counters", None)
        if counters is not None:
            report["link"] = {name: getattr(counters, name) for name in counters.__slots__}
        if isinstance(self.driver, StreamDriver):
            report["stream"] = dict(self.driver.counters())
        return report

    # --- life ------------------------------------------------------------------------------------

    def run(self, priority: int, user: str) -> int:
        """Tick until told to end; return the exit status."""
        if user and os.getuid() == 0:
            _become_user(user)
        refused = become_realtime(priority)
        if refused:
            self.log("debug", "runs without " + ", ".join(refused))
        self.watch(self._control.fileno(), self._control_readable)
        self.watch(self._timer.fd, self._on_timer)
        self.watch(self._line_timer.fd, self._on_line_timer)
        self._tell_ready()
        self._look_at_latch()
        phase_ns = int(self._phase * self.period_ns)
        self._scheduled_ns = (time.monotonic_ns() // self.period_ns + 2) * self.period_ns + phase_ns
        self._timer.set(self._scheduled_ns, self.period_ns)
        self._scheduled_ns -= self.period_ns
        status = 0
        try:
            self._loop()
        except Exception as error:  # any failure of a driver: stop first, report second
            status = 1
            self._fail(error)
        return status

    def _loop(self) -> None:
        poll, callbacks = self._epoll.poll, self._callbacks
        while self.running:
            for fd, _ in poll():
                callback = callbacks.get(fd)
                if callback is not None:
                    callback()

    def _on_timer(self) -> None:
        expired = self._timer.expirations()
        if not expired:
            return
        began_ns = time.monotonic_ns()
        self._scheduled_ns += expired * self.period_ns
        self.statistics.skipped += expired - 1
        scheduled_ns = self._scheduled_ns
        self.tick += 1
        latch = self.latch
        if (latch.stopped_ns, latch.resets, self._request.word) != self._seen_stop:
            self._look_at_latch()
        if began_ns - latch.daemon_alive_ns > self._daemon_lease_ns:
            self._miss_daemon()
        elif self._daemon_late:
            self._daemon_late = False
        for handle in self._leased:
            if began_ns - handle.heard_ns > handle.lease_ns:
                self._end_handle(
                    handle,
                    errno.ETIMEDOUT,
                    f"{handle.node}: its client was silent for longer than its lease of {handle.lease_ns / 1e9:g} s",
                )
                break  # the list has changed; the others have their turn next tick
        engine = self.engine
        engine.tick(scheduled_ns)
        ticked_ns = time.monotonic_ns()
        for writer in self._writers:
            writer.alive(ticked_ns)
        if isinstance(engine, TickEngine) and engine.publishes:
            for block in self.blocks:
                self.publish(block, block.stamp_ns or scheduled_ns)
        self.after_publication(ticked_ns)
        ended_ns = time.monotonic_ns()
        self.statistics.record(scheduled_ns, began_ns, self.driver.inputs_ns, ticked_ns, ended_ns)
        if self._ending_ns:
            self._maybe_end(ended_ns)
        elif isinstance(engine, TickEngine):
            engine.slack(ended_ns, scheduled_ns + self.period_ns)

    def _on_line_timer(self) -> None:
        self._line_timer.expirations()
        self.line_due()

    def _fail(self, error: Exception) -> None:
        trace = "".join(traceback.format_exception(error)[-3:])
        try:
            now_ns = time.monotonic_ns()
            for block in self.blocks:
                if isinstance(block, AxisBlock):
                    block.bank.emergency_stop(np.arange(block.n), now_ns)
            self.engine.stop(self.blocks)
            self.engine.close()
        except Exception as second:
            trace += f" (and while stopping: {second!r})"
        self.log("error", f"driver failed: {error!r}: {trace}")

    def end(self, reason: str) -> None:
        """Stop everything, make outputs safe, and let the process end when all is quiet."""
        if self._ending_ns:
            return
        self._ending_ns = time.monotonic_ns()
        for handle in list(self._handles.values()):
            self._end_handle(handle, errno.EIO, f"{handle.node}: {reason}")
        for block in self.blocks:
            if isinstance(block, AxisBlock):
                block.bank.stop(np.arange(block.n), self._ending_ns)
                self.engine.commands_written(block)
        for block in self.blocks:
            self._make_safe(block, range(block.n))
        self._end_reason = reason
        self._closing = False

    def _maybe_end(self, now_ns: int) -> None:
        """Go on ticking until the axes rest, then close the device, then leave."""
        late = now_ns - self._ending_ns > STOP_GRACE_NS
        if not self._closing:
            moving = any(isinstance(b, AxisBlock) and not b.bank.is_idle(np.arange(b.n)) for b in self.blocks)
            if moving and not late:
                return
            self.engine.stop([b for b in self.blocks if isinstance(b, AxisBlock)])
            self.engine.close()
            self._closing = True
        if self.engine.is_quiet() or late:
            for writer in self._writers:
                writer.set_state(PageState.CLOSED, self._end_reason)
            self.running = False

    # --- pages and links -------------------------------------------------------------------------

    def _make_page(self, block: AnyBlock) -> PageWriter:
        spec = block.spec
        size = -(-page_size(spec.node_class, block.n, spec.history) // PAGE) * PAGE
        fd = os.memfd_create(f"sioms:{self.device}.{spec.name}", os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
        os.ftruncate(fd, size)
        self._page_fds = [*getattr(self, "_page_fds", []), fd]
        lease_ns = int(self._description.lease_s * 1e9)
        writer = PageWriter(
            memoryview(mmap.mmap(fd, size)),
            spec.node_class,
            block.n,
            spec.history,
            lease_ns,
            self._generation,
        )
        writer.alive(time.monotonic_ns())
        return writer

    def _make_engine(self) -> Engine:
        if isinstance(self.driver, TickDriver):
            return TickEngine(self, self.driver, self._description.tick_hz)
        if isinstance(self.driver, LineDriver):
            return LineEngine(self, self.driver, self._description.tick_hz)
        if isinstance(self.driver, StreamDriver):
            return StreamEngine(self, self.driver)
        raise TypeError(f"{type(self.driver).__name__} is no TickDriver, LineDriver or StreamDriver")

    def _wake(self, block: AnyBlock, subscribers: list[Handle]) -> None:
        edge = False
        if isinstance(block, BinaryBlock):
            edges = int(block.words[2].sum())
            edge = edges != self._edges.get(id(block))
            self._edges[id(block)] = edges
        for handle in subscribers:
            if handle.every < 0:
                if edge:
                    handle.wake()
                continue
            handle.countdown -= 1
            if handle.countdown <= 0:
                handle.countdown = handle.every
                handle.wake()

    def _take_events(self) -> None:
        for block in self.blocks:
            if not isinstance(block, AxisBlock):
                continue
            for event in block.bank.take_events():
                if event.kind in (EventKind.DROPPED, EventKind.FAULT):
                    self.end_axis_waits(block, event.axes, event.errno or errno.EIO, event.text)
                    if event.kind is EventKind.FAULT:
                        names = ", ".join(block.spec.channels[a].name for a in event.axes[:4])
                        self.log("error", f"fault of {names}: {event.text}")

    # --- stops -----------------------------------------------------------------------------------

    def _look_at_latch(self) -> None:
        latch, (seen_stop, seen_resets, seen_request) = self.latch, self._seen_stop
        word = self._request.word
        if word != seen_request and latch.stop(time.monotonic_ns(), self._request.source):
            self._tell(DriverVerb.STOPPED, latch.source)
        stopped_ns, resets = latch.stopped_ns, latch.resets
        self._seen_stop = (stopped_ns, resets, word)
        if (stopped_ns and stopped_ns != seen_stop) or resets != seen_resets:
            self._stop_all()
        if not stopped_ns and self.stopped:
            self.stopped = False
            for block in self.blocks:
                if isinstance(block, AxisBlock):
                    self._reset_axes(block, range(block.n))

    def _stop_all(self) -> None:
        self.stopped = True
        now_ns = time.monotonic_ns()
        for block in self.blocks:
            if isinstance(block, AxisBlock):
                block.bank.emergency_stop(np.arange(block.n), now_ns)
        self.engine.stop(self.blocks)
        for block in self.blocks:
            self._make_safe(block, range(block.n))
        self.waits.end_where(  # before the events of the banks would: these know who stopped
            lambda w: isinstance(w.handle.block, AxisBlock),
            errno.ECANCELED,
            f"emergency stop by {self.latch.source}",
        )
        self._take_events()

    def _make_safe(self, block: AnyBlock, channels: Any) -> None:
        """Give output channels their safe values; those without one keep the last."""
        if isinstance(block, AxisBlock) or not block.spec.writable or not block.spec.safe:
            return
        safe = [(int(c), value) for c in channels if (value := block.spec.safe[int(c)]) is not None]
        if not safe:
            return
        try:
            self.engine.write_outputs(None, 0, block, [c for c, _ in safe], [v for _, v in safe])
        except OSError as error:
            self.log(
                "error", f"safe outputs of {self.device}.{block.spec.name} could not be set: {error.strerror}"
            )

    def _miss_daemon(self) -> None:
        if self._daemon_late or self._ending_ns:
            return
        self._daemon_late = True
        for handle in list(self._handles.values()):
            if handle.exclusive:
                self._end_handle(
                    handle,
                    errno.ETIMEDOUT,
                    f"{handle.node}: the daemon has been silent for more than {self._daemon_lease_ns / 1e9:g} s",
                )

    # --- the daemon ------------------------------------------------------------------------------

    def _tell(self, verb: DriverVerb, *arguments: object) -> None:
        try:
            self._control.send(encode(verb, 0, *arguments))
        except OSError:
            return  # a daemon that is gone is noticed by its end of file, a hung one by its lease

    def _tell_ready(self) -> None:
        socket.send_fds(self._control, [encode(DriverVerb.READY, 0, len(self.blocks))], self._page_fds)
        for fd in self._page_fds:
            os.close(fd)

    def _control_readable(self) -> None:
        for _ in range(PACKETS_A_TURN):
            try:
                packet, fds, _, _ = socket.recv_fds(self._control, MAX_PACKET, 8)
            except BlockingIOError:
                return
            except OSError:
                packet, fds = b"", []
            if not packet:
                self.unwatch(self._control.fileno())
                self.end("the daemon has gone")
                return
            message: list[Any] = decode(packet)
            self._obey(DriverVerb(message[0]), message[2:], fds)

    def _obey(self, verb: DriverVerb, arguments: list[Any], fds: list[int]) -> None:
        match verb:
            case DriverVerb.ATTACH:
                self._attach(fds, *arguments)
            case DriverVerb.DETACH:
                handle = self._handles.get(arguments[0])
                if handle is not None:
                    self._drop_handle(handle)
                else:
                    self._tell(DriverVerb.DETACHED, arguments[0])
            case DriverVerb.STOP_CHANGED:
                self._look_at_latch()
            case DriverVerb.SHUTDOWN:
                self.end("the device was taken out of service")
            case DriverVerb.INPUT:
                name, channels, bit = arguments
                self.inputs[name].attach(fds[0], channels, bit)
            case DriverVerb.NODE_STOP:
                self.stop_node(self.blocks[arguments[0]], arguments[1], arguments[2])
            case DriverVerb.NODE_RESET:
                try:
                    self.reset_node(self.blocks[arguments[0]], arguments[1], "reset")
                except (OSError, CommandError) as error:
                    self.log("warning", str(error))
            case _:
                self.log("error", f"daemon sent {verb.name}, which is not for it to send")

    # --- clients ---------------------------------------------------------------------------------

    def _attach(
        self, fds: list[int], number: int, block: int, channels: list[int], bit: int, access: int,
        exclusive: bool, rights: int, lease_ns: int, who: str, node: str,
    ) -> None:  # fmt: skip
        sock = socket.socket(fileno=fds[0])
        sock.setblocking(False)
        handle = Handle(
            number, node, who, sock, fds[1], fds[2] if len(fds) > 2 else -1, self.blocks[block],
            np.array(channels, dtype=np.intp), bit, Access(access), exclusive, Right(rights), lease_ns,
            time.monotonic_ns(),
        )  # fmt: skip
        self._handles[number] = handle
        if lease_ns:
            self._leased.append(handle)
        self.watch(sock.fileno(), lambda: self._handle_readable(handle))
        if exclusive and handle.pidfd >= 0:
            # A child of the client may hold the socket open after the client's death.
            self.watch(handle.pidfd, lambda: self._drop_handle(handle))

    def _handle_readable(self, handle: Handle) -> None:
        for _ in range(PACKETS_A_TURN):
            if handle.number not in self._handles:
                return
            try:
                packet, ancillary, flags, _ = handle.sock.recvmsg(MAX_PACKET, _TWO_FDS)
            except BlockingIOError:
                return
            except OSError:
                packet, ancillary, flags = b"", [], 0
            fds = _fds_of(ancillary) if ancillary else []
            handle.heard_ns = time.monotonic_ns()
            try:
                if not packet:
                    self._drop_handle(handle)
                    return
                if flags & socket.MSG_TRUNC:
                    raise MalformedMessage(f"packet longer than {MAX_PACKET} bytes")
                self._serve(handle, decode(packet), fds)
            except (MalformedMessage, ValueError, TypeError, LookupError, OverflowError) as error:
                self.log(
                    "warning", f"{handle.node}: connection of {handle.who} ended: malformed message: {error}"
                )
                self._end_handle(handle, errno.EPROTO, f"{handle.node}: malformed message: {error}")
                return
            finally:
                for fd in fds:
                    os.close(fd)

    def _serve(self, handle: Handle, message: list[Any], fds: list[int]) -> None:
        verb, number, arguments = HandleVerb(message[0]), message[1], message[2:]
        if verb is not HandleVerb.KEEPALIVE and (number == 0 or number in handle.waits):
            raise MalformedMessage(f"message number {number} is zero or in use")
        try:
            match verb:
                case HandleVerb.WRITE:
                    flags, timeout_s, data = arguments
                    if data is None:
                        data = _records_of(fds)
                    value = write(self, handle, number, int(flags), _seconds(timeout_s), data)
                case HandleVerb.IOCTL:
                    request, argument, timeout_s = arguments
                    value = ioctl(self, handle, number, int(request), argument, _seconds(timeout_s))
                case HandleVerb.SUBSCRIBE:
                    self._subscribe(handle, int(arguments[0]))
                    value = None
                case HandleVerb.CANCEL:
                    wait = handle.waits.get(int(arguments[0]))
                    value = wait is not None
                    if wait is not None:
                        self.waits.end(wait, errno.ECANCELED, f"{wait.what}: cancelled")
                case HandleVerb.KEEPALIVE:
                    return
        except OSError as error:
            handle.refuse(number, error.errno or errno.EIO, error.strerror or str(error))
        else:
            if value is not LATER:
                handle.answer(number, value)

    def _subscribe(self, handle: Handle, every: int) -> None:
        if not -1 <= every <= 1_000_000:
            raise OSError(errno.EINVAL, f"subscribe to {handle.node}: every {every}; want -1 to 1000000")
        subscribers = self._subscribers[id(handle.block)]
        if handle in subscribers:
            subscribers.remove(handle)
        handle.every, handle.countdown = every, 0
        if every:
            subscribers.append(handle)

    def _end_handle(self, handle: Handle, errno_: int, text: str) -> None:
        handle.tell_end(errno_, text)
        self._drop_handle(handle)

    def _drop_handle(self, handle: Handle) -> None:
        """End a handle: halt what it owns, then tell the daemon that the channels are free."""
        if self._handles.pop(handle.number, None) is None:
            return
        self.unwatch(handle.sock.fileno())
        if handle.pidfd >= 0:
            self.unwatch(handle.pidfd)
        if handle in self._leased:
            self._leased.remove(handle)
        if handle.every:
            self._subscribers[id(handle.block)].remove(handle)
        self.waits.forget(handle)
        if handle.exclusive:
            if isinstance(handle.block, AxisBlock):
                handle.block.bank.stop(handle.channels, time.monotonic_ns())
                self.engine.commands_written(handle.block)
            else:
                self._make_safe_handle(handle)
        handle.close()
        self._tell(DriverVerb.DETACHED, handle.number)

    def _make_safe_handle(self, handle: Handle) -> None:
        block = handle.block
        if handle.bit < 0 or not block.spec.safe or block.spec.safe[int(handle.channels[0])] is None:
            self._make_safe(block, handle.channels)
            return
        channel = int(handle.channels[0])
        mask = 1 << handle.bit
        present = int(self.outputs.get((id(block), channel), 0))
        value = (present & ~mask) | (int(block.spec.safe[channel] or 0) & mask)
        try:
            self.engine.write_outputs(None, 0, block, [channel], [value])
        except OSError as error:
            self.log("error", f"safe output of {handle.node} could not be set: {error.strerror}")


def _fds_of(ancillary: list[tuple[int, int, bytes]]) -> list[int]:
    """Return the descriptors that came along with a packet."""
    fds = array("i")
    for level, kind, data in ancillary:
        if level == socket.SOL_SOCKET and kind == socket.SCM_RIGHTS:
            fds.frombytes(data[: len(data) - len(data) % fds.itemsize])
    return fds.tolist()


def _records_of(fds: list[int]) -> bytes:
    """Copy the records of a large write out of the memory file that came with it."""
    if not fds:
        raise MalformedMessage("a write without records and without a descriptor")
    size = os.fstat(fds[0]).st_size
    if size > MAX_WRITE:
        raise OSError(errno.EMSGSIZE, f"write of {size} bytes; want at most {MAX_WRITE}")
    return os.pread(fds[0], size, 0)


def _seconds(value: Any) -> float | None:
    if value is None:
        return None
    if not isinstance(value, int | float) or value != value:
        raise MalformedMessage(f"time-out {value!r}; want a number of seconds or nil")
    return float(value)


def _become_user(user: str) -> None:
    import pwd

    entry = pwd.getpwnam(user)
    os.initgroups(user, entry.pw_gid)
    os.setgid(entry.pw_gid)
    os.setuid(entry.pw_uid)
