"""When a packet was sent, and what clocks that are set make of it."""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Iterator

import pytest

from sioms.descriptors import enable_timestamps
from sioms.sdk.rt import ClockChanges
from sioms.sdk.timestamps import Timestamps, pending_bytes, receive

Pair = tuple[socket.socket, socket.socket]


@pytest.fixture
def pair() -> Iterator[Pair]:
    """A client's end, and the driver's, whose packets have timestamps."""
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    theirs.setblocking(False)
    enable_timestamps(theirs)
    with ours, theirs:
        yield ours, theirs


@pytest.fixture
def timestamps() -> Iterator[Timestamps]:
    made = Timestamps()
    yield made
    made.close()


def test_packets_tell_when_they_were_sent(pair: Pair, timestamps: Timestamps) -> None:
    ours, theirs = pair
    between = [time.monotonic_ns()]
    for size in (1, 200, 30):
        ours.send(bytes(size))
        time.sleep(0.002)
        between.append(time.monotonic_ns())
    assert pending_bytes(theirs) == 231
    for size, before, after in zip((1, 200, 30), between, between[1:], strict=False):
        packet, timestamp_ns = receive(theirs, 4096)
        # A process that has to wait between its looks at both clocks takes a packet for older.
        assert len(packet) == size and before - 1_000_000 < timestamps.monotonic_ns(timestamp_ns) < after
    with pytest.raises(BlockingIOError):
        receive(theirs, 4096)


def test_a_packet_without_timestamp_is_as_old_as_can_be(timestamps: Timestamps) -> None:
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with ours, theirs:
        ours.send(b"x")
        packet, timestamp_ns = receive(theirs, 10)
    assert packet == b"x" and timestamps.monotonic_ns(timestamp_ns) == 0


def test_what_lies_there_when_the_clock_is_set_is_old(
    pair: Pair, timestamps: Timestamps, monkeypatch: pytest.MonkeyPatch
) -> None:
    ours, theirs = pair
    ours.send(b"x")
    _, timestamp_ns = receive(theirs, 10)
    monkeypatch.setattr(ClockChanges, "found", lambda _: True)  # a test must not set the clock of its machine
    timestamps.look_at_clock()
    monkeypatch.undo()
    assert timestamps.monotonic_ns(timestamp_ns) == 0, "it may have been stamped by the clock as it was before"


def test_no_packet_is_from_the_future(timestamps: Timestamps) -> None:
    assert timestamps.monotonic_ns(time.time_ns() + 3_600_000_000_000) <= time.monotonic_ns()


def test_a_process_that_waits_between_its_looks_looks_again(
    timestamps: Timestamps, monkeypatch: pytest.MonkeyPatch
) -> None:
    timestamp_ns, real, waits = time.time_ns(), time.time_ns, [0.05, 0.05]

    def late() -> int:
        if waits:
            time.sleep(waits.pop())
        return real()

    sent_ns = time.monotonic_ns()
    monkeypatch.setattr(time, "time_ns", late)
    assert abs(timestamps.monotonic_ns(timestamp_ns) - sent_ns) < 20_000_000


def test_a_clock_that_is_not_set_has_not_changed() -> None:
    changes = ClockChanges()
    assert not changes.found() and not changes.found()
    changes.close()


def test_descriptors_that_come_along_are_not_opened(pair: Pair) -> None:
    ours, theirs = pair
    before = len(os.listdir("/proc/self/fd"))
    socket.send_fds(ours, [b"x"], [0, 0, 0])
    packet, _ = receive(theirs, 10)
    assert packet == b"x" and len(os.listdir("/proc/self/fd")) == before
