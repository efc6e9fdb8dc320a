"""What of a workcell in one process is not the real thing: devices, clients, and what the kernel would do."""

from __future__ import annotations

import math
import os
import socket
import zlib
from collections.abc import Mapping, Sequence
from typing import Any

import msgpack
import msgspec

import sioms.sdk.fork_server
from sioms.daemon.loop import Loop
from sioms.descriptors import is_readable
from sioms.motion import AxisBank, AxisSettings
from sioms.protocol.flags import NodeClass
from sioms.protocol.messages import MAX_PACKET, ClientVerb, decode, encode
from sioms.protocol.nodeinfo import ChannelInfo
from sioms.protocol.stopjournal import PID
from sioms.sdk.blocks import AnyBlock, AxisBlock, BinaryBlock, BlockSpec, Description
from sioms.sdk.driver import Driver, Kit, TickDriver
from sioms.sdk.runtime import Runtime

NAMES = ("axis", "port")
"""The devices: an axis that the host moves, and a port of two bits whose outputs are safe at 0."""
GRANTS = """
[workcell]
name = "model"
daemon_lease_s = 0.5
[[grant]]
users = ["client0", "client1"{0}]
rights = ["read", "write", "stop"]
[[grant]]
users = ["client0"]
rights = ["administer"]
[[grant]]
users = ["client2"]
rights = ["read", "stop"]
"""
"""Who may what; the place is for one more who may write."""
DEVICES_TABLE = """
[device.axis]
driver = "axis"
variant = {0}
[device.port]
driver = "port"
variant = {1}
"""
LEASE_S, DAEMON_LEASE_S, TICK_HZ = 1.0, 0.5, 500.0
FIRST_UID = 70_000


class _Clock:
    now_ns = 10**12

    def __call__(self) -> int:
        self.now_ns += 1
        return self.now_ns


CLOCK = _Clock()


# --- devices ------------------------------------------------------------------------------------------


class Table(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Settings of both devices."""

    variant: int = 0


_AXIS = BlockSpec("", NodeClass.AXIS, (ChannelInfo("x", "m"),), history=4, capacity=16)
_PORT = BlockSpec("", NodeClass.BINARY, (ChannelInfo("out", width=2),), True, 4, safe=(0.0,))


class Axis(TickDriver):
    """An ideal axis."""

    Settings = Table
    realtime_priority = 0

    def __init__(self, name: str, settings: Table, kit: Kit) -> None:
        super().__init__(name, settings, kit)
        axis = AxisSettings(
            "x", velocity_max=1.0, acceleration_max=1e6, force_max=1.0, k=1.0, following_error_max=math.inf
        )
        self.bank = AxisBank([axis], tick_s=1 / TICK_HZ, markers=kit.markers, late_max_s=1e6, capacity=16)
        self._block = AxisBlock(_AXIS, self.bank)

    @classmethod
    def describe(cls, name: str, settings: Table) -> Description:
        return Description((_AXIS,), TICK_HZ, lease_s=1e6)

    @property
    def blocks(self) -> Sequence[AnyBlock]:
        return (self._block,)

    def tick(self, now_ns: int) -> None:
        self.bank.tick(now_ns, self.bank.rows["position"].copy())

    def moves(self) -> bool:
        """Tell whether it does so for more than the moment that a halt takes."""
        for _ in range(3):
            self.tick(CLOCK() + 10_000_000)
            CLOCK.now_ns += 10_000_000
        return not self.bank.is_idle([0])


class Port(TickDriver):
    """Two outputs that do what they are told."""

    Settings = Table
    realtime_priority = 0

    def __init__(self, name: str, settings: Table, kit: Kit) -> None:
        super().__init__(name, settings, kit)
        self._block = BinaryBlock(_PORT)
        self._wanted = 0

    @classmethod
    def describe(cls, name: str, settings: Table) -> Description:
        return Description((_PORT,), TICK_HZ, lease_s=1e6)

    @property
    def blocks(self) -> Sequence[AnyBlock]:
        return (self._block,)

    def write_outputs(self, block: BlockSpec, channels: Sequence[int], values: Sequence[float]) -> None:
        self._wanted = int(values[-1])

    def tick(self, now_ns: int) -> None:
        self._block.set(0, self._wanted, now_ns)

    def moves(self) -> bool:
        """Tell whether an output is on, or will be."""
        self.tick(CLOCK())
        return self._wanted != 0


DRIVERS: dict[str, type[Driver]] = {"axis": Axis, "port": Port}


# --- what is the kernel's -----------------------------------------------------------------------------


class Timer:
    """A timer descriptor without time: the schedule says when a driver ticks."""

    def __init__(self) -> None:
        self.fd = os.eventfd(0)
        self.expired = 0

    def set(self, first_ns: int, period_ns: int = 0) -> None:
        """Nothing."""

    def expirations(self) -> int:
        """Return how many periods are over."""
        expired, self.expired = self.expired, 0
        return expired


class _Life:
    """Something that can die: others hold descriptors that become readable then."""

    def __init__(self) -> None:
        self.seen, self._held = os.pipe()

    def end(self) -> None:
        """Die."""
        if self._held >= 0:
            os.close(self._held)
            os.close(self.seen)
            self._held = -1


class Users:
    """A name service that knows the clients."""

    def __init__(self, answer_s: float = 0.0) -> None:
        pass

    def name(self, uid: int) -> str:
        return f"client{uid - FIRST_UID}"

    def uid(self, name: str) -> int:
        return FIRST_UID + int(name[-1])

    def look_again(self) -> bool:
        return True


class ForkServer:
    """Forks drivers: into this process."""

    pid = os.getpid()

    def __init__(self, loop: Loop, died: object, process: object = None) -> None:
        pass

    def describe(self, device: str, driver: str, table: dict[str, Any], folder: str, answer: Any) -> None:
        value = zlib.compress(msgpack.packb(sioms.sdk.fork_server._describe(device, driver, table, folder)), 1)
        answer(value, 0, "", [])

    def spawn(
        self, device: str, driver: str, table: dict[str, Any], generation: int, options: dict[str, Any],
        fds: Sequence[int], answer: Any,
    ) -> None:  # fmt: skip
        process = Process(device, DRIVERS[driver], msgspec.convert(table, Table), generation, options, fds)
        PROCESSES[process.pid] = process
        answer(process.pid, 0, "", [os.dup(process.life.seen)])

    def check(self, now_s: float) -> str:
        """Return that it is not stuck."""
        return ""

    def close(self) -> None:
        """Nothing."""


class Flusher:
    """A disk that needs no waiting for."""

    def __init__(self, fd: int) -> None:
        pass

    def flush(self, free_to: int = 0) -> None:
        """Nothing."""

    def end(self) -> None:
        """Nothing."""


class Patience:
    """Endless: time passes here as the schedule wants."""

    def __init__(self, pid: int, limit_s: float = 0.0) -> None:
        pass

    def renew(self, now_s: float) -> None:
        """Nothing."""

    def stuck(self, now_s: float) -> str:
        """Return that it may go on."""
        return ""


class Listener:
    """A listening socket at which clients wait whom the schedule lets in."""

    def __init__(self) -> None:
        self._fd = os.eventfd(0)
        self.coming: list[socket.socket] = []

    def fileno(self) -> int:
        return self._fd

    def setblocking(self, flag: bool) -> None:
        """Nothing."""

    def accept(self) -> tuple[socket.socket, str]:
        return self.coming.pop(), ""

    def close(self) -> None:
        os.close(self._fd)


class Process:
    """A driver process: its runtime, and its life."""

    last_pid = 1 << 22  # above all that are

    def __init__(
        self, device: str, driver: type[Driver], settings: Table, generation: int, options: dict[str, Any],
        fds: Sequence[int],
    ) -> None:  # fmt: skip
        Process.last_pid += 1
        self.pid = Process.last_pid
        self.life = _Life()
        self.options = {**options, "phase": 0.0}
        self._fds = [os.dup(fd) for fd in fds]
        self.runtime = Runtime(driver, device, settings, generation, self.options, self._fds)
        self.fds = list(self.runtime.pages.fds)
        journal = self.runtime.stops._journal
        self._append = journal.append
        journal.append = self._note  # type: ignore[method-assign]
        self.runtime.start()

    def _note(self, entry: Mapping[str, Any], now_s: float) -> None:
        """Note a stop as of this process: the daemon passes on to a driver what it has not noted itself."""
        self._append({**entry, PID: self.pid} if PID in entry else entry, now_s)

    @property
    def device(self) -> int:
        return NAMES.index(self.runtime.device)

    def turn(self) -> None:
        """Serve what the daemon has sent."""
        control = self.runtime._control
        while control.is_behind or (self.runtime._callbacks.get(control.fileno()) and is_readable(control)):
            self.runtime._control_readable()

    def tick(self, after_ns: int = 0) -> None:
        """Tick once."""
        runtime = self.runtime
        CLOCK.now_ns = max(CLOCK.now_ns, runtime._scheduled_ns + runtime.period_ns * runtime._idling.periods) + after_ns
        if not after_ns:
            runtime._moved_ns = CLOCK.now_ns  # who ends does not come to rest before its step is due
        runtime._timer.expired = 1  # type: ignore[attr-defined]
        runtime._on_timer()
        if runtime._announced:
            runtime._on_line_timer()

    def end(self) -> None:
        """Let the kernel take everything back, as at the end of a process."""
        runtime = self.runtime
        for handle in runtime.clients.handles.values():
            handle.close()
        runtime._control.close()
        runtime.clients.close()
        runtime._epoll.close()
        runtime.stops._request.close()
        runtime.stops._journal.close()
        for fd in (self._fds[1], self._fds[4], self._fds[6], runtime._timer.fd, runtime._line_timer.fd):
            os.close(fd)
        self.life.end()
        PROCESSES.pop(self.pid, None)


PROCESSES: dict[int, Process] = {}


# --- clients --------------------------------------------------------------------------------------------


class Client:
    """A client process: its session, and its handles."""

    def __init__(self, number: int) -> None:
        self.number = number
        self.pid = FIRST_UID + number
        self.life = _Life()
        self.sock: socket.socket | None = None
        self.handles: dict[int, socket.socket] = {}
        self.numbers: dict[int, int] = {}
        self.waits: dict[int, tuple[str, int]] = {}
        self.last = 0

    def ask(self, verb: ClientVerb, *arguments: object) -> int:
        """Send a request to the daemon; return its number."""
        self.last += 1
        assert self.sock is not None
        self.sock.send(encode(verb, self.last, *arguments))
        return self.last

    def take(self) -> dict[int, str]:
        """Take the daemon's answers; return by number "done" or "refused"."""
        answers: dict[int, str] = {}
        while self.sock is not None:
            try:
                packet, fds, _, _ = socket.recv_fds(self.sock, MAX_PACKET, 8)
            except (BlockingIOError, ConnectionResetError):
                break
            if not packet:
                break
            message: list[Any] = decode(packet)
            number = message[1]
            assert number not in answers, "a request is answered once"
            answers[number] = "refused" if message[2] else "done"
            what, d = self.waits.pop(number, ("", 0))
            if what == "open" and not message[2]:
                old = self.handles.pop(d, None)
                if old is not None:
                    old.close()
                self.handles[d] = socket.socket(fileno=fds.pop())
                self.handles[d].setblocking(False)
                self.numbers[d] = message[3][0]
            for fd in fds:
                os.close(fd)
        return answers

    def leave(self) -> None:
        """Lose the session; the handles stay."""
        if self.sock is not None:
            self.sock.close()
            self.sock = None
        self.waits.clear()

    def end(self) -> None:
        """Die."""
        self.leave()
        for sock in self.handles.values():
            sock.close()
        self.life.end()
