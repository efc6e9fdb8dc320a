"""Who lets more pile up than a bound loses his connection, and nobody else does."""

from __future__ import annotations

import os
import socket
from collections.abc import Iterator

import pytest

from sioms.gateway import inflow
from sioms.gateway.connections import Connections
from sioms.gateway.inflow import Inflow

Pair = tuple[socket.socket, socket.socket]


@pytest.fixture
def pairs(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[Pair]]:
    """Three TCP connections: the end of a client, and ours."""
    monkeypatch.setattr(inflow, "MOST", 100_000)
    monkeypatch.setattr(inflow, "MOST_IN_ALL", 150_000)
    found = []
    with socket.create_server(("127.0.0.1", 0)) as listener:
        for _ in range(3):
            theirs = socket.create_connection(listener.getsockname())
            found.append((theirs, listener.accept()[0]))
    yield found
    for pair in found:
        for sock in pair:
            sock.close()


def _arrives(pair: Pair, size: int) -> int:
    pair[0].sendall(bytes(size))
    left = size
    while left:
        left -= len(pair[1].recv(left))
    return pair[1].fileno()


class Flow(Inflow):
    """Looks at all connections of this process."""

    def __init__(self) -> None:
        super().__init__()
        self._connections = Connections()

    def see(self) -> list[int]:
        return self.look(self._connections.look())


def test_what_is_taken_does_not_count_and_what_piles_up_does(pairs: list[Pair]) -> None:
    flow = Flow()
    assert flow.see() == []
    for _ in range(20):
        flow.took(_arrives(pairs[0], 50_000), 50_000)
        assert flow.see() == []
    _arrives(pairs[1], 90_000)
    assert flow.see() == []
    bad = _arrives(pairs[1], 20_000)
    assert flow.see() == [bad]
    assert pairs[1][0].recv(1) == b"", "it has been shut down"
    assert _arrives(pairs[0], 5)


def test_small_frames_earn_nothing(pairs: list[Pair]) -> None:
    flow = Flow()
    flow.see()
    for _ in range(2_000):
        flow.took(_arrives(pairs[0], 1), 1)
    flow.see()
    assert flow.see() == []
    assert flow.see() == [] and _arrives(pairs[0], 110_000) in flow.see()


def test_many_that_are_below_the_bound_are_bounded_together(pairs: list[Pair]) -> None:
    flow = Flow()
    flow.see()
    sizes = (60_000, 70_000, 50_000)
    fds = [_arrives(pair, size) for pair, size in zip(pairs, sizes, strict=True)]
    assert flow.see() == [fds[1]], "the largest goes"


def test_a_descriptor_that_is_another_connection_begins_anew(pairs: list[Pair]) -> None:
    flow = Flow()
    flow.see()
    fd = _arrives(pairs[0], 90_000)
    assert flow.see() == []
    os.dup2(pairs[1][1].fileno(), fd)
    _arrives(pairs[1], 90_000)
    assert flow.see() == []
