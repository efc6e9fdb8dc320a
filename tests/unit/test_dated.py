"""When a packet was sent, and what a driver makes of it after a reset."""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from sioms.dated import date_what_comes, received, unread
from sioms.protocol.flags import Access, Right
from sioms.sdk.handles import Handle

Pair = tuple[socket.socket, socket.socket]


@pytest.fixture
def pair() -> Iterator[Pair]:
    """A client's end, and the driver's, which is dated."""
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    theirs.setblocking(False)
    date_what_comes(theirs)
    with ours, theirs:
        yield ours, theirs


def handle_of(sock: socket.socket) -> Handle:
    nothing: Any = None
    return Handle(
        1, "mod0", "eva", 0, sock, -1, -1, nothing, np.arange(2), -1, Access.READ | Access.WRITE, True, Right(0), 0, 0,
        nothing, nothing,
    )  # fmt: skip


def test_packets_tell_when_they_were_sent(pair: Pair) -> None:
    ours, theirs = pair
    between = [time.monotonic_ns()]
    for size in (1, 200, 30):
        ours.send(bytes(size))
        time.sleep(0.002)
        between.append(time.monotonic_ns())
    assert unread(theirs) == 231
    for size, before, after in zip((1, 200, 30), between, between[1:], strict=False):
        packet, sent_ns = received(theirs, 4096)
        assert len(packet) == size and before - 100_000 < sent_ns < after
    with pytest.raises(BlockingIOError):
        received(theirs, 4096)


def test_what_lies_there_while_the_clock_is_set_counts_as_old(pair: Pair, monkeypatch: pytest.MonkeyPatch) -> None:
    ours, theirs = pair
    for step_ns in (3_600_000_000_000, -3_600_000_000_000):
        ours.send(b"x")
        real = time.time_ns
        monkeypatch.setattr(time, "time_ns", lambda real=real, step_ns=step_ns: real() + step_ns)
        assert received(theirs, 10) == (b"x", 0)
        monkeypatch.undo()
        ours.send(b"y")
        assert received(theirs, 10) == (b"y", 0), "it was set again"
        ours.send(b"z")
        assert received(theirs, 10)[1] > 0


def test_descriptors_that_come_along_are_not_opened(pair: Pair) -> None:
    ours, theirs = pair
    before = len(os.listdir("/proc/self/fd"))
    socket.send_fds(ours, [b"x"], [0, 0, 0])
    packet, _ = received(theirs, 10)
    assert packet == b"x" and len(os.listdir("/proc/self/fd")) == before


def test_what_lay_there_at_a_reset_is_outdated_and_what_comes_behind_is_not(pair: Pair) -> None:
    ours, theirs = pair
    handle = handle_of(theirs)
    ours.send(b"early")
    ours.send(b"too")
    reset_ns = time.monotonic_ns()
    time.sleep(0.002)
    ours.send(b"late")  # before the driver has seen the reset
    handle.outdate(reset_ns)
    ours.send(b"later")
    assert [handle.take(99) for _ in range(4)] == [
        (b"early", True), (b"too", True), (b"late", False), (b"later", False),
    ]  # fmt: skip
    assert handle.unread == 0


def test_a_write_that_had_come_in_part_is_broken(pair: Pair) -> None:
    handle = handle_of(pair[1])
    handle.ahead = (7, [b"some"])
    handle.outdate(time.monotonic_ns())
    assert handle.broken == 7 and not handle.ahead[1]
