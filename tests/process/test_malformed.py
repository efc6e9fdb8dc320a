"""Truncated, oversized and senseless messages on both sockets: they end that connection, and nothing else; nothing
moves.
"""

from __future__ import annotations

import errno
import math
import os
import random
import socket
import struct
import time
from collections.abc import Callable, Iterator
from typing import Any

import msgpack
import pytest
from daemon_rig import Daemon, raises, wait_for

import sioms
from sioms.protocol.flags import PROTOCOL_VERSION, Request
from sioms.protocol.messages import MAX_INLINE, MAX_PACKET, MAX_WRITE, ClientVerb, HandleVerb, decode, encode
from sioms.protocol.records import AXIS_WRITE

SEED = 20240607
FUZZED = 2000
"""Messages to a handle, five times as many to the daemon; millions are for the bench."""


class Raw:
    """A session without the client library."""

    def __init__(self, path: str) -> None:
        self.sock = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self.sock.settimeout(10.0)
        self.sock.connect(path)

    def ask(self, *parts: object) -> tuple[list[Any], list[int]]:
        """Send a message and return the reply."""
        self.sock.send(encode(*parts))
        packet, fds, _, _ = socket.recv_fds(self.sock, MAX_PACKET, 4)
        return decode(packet), fds

    def is_ended(self) -> bool:
        """Whether the other side closes; replies before that are read away."""
        try:
            while self.sock.recv(MAX_PACKET):
                pass
        except ConnectionResetError:
            return True
        except TimeoutError:
            return False
        return True

    def close(self) -> None:
        self.sock.close()


@pytest.fixture
def raw(daemon: Daemon) -> Iterator[Callable[[], Raw]]:
    opened: list[Raw] = []

    def connect() -> Raw:
        opened.append(Raw(daemon.socket))
        return opened[-1]

    yield connect
    for one in opened:
        one.close()


@pytest.fixture
def handle(raw: Callable[[], Raw]) -> Callable[[str, int], tuple[Raw, Raw]]:
    """Open a node by hand: returns (session, handle socket)."""

    def open_node(name: str, mode: int = 3) -> tuple[Raw, Raw]:
        session = raw()
        reply, fds = session.ask(ClientVerb.OPEN, 1, name, mode, 5.0, 0.0)
        assert reply[2] == 0, reply
        other = Raw.__new__(Raw)
        other.sock = socket.socket(fileno=fds[2])
        other.sock.settimeout(10.0)
        for fd in fds[:2]:
            os.close(fd)
        return session, other

    return open_node


class Bystander:
    """A session and an axis that must not notice anything."""

    def __init__(self, daemon: Daemon) -> None:
        self.pids = {d["name"]: (d["pid"], d["generation"]) for d in _devices(daemon)}
        self.daemon = daemon
        self.cell = daemon.cell("bystander")
        self.node = self.cell.open("mod1", "rw", timeout=3.0)
        self.node.move(0.0)
        self.node.wait_until_idle(5.0)

    def check(self) -> None:
        assert {d["name"]: (d["pid"], d["generation"]) for d in _devices(self.daemon)} == self.pids
        self.node.move(0.001)
        self.node.move(0.0)
        self.node.wait_until_idle(5.0)
        # After a tick that came late the axis has to swing back.
        wait_for(lambda: abs(self.node.read().position[0]) < 2e-3, "mod1 back at 0", 2.0)
        self.cell.close()


def _devices(daemon: Daemon) -> list[dict[str, Any]]:
    with daemon.cell() as cell:
        return list(cell.status()["devices"])


@pytest.fixture
def bystander(daemon: Daemon) -> Iterator[Bystander]:
    """Checked at the end of each test."""
    one = Bystander(daemon)
    yield one
    one.check()


HUGE = [
    b"\xc1", b"", b"\x93\x01", b"\xdd\xff\xff\xff\xff", b"\xdf\xff\xff\xff\xff", b"\xc6\xff\xff\xff\xff",
    encode(1), encode("1", 2), encode(-1, 1), encode(1, -1), encode(True, 1), encode(2.0, 1), encode(1 << 60, 1),
    encode(ClientVerb.HELLO, 1 << 60), encode(200, 1), encode(0, 1, 0, None), b"\x91" * 2000 + b"\x01",
]  # fmt: skip
BAD_SESSION = [
    *HUGE,
    encode(ClientVerb.HELLO, 0, PROTOCOL_VERSION, "x"),
    encode(ClientVerb.HELLO, 1),
    encode(ClientVerb.OPEN, 1, "mod0"),
    encode(ClientVerb.OPEN, 1, "mod0", "r", 0, 0),
    encode(ClientVerb.OPEN, 1, "mod0", math.inf, 0, 0),
    encode(ClientVerb.OPEN, 1, "mod0", math.nan, 0, 0),
    encode(ClientVerb.OPEN, 1, "mod0.readonly", 1, 0, [1]),
    encode(ClientVerb.CLOSE, 1, [1]),
    encode(ClientVerb.RESERVE_MARKER, 1, math.inf, False),
    encode(ClientVerb.FREE_MARKER, 1, math.inf),
    encode(ClientVerb.SIGNAL_MARKER, 1, None),
    encode(ClientVerb.WAIT_MARKER, 1, {}, 1.0),
    encode(ClientVerb.CANCEL, 1, math.inf),
    encode(ClientVerb.INFO, 1),
    bytes(MAX_PACKET + 1),
]
DEEP = [
    head + b"\x91" * depth + b"\xc0" + tail
    for depth in (17, 1000, 1015, 20_000)
    for head, tail in (
        (b"\x95\x02\x01" + bytes([Request.GET_STATISTICS]), b"\x00"),  # as the argument of a request
        (b"\x92", b"\x01"),  # as the verb
        (b"\x95\x02", b"\x00\x00\x00"),  # as the message number
    )
]
"""Lists within lists, at places where a value is wanted."""
BAD_HANDLE = [
    *HUGE,
    *DEEP,
    encode(HandleVerb.IOCTL, 1, Request.GET_STATISTICS, [[]] * 10_000, 0.0),
    encode(HandleVerb.IOCTL, 1, Request.GET_STATISTICS, msgpack.Timestamp(0), 0.0),
    encode(HandleVerb.IOCTL, 1, Request.GET_STATISTICS, msgpack.ExtType(5, b"x"), 0.0),
    encode(HandleVerb.IOCTL, 1, Request.GET_STATISTICS, None, True),
    b"\x95\x02\x01" + bytes([Request.GET_STATISTICS]) + b"\xa3\xed\xa0\x80\x00",  # a surrogate as text
    encode(HandleVerb.KEEPALIVE, 0, 1),
    encode(HandleVerb.WRITE, 0, 0, 0.0, b""),
    encode(HandleVerb.WRITE, 1),
    encode(HandleVerb.WRITE, 1, 0, 0.0, None),
    encode(HandleVerb.WRITE, 1, math.inf, 0.0, bytes(AXIS_WRITE.size)),
    encode(HandleVerb.WRITE, 1, 0, math.nan, bytes(AXIS_WRITE.size)),
    encode(HandleVerb.WRITE, 1, 0, "soon", bytes(AXIS_WRITE.size)),
    encode(HandleVerb.WRITE, 1, 0, 0.0, 7),
    encode(HandleVerb.IOCTL, 1, math.inf, None, 0.0),
    encode(HandleVerb.IOCTL, 1, [], None, 0.0),
    encode(HandleVerb.SUBSCRIBE, 1, math.inf),
    encode(HandleVerb.SUBSCRIBE, 1),
    encode(HandleVerb.CANCEL, 1, math.inf),
    bytes(MAX_PACKET + 1),
]


def test_bad_messages_end_their_sessions_only(bystander: Bystander, raw: Callable[[], Raw]) -> None:
    for packet in BAD_SESSION:
        session = raw()
        session.sock.send(packet)
        assert session.is_ended(), packet[:40]


ODD_ARGUMENTS: list[tuple[Request, object]] = [
    (Request.SEND_EXTERNAL_SYNCH, math.inf),
    (Request.SEND_EXTERNAL_SYNCH, []),
    (Request.SEND_EXTERNAL_SYNCH, True),
    (Request.GET_STATISTICS, [[[[[[[1]]]]]]]),
    (Request.GET_STATISTICS, 1 << 63),
    (Request.GET_STATISTICS, "x" * 40_000 + "\x1b[2J"),
    (Request.SET_LIMITS, []),
    (Request.SET_LIMITS, {"axes": [0]}),
    (Request.SET_LIMITS, {"self": 1}),
    (Request.SET_LIMITS, {"velocity_max": "fast"}),
    (Request.SET_LIMITS, {"velocity_max": [{}]}),
    (Request.SET_LIMITS, {"velocity_max": True}),
    (Request.CALIBRATE_DEVICE, {"a": 1}),
    (Request.CALIBRATE_DEVICE, [[]]),
    (Request.SET_GAINS, 1),
]


def test_an_odd_argument_is_refused_with_a_sentence_fit_to_be_shown(
    bystander: Bystander, handle: Callable[..., tuple[Raw, Raw]]
) -> None:
    _, node = handle("mod0.xaxis")
    for number, (request, argument) in enumerate(ODD_ARGUMENTS, 1):
        if (request, argument) == (Request.GET_STATISTICS, 1 << 63):
            continue  # as good as all ticks
        reply, _ = node.ask(HandleVerb.IOCTL, number, request, argument, 0.0)
        assert reply[1] == number and reply[2] in (errno.EINVAL, errno.ENOTTY), (request, argument, reply)
        assert reply[3].isprintable() and len(reply[3]) < 300, reply


def test_bad_messages_end_their_handles_only(
    bystander: Bystander, handle: Callable[..., tuple[Raw, Raw]], cell: sioms.Workcell
) -> None:
    for packet in BAD_HANDLE:
        session, node = handle("mod0.xaxis")
        node.sock.send(packet)
        assert node.is_ended(), packet[:40]
        assert session.ask(ClientVerb.STATUS, 2)[0][2] == 0, f"the session lives on after {packet[:40]!r}"
        cell.open("mod0.xaxis", "rw", timeout=2.0).close()
        session.close()


def test_end_of_a_session_is_told_in_the_log(start_daemon: Callable[..., Daemon]) -> None:
    daemon = start_daemon()  # of its own: what many sessions do at once is counted in the log, not told one by one
    session = Raw(daemon.socket)
    session.sock.send(encode(250, 1, "oddity"))
    assert session.is_ended()
    session.close()
    daemon.said(r'level=warning event="session ended" peer="pid \d+ \(\w+\)" why="verb 250 does not exist"')


def _texts(value: object) -> Iterator[str]:
    """Every text in an answer."""
    if isinstance(value, str):
        yield value
    elif isinstance(value, dict | list | tuple):
        for each in value.values() if isinstance(value, dict) else value:
            yield from _texts(each)


def test_no_text_of_a_client_reaches_log_or_status_raw(start_daemon: Callable[..., Daemon]) -> None:
    daemon = start_daemon()
    name = "eva\x1b[2J\r\nlevel=error event=forged \u202eoperator"
    with daemon.cell(name) as cell, cell.open("mod0", "rw", timeout=5.0) as node:
        cell.emergency_stop("mod0", why="hot\x07\x1b]0;x\x07")
        texts = [*_texts(cell.status()), *(entry.holder for entry in cell.nodes())]
        with pytest.raises(OSError, match="held by") as caught, daemon.cell() as other:
            other.open("mod0", "rw")
        texts.append(str(caught.value))
        cell.reset("mod0")
        node.close()
    lines = [line.rstrip("\n") for line in daemon.running.lines]
    assert sum("eva" in text for text in texts) >= 3 and any("eva" in line for line in lines)
    assert all(text.isprintable() for text in texts + lines), texts
    assert not any(line.startswith("level=error event=forged") for line in lines)


def test_a_client_learns_why_its_handle_ended(daemon: Daemon, cell: sioms.Workcell) -> None:
    node = cell.open("mod0.xaxis", "rw", timeout=3.0)
    node._channel._sock.send(encode(HandleVerb.WRITE, 1))
    with raises(errno.EPROTO, "mod0.xaxis: malformed message"):
        wait_for(lambda: node.command(velocity=0.0) and False, "refused")
    node.close()


def test_hello_of_another_version_is_refused(raw: Callable[[], Raw]) -> None:
    reply, _ = raw().ask(ClientVerb.HELLO, 1, PROTOCOL_VERSION + 1, "future")
    assert reply[2] == errno.EPROTO and f"speaks {PROTOCOL_VERSION}" in reply[3]


@pytest.mark.parametrize("size", [0, 1, AXIS_WRITE.size - 1, AXIS_WRITE.size + 1])
def test_cut_records_are_refused(cell: sioms.Workcell, size: int) -> None:
    with cell.open("mod0.xaxis", "rw", timeout=3.0) as axis:
        with raises(errno.EINVAL, f"{size} bytes; want whole records of {AXIS_WRITE.size} bytes"):
            axis.write(bytes(size))
        assert not axis.read().in_motion[0]


def test_a_write_larger_than_allowed_is_refused_by_both_sides(
    cell: sioms.Workcell, handle: Callable[..., tuple[Raw, Raw]]
) -> None:
    with cell.open("mod0.xaxis", "rw", timeout=3.0) as axis, raises(errno.EMSGSIZE, str(MAX_WRITE)):
        axis.write(bytes(MAX_WRITE + AXIS_WRITE.size))
    _, node = handle("mod0.xaxis")
    part = bytes(MAX_INLINE)
    for _ in range(2 * MAX_WRITE // MAX_INLINE):
        node.sock.sendall(encode(HandleVerb.PART, 0, 1, part))
    node.sock.sendall(encode(HandleVerb.WRITE, 1, 0, 0.0, bytes(AXIS_WRITE.size)))
    reply = decode(node.sock.recv(MAX_PACKET))
    assert reply[2] == errno.EMSGSIZE, reply


def test_parts_of_a_write_that_never_came_are_dropped(handle: Callable[..., tuple[Raw, Raw]]) -> None:
    _, node = handle("mod0.xaxis")
    good = sioms.command(0, position=0.0)
    node.sock.sendall(encode(HandleVerb.PART, 0, 1, bytes(AXIS_WRITE.size)))
    node.sock.sendall(encode(HandleVerb.WRITE, 2, 0, 0.0, good))
    assert decode(node.sock.recv(MAX_PACKET))[2] == 0
    node.sock.sendall(encode(HandleVerb.PART, 0, 3, good[:100]))
    node.sock.sendall(encode(HandleVerb.WRITE, 3, 0, 0.0, good[100:]))
    assert decode(node.sock.recv(MAX_PACKET))[2] == 0


@pytest.mark.parametrize("arguments", [(), (1,), (1, "text"), ("1", b""), (1, bytes(MAX_INLINE + 1)), (1, b"", 2)])
def test_a_malformed_part_ends_the_connection(
    handle: Callable[..., tuple[Raw, Raw]], arguments: tuple[object, ...]
) -> None:
    _, node = handle("mod0.xaxis")
    node.sock.sendall(encode(HandleVerb.PART, 0, *arguments))
    assert decode(node.sock.recv(MAX_PACKET))[2] == errno.EPROTO
    assert node.is_ended()


def test_descriptors_sent_along_do_not_pile_up(daemon: Daemon, handle: Callable[..., tuple[Raw, Raw]]) -> None:
    pid = daemon.device("mod0")["pid"]
    _descriptors = lambda: len(os.listdir(f"/proc/{pid}/fd"))  # noqa: E731
    before = _descriptors()
    null = os.open("/dev/null", os.O_RDONLY)
    for packet in (encode(HandleVerb.KEEPALIVE, 0), encode(HandleVerb.SUBSCRIBE, 1, 0), b""):
        session, node = handle("mod0.readonly", 1)
        for _ in range(3):
            try:
                socket.send_fds(node.sock, [packet], [null] * 5)
            except OSError:
                break
        node.sock.shutdown(socket.SHUT_WR)
        node.is_ended()
        session.close()
        node.close()
    os.close(null)
    wait_for(lambda: _descriptors() <= before, f"descriptors back to {before}, now {_descriptors()}")


WORDS: list[object] = [
    None,
    True,
    False,
    0,
    1,
    -1,
    2,
    3,
    64,
    1 << 31,
    1 << 32,
    (1 << 63) - 1,
    1 << 63,
    -(1 << 63),
    0.0,
    -0.0,
    1e308,
    -1e308,
    math.inf,
    -math.inf,
    math.nan,
    5e-324,
    "",
    "mod0",
    "mod0.xaxis",
    "io0",
    "force0",
    "\0",
    "x" * 5000,
    b"",
    b"\0" * 144,
    b"\xff" * 144,
    b"\xff" * 1008,
    [],
    [0],
    [[]],
    [math.nan],
    [1e308],
    list(range(50)),
    {},
    {"position_max": 0.1},
    {"position_max": math.nan},
    {"": None},
    {"velocity_max": "fast"},
    msgpack.Timestamp(0),
    msgpack.ExtType(5, b"x"),
]


def _fuzz(chance: random.Random, verbs: list[int], number: int) -> bytes:
    """Return a message that looks right at the beginning and is odd in its arguments, or odd bytes."""
    kind = chance.random()
    if kind < 0.05:
        return chance.randbytes(chance.randrange(0, 200))
    arguments = [chance.choice(WORDS) for _ in range(chance.randrange(0, 7))]
    packet = encode(chance.choice(verbs), number, *arguments)
    if kind < 0.15 and packet:
        where = chance.randrange(len(packet))
        packet = packet[:where] + bytes([chance.randrange(256)]) + packet[where + 1 :]
    elif kind < 0.2:
        packet = packet[: chance.randrange(len(packet))]
    return packet


HARMLESS = [v for v in ClientVerb if v not in (ClientVerb.EMERGENCY_STOP, ClientVerb.RELOAD)]


def test_fuzzed_sessions_do_nothing(bystander: Bystander, daemon: Daemon, raw: Callable[[], Raw]) -> None:
    chance = random.Random(SEED)
    sent = ended = 0
    session = raw()
    session.sock.settimeout(0.0)
    while sent < 5 * FUZZED:
        try:
            session.sock.send(_fuzz(chance, [int(v) for v in HARMLESS], chance.randrange(1, 1 << 40)))
            sent += 1
            while True:
                _, fds, _, _ = socket.recv_fds(session.sock, MAX_PACKET, 8)
                for fd in fds:
                    os.close(fd)
                if not _:
                    raise BrokenPipeError
        except BlockingIOError:
            continue
        except OSError:
            ended += 1
            session.close()
            session = Raw(daemon.socket)
            session.sock.settimeout(0.0)
    session.close()
    print(f"{sent} messages sent to the daemon, {ended} sessions ended by them")
    assert ended > 10


@pytest.mark.parametrize("name", ["mod0", "force0", "io0"])
def test_fuzzed_handles_move_nothing(bystander: Bystander, daemon: Daemon, name: str) -> None:
    chance = random.Random(SEED)
    verbs = [int(v) for v in HandleVerb]
    sent = ended = 0
    with daemon.cell("fuzz") as cell:
        start = cell.open(f"{name}.readonly" if name != "force0" else name)
        before = start.read()
        while sent < FUZZED:
            node = cell.open(name, "r" if name == "force0" else "rw", timeout=5.0)
            sock = socket.socket(fileno=os.dup(node._channel.fileno()))
            sock.setblocking(False)
            try:
                while sent < FUZZED:
                    packet = _fuzz(chance, verbs, chance.randrange(1, 1 << 40))
                    sock.send(_without_stop(packet))
                    sent += 1
                    try:
                        while sock.recv(MAX_PACKET):
                            pass
                        break
                    except BlockingIOError:
                        continue
            except BlockingIOError:
                time.sleep(0.001)
            except OSError:
                ended += 1
            finally:
                sock.close()
                node.close()
        cell.reset(name)
        print(f"{sent} messages sent to the driver of {name}, {ended} handles ended by them")
        assert ended > 5
        after = start.read()
        if name == "mod0":
            for a, b in zip(before.position, after.position, strict=True):
                assert abs(a - b) < 2e-3, "an axis has moved"
        assert daemon.device(name)["generation"] == bystander.pids[name][1]


def _without_stop(packet: bytes) -> bytes:
    """Leave out the requests whose very meaning is to change where an axis counts from."""
    try:
        message = decode(packet)
    except Exception:
        return packet
    moved = (Request.ZERO_DEVICE, Request.CALIBRATE_DEVICE, Request.HOME)
    return encode(HandleVerb.KEEPALIVE, 0) if len(message) > 2 and message[2] in moved else packet


@pytest.mark.parametrize("bits", [struct.pack("<d", math.nan), struct.pack("<d", math.inf), b"\xff" * 8])
def test_no_field_of_a_record_takes_what_is_not_finite(cell: sioms.Workcell, bits: bytes) -> None:
    """Every double of the record, with every flag that makes it hold: refused, and nothing moves."""
    words = {
        "position": {},
        "velocity": {},
        "acceleration": {},
        "jerk": {},
        "force": {},
        "force_velocity": {},
        "time": {"position": 0.0},
        "max_velocity": {"position": 0.0, "max_acceleration": 1.0},
        "max_acceleration": {"position": 0.0, "max_velocity": 1.0},
        "k": {"position": 0.0, "kz": 0, "kp": 0, "kb": 0},
        "kz": {"position": 0.0, "k": 1, "kp": 0, "kb": 0},
        "kp": {"position": 0.0, "k": 1, "kz": 0, "kb": 0},
        "kb": {"position": 0.0, "k": 1, "kz": 0, "kp": 0},
        "force_offset": {"position": 0.0},
        "max_force": {"position": 0.0},
    }
    value = struct.unpack("<d", bits)[0]
    with cell.open("mod0.xaxis", "rw", timeout=3.0) as axis:
        for name, others in words.items():
            with raises(errno.EINVAL, name):
                axis.command(0, **{name: value}, **others)
        reading = axis.read()
        assert reading.buffered[0] == 0 and not reading.in_motion[0]


def test_who_is_no_gateway_does_not_say_how_old_its_words_are(raw: Callable[[], Raw]) -> None:
    session = raw()
    assert session.ask(ClientVerb.LIST, 1)[0][2] == 0
    session.sock.send(encode(ClientVerb.SAID, 0, 7))
    assert session.is_ended()
