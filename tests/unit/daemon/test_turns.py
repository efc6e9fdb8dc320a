"""Who is served next: by users, one packet at a time."""

import select
import socket

import pytest

from sioms import turns
from sioms.turns import Turns


class Server:
    """A loop with nothing but clients, on a clock of its own: each packet takes ``cost_ns``."""

    def __init__(self, monkeypatch, shares=(0.5, 0.125)):
        self.now_ns, self.cost_ns = 10**9, 20_000
        monkeypatch.setattr(turns.time, "monotonic_ns", lambda: self.now_ns)
        self.epoll = select.epoll()
        self.turns = Turns(self.epoll, shares)
        self.served = []
        self.ends = []

    def connect(self, source, kind, packets):
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        ours.setblocking(False)
        for _ in range(packets):
            theirs.send(b"x")

        def take():
            ours.recv(10)
            self.now_ns += self.cost_ns
            self.served.append((source, self.now_ns))

        self.turns.add(ours.fileno(), source, kind, take)
        self.ends += [ours, theirs]
        return ours

    def step(self):
        pause_s = self.turns.pause_s
        if pause_s:
            self.now_ns += int(pause_s * 1e9) + 1
        for fd, _ in self.epoll.poll(0):
            self.turns.mark(fd)
        self.turns.serve()

    def close(self):
        for end in self.ends:
            end.close()


@pytest.fixture
def server(monkeypatch):
    made = Server(monkeypatch)
    yield made
    made.close()


def test_a_user_with_200_connections_delays_another_by_one_request(server):
    for _ in range(200):
        server.connect("flood", 1, 5)
    for _ in range(30):
        server.step()
    server.connect("other", 1, 3)
    before = len(server.served)
    for _ in range(20):
        server.step()
    assert [source for source, _ in server.served[before : before + 6]].count("other") >= 2


def test_readers_get_their_share_and_owners_come_first(server):
    server.connect("reader", 1, 100)
    for _ in range(60):
        server.step()
    spent = len(server.served) * server.cost_ns / (server.now_ns - 10**9)
    assert spent < 0.16
    before = len(server.served)
    server.connect("owner", 0, 3)
    server.step()
    server.step()
    assert "owner" in [source for source, _ in server.served[before:]]


def test_whose_pause_is_over_is_looked_at_again_as_soon_as_that_is_asked_for(server):
    server.connect("one", 0, 9)
    server.cost_ns = turns.WINDOW_NS * 6 // 10
    server.step()
    assert 0.0 < server.turns.pause_s <= 0.4e-3 and not server.epoll.poll(0)
    server.now_ns += turns.WINDOW_NS
    assert server.turns.pause_s is None and server.epoll.poll(0)


def test_a_connection_that_ends_takes_its_source_along(server):
    ours = server.connect("one", 1, 1)
    assert server.turns.remove(ours.fileno()) and not server.turns.remove(ours.fileno())
    server.step()
    assert not server.served and server.turns.pause_s is None
