"""Rig: a whole driver process and its clients on one thread and one clock of its own, served in any order.

The driver side is the runtime with its engine, banks, handles and pages, the client side channels and nodes. Only what
the operating system does is replaced: the clock, the timers, the sleep of a reading that waits, and the line.
"""

from __future__ import annotations

import _socket
import importlib.util
import os
import random
import socket
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from types import ModuleType
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np
import pytest
from ownership_fakes import Timer
from sent_rig import SentTimes

import sioms.client.node_core
import sioms.motion.bank
import sioms.native.language
import sioms.sdk.connected
import sioms.sdk.desk
import sioms.sdk.quiet
from sioms.client import shown
from sioms.client.channel import Call, Channel
from sioms.client.local import LocalPage
from sioms.client.node_core import NodeCore
from sioms.descriptors import enable_timestamps, is_readable
from sioms.protocol.driver_verbs import Attach, DriverVerb
from sioms.protocol.flags import Access, Request, Right
from sioms.protocol.journal import HEADER, JOURNAL_SIZE
from sioms.protocol.latch import LATCH_SIZE, Latch
from sioms.protocol.markers import TABLE_SIZE, MarkerTable
from sioms.protocol.messages import encode
from sioms.protocol.nodeinfo import NodeInfo
from sioms.sdk.desk import WriteDesk
from sioms.sdk.driver import Driver, TickDriver
from sioms.sdk.quiet import QuietRun
from sioms.sdk.runtime import Runtime
from sioms.sdk.settings import LineSettings

if TYPE_CHECKING:
    from own_writes_devices import Device

SEED = int(os.environ.get("SIOMS_SEED", "0"))
CONTROL = 3
"""The daemon's socket among the descriptors that are ready."""
Done = Callable[[Any], None]


class Client:
    """A node that a client has open: its own channel, and the handle in the driver."""

    def __init__(self, world: World, node: NodeCore, channel: Channel) -> None:
        self.world = world
        self.node = node
        self.channel = channel
        self.pending: dict[int, Done] = {}

    def send(self, call: Call, done: Done) -> None:
        """Send a request; ``done`` is called with the answer, or the refusal, when that has come."""
        self.post(call, done)
        self.world.serve(self)
        self.take()

    def post(self, call: Call, done: Done = lambda _: None) -> None:
        """Send a request that the driver has not come to serve yet."""
        SENT.note()
        self.pending[self.channel.send(call)] = done

    def take(self) -> None:
        """Take the answers that have come."""
        while self.pending and (found := self.channel.take()) is not None:
            done = self.pending.pop(found[0][1], None)
            try:
                value: Any = self.channel.result(found).value
            except OSError as error:
                value = error
            if done is not None:
                done(value)

    def ioctl(self, request: Request, argument: object = None, done: Done = lambda _: None) -> None:
        """Send a request."""
        self.send(self.node._ioctl(request, argument, None), done)

    def write(self, records: bytes, done: Done = lambda _: None, *, replace: bool = False) -> None:
        """Send a write."""
        self.send(self.node._write(records, 0.0, replace), done)


class World:
    """A driver process, its clients, and the order of things.

    Args:
        driver: class of the driver.
        table: its settings.
        chance: of the order.
        device: replies to what the driver sends on its line; None for a driver without.

    Attributes:
        between: what others do while a tick is under way: called at some of its looks at the clock.
        quiet: how many ticks were done by the quiet steps.
        served: how many writes were served by steps, of those that are tried as often as ``by_steps`` says.
    """

    def __init__(
        self, driver: type[Driver], table: dict[str, Any], chance: random.Random, device: Device | None = None
    ) -> None:
        self.chance = chance
        self.device = device
        self.clients: list[Client] = []
        sizes = (LATCH_SIZE, 4096, 4096, TABLE_SIZE, 0, HEADER + JOURNAL_SIZE)
        latch, request, taken, markers, journal, events = (_memory(size) for size in sizes)
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self.control = ours
        self.control.setblocking(False)
        settings = msgspec.convert(table, driver.Settings)
        options = {
            "stop_sources": [], "alarms": [], "daemon_lease_s": 1e6, "phase": 0.0, "state_folder": "", "stopped": [],
            "resets": 0,
        }  # fmt: skip
        fds = [theirs.detach(), latch, request, taken, markers, journal, events]
        import mmap

        self.latch = Latch(memoryview(mmap.mmap(latch, LATCH_SIZE)))
        self.latch.begin(0, (0, os.fstat(request).st_mtime_ns))
        self.runtime = Runtime(driver, "dev", settings, 1, options, fds)
        self.markers = MarkerTable(memoryview(mmap.mmap(markers, TABLE_SIZE)))
        self.latch.daemon_alive(time.monotonic_ns())
        self._fds, self.journal = [latch, markers, journal, events], journal
        self.runtime._scheduled_ns = time.monotonic_ns()
        self.runtime.looked_ns = time.monotonic_ns()
        self.page_fds = list(self.runtime.pages.fds)
        self.ticks = self.quiet = self.served = 0
        self.by_steps = 0.5
        self.between: Callable[[], object] | None = None
        self._run = self._quiet_run()
        for _ in range(400):
            self.turn(calm=True)
            if self.runtime.pages.is_good(self.runtime.blocks) and all(
                map(self.runtime.pages.number, self.runtime.blocks)
            ):
                return
        raise AssertionError("the driver does not come up")

    def open(
        self, block: int, channels: Sequence[int], *, exclusive: bool, bit: int = -1, uid: int = 1000,
        early: Callable[[Client], None] = lambda _: None,
    ) -> Client:  # fmt: skip
        """Open a node as the daemon does; ``early`` is what its client does before the driver hears of it."""
        self.runtime._wake()
        number = max((client.node.handle for client in self.clients), default=0) + 1
        shown_block = self.runtime.blocks[block]
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        enable_timestamps(theirs)
        readable, wake = os.pipe2(os.O_NONBLOCK)
        access = Access.READ | Access.WRITE if exclusive else Access.READ
        spec = shown_block.spec
        info = NodeInfo(
            [f"node{number}", int(spec.node_class), not exclusive, [spec.channels[c].pack() for c in channels], bit,
             1000.0, spec.capacity, "dev", "test", 2]
        )  # fmt: skip
        channel = Channel(_socket.socket(fileno=ours.detach()), info.name, False)
        fd = os.dup(self.page_fds[block])
        node = NodeCore(info, number, LocalPage(fd, readable), list(channels), bit, channel)
        node._owe()
        client = Client(self, node, channel)
        early(client)
        self.runtime.clients.attach(
            [theirs.detach(), wake],
            Attach(
                number, block, list(channels), bit, int(access), exclusive, int(Right.ALL), 0, "tester", uid,
                [256, 128], f"node{number}",
            ),
        )  # fmt: skip
        self.clients.append(client)
        return client

    def close_node(self, client: Client) -> None:
        """Close a node as the daemon does when its client has."""
        self.runtime._wake()
        self.clients.remove(client)
        client.node.release()
        self.runtime.clients.drop(self.runtime.clients.handles[client.node.handle])

    def serve(self, client: Client) -> None:
        """Let the driver serve what a client has sent, half of the time by steps if they can."""
        if self._run is not None and self.chance.random() < self.by_steps and self._serve_quietly(client):
            return
        handle = self.runtime.clients.handles[client.node.handle]
        self.runtime.clients._readable(handle)

    def tick(self, skipped: int = 0) -> None:
        """Let the driver tick; some ticks before that were missed."""
        runtime = self.runtime
        step_ns = runtime.period_ns * runtime._idling.periods
        CLOCK.now_ns = max(CLOCK.now_ns, runtime._scheduled_ns + step_ns * (skipped + 1))
        runtime._timer.expired = skipped + 1  # type: ignore[attr-defined]
        self.ticks += 1
        CLOCK.intrude = self._intrude if self.between else None
        if not self._tick_quietly():
            runtime._on_timer()
        if runtime._announced and not self._tick_quietly():
            runtime._on_line_timer()
        CLOCK.intrude = None
        self.latch.daemon_alive(CLOCK.now_ns)
        while True:
            try:
                self.control.recv(1 << 16)
            except BlockingIOError:
                return

    def _serve_quietly(self, client: Client) -> bool:
        """Serve a write by steps; False when it is the loop's."""
        runtime = self.runtime
        runtime._quiet, sock = self._run, runtime.clients.handles[client.node.handle].sock.fileno()
        quiet = runtime.lend()
        if quiet is None:
            return False
        who = self._writer_of(quiet.record.desk, sock)
        done: bool = who >= 0 and self._serve_writer(quiet.record, who) == 0
        runtime.take_back(quiet)
        self.served += done
        return done

    def _intrude(self) -> None:
        if self.between and self.chance.random() < 0.02:
            CLOCK.intrude = None
            self.between()
            CLOCK.intrude = self._intrude

    def _quiet_run(self) -> QuietRun | None:
        """Return what ticks by steps, if the driver has any: a copy in Python with the rig's clock and events."""
        runtime = self.runtime
        if not isinstance(runtime.driver, TickDriver) or any(block.spec.writable for block in runtime.blocks):
            return None
        instants = np.zeros(2, dtype=np.int64)
        steps = runtime.driver.quiet_steps(runtime.pages, instants)
        if steps is None:
            return None
        with (
            _in_python("sioms.motion.plain_step") as plain,
            _in_python("sioms.sdk.serve_step") as serving,
            _in_python("sioms.sdk.quiet_step") as module,
            pytest.MonkeyPatch.context() as patch,
        ):
            patch.setattr(sioms.motion.bank, "plain_of", plain.plain_of)
            patch.setattr(sioms.sdk.desk, "Desk", serving.Desk)
            patch.setattr(sioms.sdk.desk, "StopFile", serving.StopFile)
            serving.clock_ns, serving.admits = CLOCK, plain.admits
            module.serve_packet = serving.serve_packet
            self._writer_of, self._serve_writer = serving.writer_of, module.serve_writer
            module.clock_ns, module.wait_for = CLOCK, self._wait_for
            module.expirations = lambda fd: runtime._timer.expirations() if fd == 1 else 1
            module.set_timer = lambda fd, when_ns: 0
            module.is_requested, module.is_unread = serving.is_requested, serving.is_unread
            module.wait_for_one = lambda fd, until_ns: 0
            self.run_quietly = module.run
            return QuietRun(
                steps, 0, 1, 2, CONTROL, runtime._latch_words, runtime.period_ns, runtime._lead_ns,
                runtime._daemon_lease_ns, runtime._idling, instants, runtime.pages, runtime.stops, runtime.waits,
                runtime.clients, runtime.statistics,
                WriteDesk(
                    runtime.blocks, runtime.clients, runtime.stops, runtime.pages, runtime._request_fd, False,
                    runtime.period_ns, runtime.busy,
                ),
            )  # fmt: skip

    def _wait_for(self, poll: int, ready: Any, timeout_ms: int) -> int:
        """Say that a timer is due, until that has been heard; then that a signal has ended the wait.

        Who does not wait asks whether the daemon has sent something.
        """
        assert self._run is not None
        if timeout_ms == 0:
            ready[0] = CONTROL
            return int(is_readable(self.runtime._control))
        ready[0] = 1 if self.runtime._timer.expired else 2  # type: ignore[attr-defined]
        return 1 if ready[0] == 1 or self._run.record.announced else 0

    def _tick_quietly(self) -> bool:
        """Tick by steps; False when the tick is the loop's."""
        runtime = self.runtime
        runtime._quiet = self._run
        quiet = runtime.lend()
        if quiet is None:
            return False
        quiet.run()
        ready = runtime.take_back(quiet)
        self.quiet += quiet.record.done
        return not ready

    def turn(self, *, calm: bool = False) -> None:
        """Let one thing happen: a tick, perhaps a late one, or something on the line."""
        chance = self.chance
        CLOCK.now_ns += chance.randrange(1, 400_000)
        if self.device is not None and self.runtime.engine.line is not None and chance.random() < 0.7:  # type: ignore[attr-defined]
            self._line()
        else:
            self.tick(0 if calm or chance.random() < 0.8 else chance.randrange(1, 4))
        for client in self.clients:
            client.take()

    def _line(self) -> None:
        engine, device = self.runtime.engine, self.device
        assert device is not None
        if device.work():
            engine._readable()  # type: ignore[attr-defined]
        line = engine.line  # type: ignore[attr-defined]
        if line is not None and line.deadline_ns is not None and not device.owes:
            CLOCK.now_ns = max(CLOCK.now_ns, line.deadline_ns)
            engine.line_due()  # type: ignore[attr-defined]

    def order(self, verb: DriverVerb, *arguments: object) -> None:
        """Send an order as the daemon does; it is acknowledged to all nodes."""
        self.control.send(encode(verb, 0, *arguments))
        self.latch.ordered()
        shown.acknowledged_by_daemon(time.monotonic_ns())

    def close(self) -> None:
        """End everything."""
        for client in self.clients:
            client.node.release()
            self.runtime.clients.drop(self.runtime.clients.handles[client.node.handle])
        for fd in [*self._fds, *self.page_fds]:
            os.close(fd)
        if self.device is not None:
            self.device.close()
        for timer in (self.runtime._timer, self.runtime._line_timer):
            os.close(timer.fd)
        self.runtime.clients.close()
        self.runtime._epoll.close()
        self.runtime._control.close()
        self.control.close()


@contextmanager
def _in_python(name: str) -> Iterator[ModuleType]:
    """Load a module of steps once more, as Python, and have the kit make its records of it."""
    spec = importlib.util.find_spec(name)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sioms.native.language, "library", None)
        spec.loader.exec_module(module)
        if hasattr(module, "Quiet"):
            patch.setattr(sioms.sdk.quiet, "Quiet", module.Quiet)
        yield module


class _Clock:
    now_ns = 10_000_000_000
    intrude: Callable[[], None] | None = None

    def __call__(self) -> int:
        if self.intrude:
            self.intrude()
        self.now_ns += 1
        return self.now_ns


CLOCK = _Clock()
SENT = SentTimes(CLOCK)


@contextmanager
def own_time(world: list[World]) -> Iterator[None]:
    """Put the rig's clock, timers and line in the place of the system's; a reading that waits lets the world turn."""

    def sleep(_: float) -> None:
        world[0].turn()

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(shown, "_nodes", {})
        patch.setattr(shown, "_last_ns", {})
        patch.setattr(shown, "_everywhere_ns", 0)  # what this process has been told in the system's time is not owed
        patch.setattr(time, "monotonic_ns", CLOCK)
        patch.setattr(sioms.client.node_core, "monotonic_ns", CLOCK)
        patch.setattr(sioms.client.node_core, "sleep", sleep)
        SENT.install(patch)
        patch.setattr("sioms.sdk.ticking.TimerFd", Timer)
        patch.setattr(sioms.sdk.quiet, "run", lambda record: world[0].run_quietly(record))
        patch.setattr(sioms.sdk.connected, "open_connection", lambda settings, _: world_device(world, settings))
        yield


@contextmanager
def worlds() -> Iterator[Callable[..., World]]:
    """Give what makes a world of a driver's class, its settings, a seed and perhaps a device, the last of which is the
    one there is.
    """
    made: list[World] = []
    with own_time(made):

        def make(driver: type[Driver], table: dict[str, Any], seed: int, device: Device | None = None) -> World:
            made[:] = [World.__new__(World)]
            made[0].__init__(driver, table, random.Random(seed + 1000 * SEED), device)  # type: ignore[misc]
            return made[0]

        yield make
        while made:
            made.pop().close()


def world_device(world: list[World], settings: LineSettings) -> Any:
    """Return the connection to the device of the world that is being made."""
    device = DEVICE[-1]
    device.settings = settings
    return device


DEVICE: list[Device] = []


def _memory(size: int) -> int:
    fd = os.memfd_create("rig")
    os.ftruncate(fd, size)
    return fd
