"""UDP sockets that hear one device, and the TCP connection beside a line. Real sockets of the loopback, no sleeping."""

from __future__ import annotations

import errno
import socket
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import msgspec
import pytest

from sioms.descriptors import is_readable
from sioms.sdk.connection import Connection
from sioms.sdk.datagram import Datagrams
from sioms.sdk.exchange import DeviceError, Exchange, LinkError, SideExchange, Steps
from sioms.sdk.line import Counters, Line, Priority
from sioms.sdk.settings import LineSettings
from sioms.sdk.side_connection import SideConnection


def readable(fd: Any, wait_s: float = 2.0) -> None:
    assert is_readable(fd, wait_s), "nothing came"


@pytest.fixture
def device() -> Iterator[socket.socket]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind(("127.0.0.1", 0))
        yield sock


def name_of(sock: socket.socket) -> str:
    return "{}:{}".format(*sock.getsockname())


def test_datagrams_keep_their_bounds_and_strangers_are_counted(device: socket.socket) -> None:
    strangers: list[int] = []
    line = Datagrams(name_of(device), "127.0.0.1:0", lambda: strangers.append(1))
    try:
        line.write(b"hello")
        readable(device)
        data, host = device.recvfrom(100)
        assert data == b"hello" and line.read() == b""
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
            other.sendto(b"forged", host)
            device.sendto(b"", host)
            device.sendto(b"one", host)
            device.sendto(b"two", host)
            for _ in range(40):
                other.sendto(b"flood", host)
            readable(line)
            assert [line.read(), line.read()] == [b"one", b"two"]
            assert line.read() == b"" and len(strangers) == 1 + 16, "others have their turn in a flood"
            while is_readable(line):
                assert line.read() == b""
            assert len(strangers) == 41
    finally:
        line.close()


def test_any_port_of_the_host_and_no_other_host(device: socket.socket) -> None:
    strangers: list[int] = []
    line = Datagrams("127.0.0.1:0", "127.0.0.1:0", lambda: strangers.append(1))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.2", 0))
        host = line._sock.getsockname()
        other.sendto(b"other", host)
        device.sendto(b"ours", host)
        readable(line)
        assert line.read() == b"ours" and strangers == [1]
    line.close()


def test_ipv6_and_names() -> None:
    with socket.socket(socket.AF_INET6, socket.SOCK_DGRAM) as device:
        try:
            device.bind(("::1", 0))
        except OSError:
            pytest.skip("this machine has no IPv6")
        line = Datagrams(f"[::1]:{device.getsockname()[1]}", "", lambda: pytest.fail("no stranger"))
        line.write(b"six")
        readable(device)
        device.sendto(b"yes", device.recvfrom(100)[1])
        readable(line)
        assert line.read() == b"yes"
        line.close()
    named = Datagrams("localhost:9", "127.0.0.1:0", lambda: None)
    assert named._host == "127.0.0.1"
    named.close()


def test_a_closed_port_a_taken_port_and_an_unknown_host() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        closed = name_of(probe)
        with pytest.raises(OSError, match=f"listen on {closed} for 127.0.0.1:9: address already in use"):
            Datagrams("127.0.0.1:9", closed, lambda: None)
    line = Connection(LineSettings(udp=closed))
    line.write(b"anybody")
    readable(line.fd)
    with pytest.raises(OSError, match=f"{closed}: nothing takes datagrams at this port; check host") as caught:
        line.read()
    assert caught.value.errno == errno.ECONNREFUSED
    line.close()
    with pytest.raises(OSError, match=r"find the host no\.such\.invalid: "):
        Connection(LineSettings(udp="no.such.invalid:1"))


def test_addresses_are_checked() -> None:
    for table in (
        {"udp": "h:0"},
        {"udp": "h"},
        {"tcp": ":1"},
        {"udp": "h:1", "local": "x"},
        {"tcp": "h:70000"},
    ):
        with pytest.raises(msgspec.ValidationError, match=r'want "host:port" with a port from [01] to 65535'):
            msgspec.convert(table, LineSettings)
    assert msgspec.convert({"udp": "h:0", "local": "0.0.0.0:5"}, LineSettings).udp == "h:0"


# --- beside the line ------------------------------------------------------------------------------


@pytest.fixture
def server() -> Iterator[socket.socket]:
    with socket.create_server(("127.0.0.1", 0)) as sock:
        sock.settimeout(2.0)
        yield sock


def word(data: bytes, timeout_s: float = 1.0) -> Exchange:
    """Ask with a word; the reply has four bytes, or what has come when the connection ends; "no" refuses."""

    def decode(reply: bytes) -> bytes:
        if len(reply) < 2:
            raise LinkError("cut")
        if reply.startswith(b"no"):
            raise DeviceError(5, "refused")
        return reply

    return Exchange(data, lambda got: 4 if len(got) >= 4 else None, decode, timeout_s, False, f"ask {data!r}")


class Beside:
    """A line with a connection beside it; time is the test's own, and passes a millisecond a look."""

    def __init__(self, settings: LineSettings, line: str) -> None:
        self.counters = Counters()
        self.line = Line(Connection(LineSettings(udp=line)), 0.0, 0.1, self.counters, None, SideConnection(settings))
        self.now_ns = 10**9
        self.results: list[Any] = []

    def run(self, exchange: Exchange, meanwhile: Callable[[], None] = lambda: None, anew: bool = False) -> Any:
        def steps() -> Steps:
            return (yield SideExchange(exchange, anew))

        self.line.submit(steps(), Priority.POLL, lambda value, error: self.results.append(error or value), self.now_ns)
        self.advance()
        meanwhile()
        until = time.monotonic() + 5
        while not self.results:
            assert time.monotonic() < until
            self.advance()
        return self.results.pop()

    def advance(self) -> None:
        self.now_ns += 1_000_000
        self.line.advance_time(self.now_ns)


def test_exchanges_beside_the_line(server: socket.socket, device: socket.socket) -> None:
    rig = Beside(LineSettings(tcp=name_of(server), connect_timeout_s=100.0), name_of(device))
    made: list[socket.socket] = []

    def answer(data: bytes, end: bool = False) -> Callable[[], None]:
        def act() -> None:
            if not made:
                made.append(server.accept()[0])
            rig.advance()
            assert made[0].recv(100)
            made[0].sendall(data)
            if end:
                made.pop().close()

        return act

    assert rig.run(word(b"a", 100), answer(b"good")) == b"good"
    assert isinstance(rig.run(word(b"b", 100), answer(b"nono")), DeviceError)
    kept = made[0]
    assert rig.run(word(b"c", 100), answer(b"more")) == b"more" and made[0] is kept, "one connection for all"
    made.clear()
    assert rig.run(word(b"n", 100), answer(b"anew"), anew=True) == b"anew" and made[0] is not kept
    assert kept.recv(10) == b"", "the one that may be dead is given up"
    assert rig.run(word(b"d", 100), answer(b"end", end=True)) == b"end", "the reply ends with the connection"
    assert rig.run(word(b"e", 100), answer(b"good")) == b"good", "connected anew"
    made.pop().close()
    assert rig.run(word(b"f", 100), answer(b"well")) == b"well", "the device had closed it in between"
    failure = rig.run(word(b"g", 0.01), lambda: None)
    assert isinstance(failure, LinkError) and "no reply within its time-out; check" in str(failure)
    made.clear()
    assert rig.run(word(b"h", 100), answer(b"late")) == b"late", "and not the reply to what timed out"
    assert isinstance(rig.run(word(b"i", 100), answer(b"x", end=True)), LinkError)
    assert rig.counters.refused == 1 and rig.counters.replies == 7
    rig.line.close()


def test_nobody_beside_the_line(device: socket.socket, server: socket.socket) -> None:
    place = name_of(server)
    server.close()
    rig = Beside(LineSettings(tcp=place), name_of(device))
    assert f"ask b'a': connect to {place}: connection refused" in str(rig.run(word(b"a")))
    rig.line.close()


def test_what_was_given_up_is_not_answered_later(server: socket.socket) -> None:
    side = SideConnection(LineSettings(tcp=name_of(server), connect_timeout_s=100.0))

    def until_asked(exchange: Exchange) -> socket.socket:
        side.begin(exchange, 0)
        assert side.advance(1) is None
        made = server.accept()[0]
        while not is_readable(made, 0.001):
            assert side.advance(2) is None
        assert made.recv(100) == exchange.data
        return made

    with until_asked(word(b"a", 100.0)) as first:
        first.sendall(b"late")
        with until_asked(word(b"b", 100.0)) as second:
            second.sendall(b"good")
            while (found := side.advance(3)) is None:
                pass
            assert found == (b"good",)
    side.close()


@pytest.mark.parametrize("repeatable", [True, False])
def test_a_connection_that_ends_while_it_is_asked_is_made_anew(server: socket.socket, repeatable: bool) -> None:
    """The other side hangs up between the look whether it is there, and the request; what may be repeated is."""
    side = SideConnection(LineSettings(tcp=name_of(server), connect_timeout_s=100.0))
    ask = replace(word(b"a", 100.0), repeatable=repeatable)

    def answered(made: socket.socket) -> Any:
        while not is_readable(made, 0.001):
            side.advance(2)
        assert made.recv(100) == ask.data
        made.sendall(b"good")
        while (found := side.advance(3)) is None:
            pass
        return found

    side.begin(ask, 0)
    side.advance(1)
    with server.accept()[0] as first:
        assert answered(first) == (b"good",)
        side.begin(ask, 4)  # it is still there
    if not repeatable:
        with pytest.raises(LinkError):
            while True:
                side.advance(5)
        return
    server.settimeout(0.001)
    while True:
        side.advance(5)
        try:
            second = server.accept()[0]
            break
        except TimeoutError:
            continue
    with second:
        second.settimeout(5.0)
        assert answered(second) == (b"good",)
    side.close()
