"""When a packet was sent, and what clocks that are set make of it."""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Iterator

import pytest

from sioms.descriptors import enable_timestamps
from sioms.timestamps import ClockChanges, Timestamps, pending_bytes, receive

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


@pytest.mark.parametrize("by_ns", [-3_600_000_000_000, -2_000_000, 2_000_000, 3_600_000_000_000])
def test_a_clock_that_is_set_makes_nothing_younger_and_little_older(
    pair: Pair, timestamps: Timestamps, monkeypatch: pytest.MonkeyPatch, by_ns: int
) -> None:
    """A test must not set the clock of its machine: what is sent afterwards has the stamp that it would have then."""
    ours, theirs = pair

    def stamp() -> tuple[int, int]:
        ours.send(b"x")
        return time.monotonic_ns(), receive(theirs, 10)[1]

    before_ns, old = stamp()
    real = time.time_ns
    monkeypatch.setattr(time, "time_ns", lambda: real() + by_ns)
    monkeypatch.setattr(ClockChanges, "found", lambda _: True)
    timestamps.look_at_clock()
    monkeypatch.setattr(ClockChanges, "found", lambda _: False)
    after_ns, new = stamp()
    assert timestamps.monotonic_ns(old) <= before_ns
    came_out_ns = timestamps.monotonic_ns(new + by_ns)
    assert after_ns - max(0, -by_ns) - 1_000_000 < came_out_ns <= after_ns
    monkeypatch.setattr("sioms.timestamps._DOUBT_NS", 0)
    assert after_ns - 1_000_000 < timestamps.monotonic_ns(new + by_ns) <= after_ns, "seconds later"


def test_a_clock_that_is_set_all_the_time_leaves_resets_possible(
    pair: Pair, timestamps: Timestamps, monkeypatch: pytest.MonkeyPatch
) -> None:
    ours, theirs = pair
    real = time.time_ns
    for by_ns in range(0, 20_000_000, 1_000_000):
        monkeypatch.setattr(time, "time_ns", lambda by_ns=by_ns: real() + by_ns)
        stopped_ns = time.monotonic_ns()
        time.sleep(0.001)
        ours.send(b"x")
        _, timestamp_ns = receive(theirs, 10)
        assert timestamps.monotonic_ns(timestamp_ns + by_ns) > stopped_ns


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
