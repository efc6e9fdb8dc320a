"""Connections of strangers have an end and a bound; who has been admitted keeps his."""

from __future__ import annotations

import os
import socket
from collections.abc import Callable, Iterator

import pytest

from sioms.gateway import connections
from sioms.gateway.connections import MOST_STRANGERS, PROOF_S, Connection, Connections, Strangers, received, too_many

Accept = Callable[[], tuple[socket.socket, socket.socket]]


@pytest.fixture
def listener() -> Iterator[socket.socket]:
    with socket.create_server(("127.0.0.1", 0)) as listening:
        yield listening


@pytest.fixture
def accept(listener: socket.socket) -> Iterator[Accept]:
    """Make a connection: the end of a client, and ours."""
    made: list[socket.socket] = []

    def one() -> tuple[socket.socket, socket.socket]:
        theirs = socket.create_connection(listener.getsockname())
        made.extend((theirs, listener.accept()[0]))
        return theirs, made[-1]

    yield one
    for sock in made:
        sock.close()


def test_connections_of_a_port_are_found_with_their_peers(listener: socket.socket, accept: Accept) -> None:
    found = Connections((listener.getsockname()[1],))
    theirs, ours = accept()
    (seen,) = found.look().items()
    assert seen[0] == ours.fileno() and seen[1].peer == "127.0.0.1:{1}".format(*theirs.getsockname())
    assert found.look() == dict([seen]), "and keep the time at which they came"
    os.dup2(accept()[1].fileno(), ours.fileno())
    assert found.look()[ours.fileno()].peer != seen[1].peer, "a descriptor becomes another one's"
    ours.close()
    assert len(found.look()) == 1
    assert Connections((1,)).look() == {}


def test_a_connection_that_is_closed_while_it_is_looked_at_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    closed = os.dup(0)

    def closes(fd: int) -> int:
        if fd != closed:
            return received(fd)
        os.close(fd)  # as a thread of ZeroMQ does when a peer leaves
        return 5

    monkeypatch.setattr(connections, "received", closes)
    assert closed not in Connections().look()


def test_only_connections_have_received(accept: Accept) -> None:
    theirs, ours = accept()
    theirs.sendall(bytes(90_000))
    left = 90_000
    while left:
        left -= len(ours.recv(left))
    assert received(ours.fileno()) == 90_000
    with open(os.devnull) as file:
        assert received(file.fileno()) == -1


def test_strangers_are_bounded_in_number_and_in_time() -> None:
    some = {fd: Connection(fd, 1, "h:1", float(fd)) for fd in range(1000)}
    known = {5, 900, 999}
    ended = too_many(some, lambda fd, _: fd in known, 999.0)
    young = [fd for fd in range(1000) if 999.0 - fd <= PROOF_S and fd not in known]
    assert ended == [fd for fd in range(1000) if fd not in known and fd not in young]
    crowd = {fd: Connection(fd, 1, "h:1", fd * 1e-3) for fd in range(1000)}
    ended = too_many(crowd, lambda fd, _: fd in known, 1.0)
    assert not known & set(ended) and len(ended) == 1000 - len(known) - MOST_STRANGERS
    assert min(ended) == MOST_STRANGERS + 1, "the first ones keep their places"


def test_who_is_turned_away_finds_his_connection_ended(listener: socket.socket, accept: Accept) -> None:
    said: list[dict[str, object]] = []
    found = Connections((listener.getsockname()[1],))
    (theirs, _), (friend, _) = accept(), accept()
    strangers = Strangers(lambda *_, **words: said.append(words))
    peer = "127.0.0.1:{1}".format(*friend.getsockname())
    seen = {
        fd: Connection(one.inode, one.port, one.peer, one.since_s - 2 * PROOF_S) for fd, one in found.look().items()
    }
    for _ in range(3):
        strangers.turn_away(seen, lambda _, one: one.peer == peer)
    assert theirs.recv(1) == b"" and len(said) == 1 and said[0]["count"] == 1
    friend.setblocking(False)
    with pytest.raises(BlockingIOError):
        friend.recv(1)
