"""Malformed frames on live sockets, of the daemon and of drivers: no crash, no stray exception, no motion.

Frames are random bytes, and valid messages with bytes changed, cut, inserted, or arguments exchanged.
A mutation may by chance be a valid request; those count as answered. What must never happen: a process
dies, an exception goes to the log, a node cannot be opened afterwards, or an axis moves without a write
that was acknowledged.
"""

from __future__ import annotations

import contextlib
import errno
import random
import socket
import time
from collections import Counter
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from sioms.check.daemon import Daemon, descriptors
from sioms.descriptors import receive
from sioms.protocol.flags import PROTOCOL_VERSION, ControlMode, Request
from sioms.protocol.messages import (
    MAX_UNPACKED,
    ClientVerb,
    HandleVerb,
    MalformedMessage,
    decode,
    encode,
)
from sioms.protocol.records import AXIS_WRITE

from .figures import Bar, Report
from .workcells import axes, workcell

BATCH = 400
LONGEST_S = 10.0
"""A daemon or driver that has not answered by then hangs."""
ASKED = 1 << 40
"""Numbers of requests that are answered at once, sent behind each frame; frames have numbers below."""
LIVE = ("daemon socket", "reader's handle", "writer's handle")
HISTORY = 4096
NAN = float("nan")
STRANGE: tuple[Any, ...] = (
    None,
    True,
    -1,
    0,
    1,
    2**31,
    2**53,
    2**63,
    -(2**63),
    1e308,
    NAN,
    float("inf"),
    "",
    "mod0",
    "x" * 300,
    b"",
    b"\0" * 144,
    [],
    [[]],
    {},
    {"a": 1},
    [None] * 40,
    [[[[[[[[[[1]]]]]]]]]],
    "eva\x1b[2J\r\n",
)
STRAY = ("Traceback", "driver failed", "level=error")


def bench_live(names: Sequence[str], frames: int, seed: int, report: Report) -> int:
    """Send frames to live sockets and look at what they left; return how many were sent."""
    slow = partial(axes, tick_hz=100.0, axis_keys="bandwidth_hz = 5.0", history=HISTORY)  # not ticks are what is tried
    config = workcell([slow("mod0"), slow("mod1")])
    with Daemon(config) as daemon:
        pids = {"daemon": daemon.pid, **daemon.device_pids()}
        before = {who: descriptors(pid) for who, pid in pids.items()}
        fuzz = _Fuzz(daemon, random.Random(seed))
        for name in names:
            begin, first = time.monotonic(), fuzz.sent
            until = first + frames // len(names)
            fuzz.outcomes.clear()
            try:
                while fuzz.sent < until:
                    fuzz.batch(name)
                    report.progress(f"{name}: {fuzz.sent - first} of {until - first}")
            except OSError as error:
                report.note(f"{name}: given up after {fuzz.sent - first} frames: {error}")
            took = time.monotonic() - begin
            outcomes = ", ".join(f"{what} {count}" for what, count in sorted(fuzz.outcomes.items()))
            report.value(name, fuzz.sent - first, notes=f"{(fuzz.sent - first) / took:.0f} a second; {outcomes}",
                         bars=[Bar("value", until - first, at_least=True)])  # fmt: skip
        with contextlib.suppress(OSError):  # what is left is looked at whether it still answers or not
            fuzz.close()
        dead = daemon.ended()
        alive = {"daemon": 0} if dead else {"daemon": daemon.pid, **daemon.device_pids()}
        deaths = sum(alive.get(who) != pid for who, pid in pids.items())
        stray = [line for line in daemon.log().splitlines() if any(word in line for word in STRAY)]
        left = _left(before, {who: pid for who, pid in pids.items() if alive.get(who) == pid})
        zero = [Bar("value", 0)]
        report.value("processes that died", deaths, "", bars=zero)
        report.value("stray exceptions in the log", len(stray), "", bars=zero, notes="; ".join(stray[:2])[:600])
        report.value("motions without an acknowledged write", fuzz.motions, "", bars=zero)
        report.value("descriptors left open", left, "", bars=zero)
        return fuzz.sent


def _left(before: dict[str, int], pids: dict[str, int]) -> int:
    """Return how many descriptors the processes have more than before, when the last closes are through."""
    for _ in range(20):
        left = sum(max(0, descriptors(pid) - before[who]) for who, pid in pids.items())
        if not left:
            break
        time.sleep(0.1)
    return left


class _Fuzz:
    """Connections that frames go to, and the axes that must not move.

    Attributes:
        sent: frames so far.
        outcomes: how many frames were answered, refused, or ended their connection.
        motions: snapshots in motion in batches without an acknowledged write.
    """

    def __init__(self, daemon: Daemon, generator: random.Random) -> None:
        self.sent = 0
        self.outcomes: Counter[str] = Counter()
        self.motions = 0
        self._daemon = daemon
        self._random = generator
        self._cell = daemon.cell("watcher")
        self._watched = [self._cell.open(f"mod{i}.readonly") for i in range(2)]
        self._seen = [node.read().number for node in self._watched]
        self._accepted = 0

    def batch(self, name: str) -> None:
        """Send a batch to one of the sockets; then look."""
        self._accepted = 0
        match name:
            case "daemon socket":
                self._send(self._to_daemon, _client_message, BATCH)
            case "reader's handle":
                self._send(lambda: self._to_driver("mod0.readonly"), _handle_message, BATCH)
            case _:
                self._send(lambda: self._to_driver("mod1"), _handle_message, BATCH)
        for i, node in enumerate(self._watched):
            snapshots = node.history(self._seen[i])
            if snapshots:
                self._seen[i] = snapshots[-1].number
            if not self._accepted:
                self.motions += sum(any(s.in_motion) for s in snapshots)
        if self._cell.status()["stopped_ns"]:
            self._cell.reset()
        for i in range(2):
            self._cell.reset(f"mod{i}")

    def close(self) -> None:
        """Close the watcher; every node must still open and read."""
        for watched in self._watched:
            watched.close()
        self._cell.close()
        with self._daemon.cell() as cell:
            for i in range(2):
                with cell.open(f"mod{i}", "rw", 5.0) as node:
                    node.read()

    def _send(self, connect: Callable[[], socket.socket], make: Callable[[random.Random], bytes], count: int) -> None:
        """Send frames; after one that ended its connection connect anew."""
        sock = connect()
        try:
            for i in range(count):
                # A cancellation of what is not under way is answered at once, by daemon and drivers alike.
                verb = ClientVerb.CANCEL if make is _client_message else HandleVerb.CANCEL
                if not self._one(sock, self._frame(make), encode(verb, ASKED + i, ASKED), ASKED + i):
                    sock.close()
                    sock = connect()
        finally:
            sock.close()

    def _one(self, sock: socket.socket, frame: bytes, asked: bytes, number: int) -> bool:
        """Send a frame, and a request that is answered at once; return whether the connection lives."""
        self.sent += 1
        said = ""
        try:
            sock.send(frame)
            sock.send(asked)
            while answer := sock.recv(1 << 17):
                message: list[Any] = decode(answer, MAX_UNPACKED)
                if message[1] == number:
                    self.outcomes[said or "silent"] += 1  # it waits, or needs no answer
                    return True
                said = "refused" if message[2] else "answered"
                if not message[2] and message[1]:
                    self._accepted += 1
        except OSError as error:
            if error.errno not in (errno.EPIPE, errno.ECONNRESET):
                raise
        self.outcomes["ended"] += 1
        return False

    def _frame(self, make: Callable[[random.Random], bytes]) -> bytes:
        while True:
            frame = self._mutate(make(self._random))
            try:
                message = decode(frame)
            except MalformedMessage:
                return frame
            # A reload is valid without arguments and starts processes: not what is tried here.
            if make is not _client_message or message[0] != ClientVerb.RELOAD:
                return frame

    def _mutate(self, frame: bytes) -> bytes:
        pick, data = self._random.random(), bytearray(frame)
        if pick < 0.15:
            return self._random.randbytes(self._random.choice((1, 2, 7, 30, 200, 5000)))
        for _ in range(self._random.randint(0, 3)):
            at = self._random.randrange(len(data))
            how = self._random.randrange(4)
            if how == 0:
                data[at] = self._random.randrange(256)
            elif how == 1:
                data[at] ^= 1 << self._random.randrange(8)
            elif how == 2:
                data[at:at] = self._random.randbytes(self._random.randint(1, 4))
            else:
                del data[at : at + self._random.randint(1, 8)]
            if not data:
                return b"\xc1"
        return bytes(data)

    def _to_daemon(self) -> socket.socket:
        sock = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        sock.connect(self._daemon.socket)
        sock.settimeout(LONGEST_S)
        return sock

    def _to_driver(self, node: str) -> socket.socket:
        """Open a node by hand and keep only its socket to the driver; the session lives as long as it is needed."""
        session = self._to_daemon()
        session.send(encode(ClientVerb.HELLO, 1, PROTOCOL_VERSION, "fuzz"))
        _, fds = receive(session, 65536, 4)
        _close(fds)
        session.send(encode(ClientVerb.OPEN, 2, node, 3 if "." not in node else 1, 10.0, 0.0))
        packet, fds = receive(session, 65536, 4)
        message: list[Any] = decode(packet)
        if message[2]:
            raise OSError(message[2], message[3])
        _close(fds[:2])
        sock = _Held(fds[2], session)
        sock.settimeout(LONGEST_S)
        return sock


class _Held(socket.socket):
    """A handle's socket that keeps its session; both close together."""

    def __init__(self, fd: int, session: socket.socket) -> None:
        super().__init__(fileno=fd)
        self._session = session

    def close(self) -> None:
        """Close the handle, then the session."""
        super().close()
        self._session.close()


def _close(fds: list[int]) -> None:
    for fd in fds:
        socket.close(fd)


def _strange(generator: random.Random, parts: list[Any]) -> bytes:
    """Exchange an argument, drop one, or add one, now and then."""
    pick = generator.random()
    if pick < 0.4 and len(parts) > 2:
        parts[generator.randrange(2, len(parts))] = generator.choice(STRANGE)
    elif pick < 0.5:
        parts.append(generator.choice(STRANGE))
    elif pick < 0.6:
        parts.pop()
    return encode(*parts)


def _client_message(generator: random.Random) -> bytes:
    """Return a message to the daemon, valid or with strange arguments."""
    number = generator.randint(1, 1 << 20)
    messages: list[list[Any]] = [
        [ClientVerb.HELLO, number, PROTOCOL_VERSION, "fuzz"],
        [
            ClientVerb.OPEN,
            number,
            generator.choice(("mod0", "mod1.a1", "mod0.plant", "nowhere")),
            3,
            0.0,
            0.0,
        ],
        [ClientVerb.CLOSE, number, generator.randint(0, 5)],
        [ClientVerb.LIST, number],
        [ClientVerb.INFO, number, "mod0.a0"],
        [ClientVerb.STATUS, number],
        [ClientVerb.RESERVE_MARKER, number, 3, False],
        [ClientVerb.FREE_MARKER, number, generator.getrandbits(50)],
        [ClientVerb.SIGNAL_MARKER, number, generator.getrandbits(50)],
        [ClientVerb.WAIT_MARKER, number, generator.randint(0, 2000), 0.0],
        [ClientVerb.EMERGENCY_STOP, number, generator.choice(("", "mod0", "x")), "fuzz", generator.random() < 0.5],
        [ClientVerb.RESET, number, generator.choice(("", "mod1"))],
        [ClientVerb.CANCEL, number, generator.randint(0, 9)],
    ]
    return _strange(generator, generator.choice(messages))


def _handle_message(generator: random.Random) -> bytes:
    """Return a message to a driver; its records are never valid as they are: every number in them is NaN."""
    number = generator.randint(1, 1 << 20)
    mode = generator.choice([*ControlMode, ControlMode(0x7FFF), ControlMode.POSITION | ControlMode.SPECIFIED_TIME])
    record = AXIS_WRITE.pack(generator.randint(-1, 5), int(mode), generator.getrandbits(50), 0, *[NAN] * 15)
    messages: list[list[Any]] = [
        [HandleVerb.WRITE, number, generator.randint(0, 3), 0.0, record * generator.randint(1, 3)],
        [HandleVerb.WRITE, number, 1, 0.0, record[: generator.randint(0, 144)]],
        [HandleVerb.WRITE, number, 0, 0.0, None],
        [HandleVerb.IOCTL, number, int(generator.choice(list(Request))), None, 0.0],
        [HandleVerb.IOCTL, number, int(Request.SET_LIMITS), {"position_max": NAN, "nothing": 1}, 0.0],
        [HandleVerb.IOCTL, number, int(Request.CALIBRATE_DEVICE), [NAN] * generator.randint(0, 5), 0.0],
        [HandleVerb.IOCTL, number, int(Request.SEND_EXTERNAL_SYNCH), generator.getrandbits(62), 0.0],
        [HandleVerb.SUBSCRIBE, number, generator.randint(-5, 100)],
        [HandleVerb.CANCEL, number, generator.randint(0, 9)],
        [HandleVerb.KEEPALIVE, 0],
    ]
    return _strange(generator, generator.choice(messages))
