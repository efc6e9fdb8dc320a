"""Rig: devices of one process and their ticks, on a clock and timers of the rig's own.

Runtimes, steps (as Python) and the process of several devices are the real ones, over real descriptors; unless a driver
is given, the devices do nothing but note when they tick.
"""

from __future__ import annotations

import gc
import os
import socket
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from types import ModuleType, SimpleNamespace
from typing import Any

import msgspec
import numpy as np
import pytest
from own_writes_rig import _in_python, _memory

import sioms.motion.bank
import sioms.sdk.desk
import sioms.sdk.group
import sioms.sdk.quiet
from sioms.protocol.driver_verbs import DriverVerb
from sioms.protocol.flags import NodeClass
from sioms.protocol.journal import HEADER, JOURNAL_SIZE
from sioms.protocol.latch import LATCH_SIZE, Latch
from sioms.protocol.markers import TABLE_SIZE
from sioms.protocol.messages import encode
from sioms.protocol.nodeinfo import ChannelInfo
from sioms.sdk.blocks import AnalogBlock, BlockSpec, Description
from sioms.sdk.driver import Driver, Kit, TickDriver
from sioms.sdk.group import Group, Member
from sioms.sdk.runtime import Runtime

FOR_EVER_S = 1e6


class Clock:
    """Time, and the timers that it makes expire; each look at it takes a little, as long as a process has its turn."""

    def __init__(self) -> None:
        self.now_ns = 10_000_000_000
        self.timers: list[Timer] = []

    def __call__(self) -> int:
        self.now_ns += 100
        return self.now_ns

    def go_to(self, now_ns: int) -> None:
        """Let time pass."""
        self.now_ns = max(self.now_ns, now_ns)
        for timer in self.timers:
            timer.expire()

    def due_ns(self) -> int:
        """Return when the next timer expires."""
        return min(timer.next_ns for timer in self.timers if timer.next_ns)


CLOCK = Clock()


class Timer:
    """A timer descriptor (timerfd_create(2)) of the rig's clock."""

    def __init__(self) -> None:
        self.fd = os.eventfd(0, os.EFD_NONBLOCK)
        self.next_ns = self.period_ns = 0
        CLOCK.timers.append(self)

    def set(self, first_ns: int, period_ns: int = 0) -> None:
        """Expire at a time, and then every period; what it has expired before is forgotten."""
        self.expirations()
        self.next_ns, self.period_ns = first_ns, period_ns
        self.expire()

    def expirations(self) -> int:
        """Return how often it has expired since the last call."""
        try:
            return os.eventfd_read(self.fd)
        except BlockingIOError:
            return 0

    def expire(self) -> None:
        """Expire as often as is due."""
        if self.next_ns and self.next_ns <= CLOCK.now_ns:
            count = 1 + ((CLOCK.now_ns - self.next_ns) // self.period_ns if self.period_ns else 0)
            os.eventfd_write(self.fd, count)
            self.next_ns = self.next_ns + count * self.period_ns if self.period_ns else 0

    def close(self) -> None:
        CLOCK.timers.remove(self)
        os.close(self.fd)


_SPEC = BlockSpec("", NodeClass.ANALOG, (ChannelInfo("value", "m"),))


class Table(msgspec.Struct, frozen=True):
    """Settings: rate, and whether there is work to do between ticks, which then have a longer lead."""

    hz: float = 100.0


class Ticker(TickDriver):
    """A driver that notes its ticks: what for, and when."""

    Settings = Table

    def __init__(self, name: str, settings: Table, kit: Kit) -> None:
        super().__init__(name, settings, kit)
        self.block = AnalogBlock(_SPEC)
        self.ticks: list[tuple[int, int]] = []
        self.rests, self.leaves, self.brakes = True, False, True

    @classmethod
    def describe(cls, name: str, settings: Table) -> Description:
        return Description((_SPEC,), settings.hz, lease_s=FOR_EVER_S)

    @property
    def blocks(self) -> Sequence[AnalogBlock]:
        return (self.block,)

    def tick(self, now_ns: int) -> None:
        self.ticks.append((now_ns, CLOCK.now_ns))

    def slack(self, now_ns: int, until_ns: int) -> None:
        """Nothing; but because of it there is a longer lead."""

    def is_at_rest(self) -> bool:
        return self.rests

    def quiet_steps(self, pages: Any, instants: Any) -> Any:
        """Return steps that do the same, unless ``leaves`` says that a tick is the loop's, or has stops refused."""

        def tick(_record: Any, now_ns: int, _as_of_ns: int, _number: int) -> int:
            if not self.leaves:
                self.tick(now_ns)
            return int(self.leaves)

        return SimpleNamespace(
            record=None, tick=tick, slack=lambda *_: 0, rest=lambda *_: int(self.rests),
            stop=lambda *_: int(not self.brakes), is_ready=lambda *_: True, resume=lambda: None,
        )  # fmt: skip


class Device:
    """A device of the process, and the daemon's end of its socket."""

    def __init__(
        self, group: Group, latch: int, request: int, hz: float, phase: float, driver: type[Driver], table: Any
    ) -> None:
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self.control = ours
        self.control.setblocking(False)
        sizes = (4096, TABLE_SIZE, 0, HEADER + JOURNAL_SIZE)
        files = [os.dup(latch), os.dup(request), *(_memory(size) for size in sizes)]
        options = {
            "stop_sources": [], "alarms": [], "daemon_lease_s": FOR_EVER_S, "phase": phase, "state_folder": "",
            "stopped": [],
            "resets": 0,
        }  # fmt: skip
        fds = [theirs.detach(), *files]
        self._kept = [files[0], *files[3:]]
        """What the runtime has mapped, and does not close: its process would."""
        self.runtime = Runtime(driver, "dev", table, 1, options, fds)
        self.runtime.sees_requests, self.runtime.busy = True, group._busy
        self.driver: Any = self.runtime.driver
        self.member = Member(self.runtime, [], 0, "")
        group._members[self.runtime.poll_fd] = self.member
        group._epoll.register(self.runtime.poll_fd)
        self.runtime.start()
        self.grid_ns = self.runtime._scheduled_ns % self.runtime.period_ns
        group._go_on(self.runtime.poll_fd, self.member)

    @property
    def beat_ns(self) -> int:
        """Time between two ticks at present."""
        return self.runtime.period_ns * self.runtime._idling.periods

    def close(self) -> None:
        self.runtime.release()
        self.let_go()

    def let_go(self) -> None:
        """Close what is left when its runtime has been released."""
        for fd in self._kept:
            os.close(fd)
        self.control.close()


class Process:
    """Devices in one process; nothing happens in it but what the test has happen."""

    def __init__(
        self,
        hz: Sequence[float],
        phases: Sequence[float],
        steps: ModuleType,
        driver: type[Driver] = Ticker,
        table: Callable[[float], Any] = Table,
    ) -> None:
        self._steps = steps
        self.served = 0
        """How many packets steps have served."""
        ours, self._fork_server = socket.socketpair()
        self.group = Group(ours)
        latch, self.request = _memory(LATCH_SIZE), _memory(4096)
        import mmap

        self.latch = Latch(memoryview(mmap.mmap(latch, LATCH_SIZE)))
        self.latch.begin(0, (0, os.fstat(self.request).st_mtime_ns))
        self.latch.daemon_alive(CLOCK.now_ns)
        self.devices = [
            Device(self.group, latch, self.request, rate, phase, driver, table(rate))
            for rate, phase in zip(hz, phases, strict=True)
        ]
        os.close(latch)

    def look(self) -> None:
        """Have all tick by steps whose timers are due, and put those on the list that have more to do."""
        for fd, member in list(self.group._members.items()):
            more = bool(member.runtime.ready_but([]))
            if more and member.quiet is not None and self.group._of[fd]:
                more = bool(self._steps.heed_one(member.quiet.record, 0, 0, 0))
            if more or member.runtime.pause_s is not None:
                self.group._put(fd)
        for device in self.devices:
            _drain(device.control)

    def serve(self) -> None:
        """Serve the device whose turn it is, unless there is a stop to begin."""
        if not self.group._look_for_stops():
            self.group._serve_next()

    def serve_all(self) -> None:
        """Serve all whose turn it is."""
        while self.group._due:
            self.serve()

    def order(self, device: Device, verb: DriverVerb, *arguments: object) -> None:
        """Have the daemon send a device something."""
        device.control.send(encode(verb, 0, *arguments))

    def request_stop(self) -> None:
        """Ask for a stop of all, as any client may; the process is woken by that."""
        os.pwrite(self.request, CLOCK.now_ns.to_bytes(8, "little"), 0)
        self.group._heed_requests()

    def close(self) -> None:
        for device in self.devices:
            device.close()
        os.close(self.request)
        self.group._epoll.close()
        self._fork_server.close()
        if self.group._sock is not None:
            self.group._sock.close()


def _drain(sock: socket.socket) -> None:
    try:
        while sock.recv(1 << 16):
            pass
    except BlockingIOError:
        return


def _make(record: Any, **fields: Any) -> None:
    """Make a record for steps in Python, whatever the library is."""
    for name, value in fields.items():
        setattr(record, name, value.reshape(-1).data if isinstance(value, np.ndarray) else value)


def _wait_for(groups: list[Group]) -> Callable[[int, Any, int], int]:
    def wait_for(poll: int, ready: Any, timeout_ms: int) -> int:
        assert timeout_ms == 0, "who waits for its turn does not sleep"
        events = [fd for fd, _ in groups[-1]._members[poll].runtime._epoll.poll(0)]
        ready[: len(events)] = events
        return len(events)

    return wait_for


@contextmanager
def processes() -> Iterator[Callable[..., Process]]:
    """Give what makes a process of devices with rates [Hz] and phases, in the rig's time."""
    made: list[Process] = []
    with (
        _in_python("sioms.sdk.quiet_step") as steps,
        _in_python("sioms.sdk.serve_step") as serving,
        _in_python("sioms.motion.plain_step") as plain,
    ):
        pass  # the records of all other steps are what they are
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(steps.Quiet, "__init__", lambda self, **fields: self.__dict__.update(fields))
        for record in (serving.Desk, serving.StopFile, plain.Plain):
            patch.setattr(record, "__init__", _make)
        patch.setattr(sioms.sdk.desk, "Desk", serving.Desk)
        patch.setattr(sioms.sdk.desk, "StopFile", serving.StopFile)
        patch.setattr(sioms.motion.bank, "plain_of", plain.plain_of)
        patch.setattr(serving, "clock_ns", CLOCK)
        patch.setattr(serving, "admits", plain.admits)
        for name in ("is_requested", "is_unread", "writer_of"):
            patch.setattr(steps, name, getattr(serving, name))

        def serve_packet(desk: Any, who: int, tick: int) -> int:
            left: int = serving.serve_packet(desk, who, tick)
            made[-1].served += not left
            return left

        patch.setattr(steps, "serve_packet", serve_packet)
        groups: list[Group] = []

        def set_timer(fd: int, when_ns: int) -> int:
            next(timer for timer in CLOCK.timers if timer.fd == fd).set(when_ns)
            return 0

        patch.setattr(steps, "clock_ns", CLOCK)
        patch.setattr(steps, "wait_for", _wait_for(groups))
        patch.setattr(steps, "expirations", lambda fd: next(t for t in CLOCK.timers if t.fd == fd).expirations())
        patch.setattr(steps, "set_timer", set_timer)
        patch.setattr(steps.Quiet, "address", property(id))
        patch.setattr(sioms.sdk.quiet, "Quiet", steps.Quiet)
        for name in ("begin_asked_stop", "begin_halt", "wait_turn"):
            patch.setattr(sioms.sdk.group, name, getattr(steps, name))
        patch.setattr(sioms.sdk.quiet, "library", object())
        patch.setattr(sioms.sdk.group, "time", SimpleNamespace(sleep=lambda _: None, monotonic_ns=CLOCK))
        patch.setattr(time, "monotonic_ns", CLOCK)
        patch.setattr("sioms.sdk.ticking.TimerFd", Timer)

        def make(hz: Sequence[float], phases: Sequence[float], *kind: Any) -> Process:
            made.append(Process(hz, phases, steps, *kind))
            groups[:] = [made[-1].group]
            return made[-1]

        yield make
        while made:
            made.pop().close()
    gc.collect()  # what the runtimes have mapped
