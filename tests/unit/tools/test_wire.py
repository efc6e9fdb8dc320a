"""What a wire does to messages, and when their bytes arrive."""

from __future__ import annotations

import contextlib
import socket
from pathlib import Path

import pytest

from sioms.check.bending import Bender, Faults, Piece, Way
from sioms.check.ends import make_ends
from sioms.descriptors import readable

MESSAGE = bytes(range(20))


def bent(messages: int = 200, **faults: object) -> list[tuple[bytes, str]]:
    bender = Bender(seed=3)
    bender.set(Faults(**faults))
    results = []
    for _ in range(messages):
        pieces, note = bender.bend(MESSAGE)
        results.append((b"".join(piece.data for piece in pieces), note))
    return results


def test_nothing_is_bent_without_faults() -> None:
    assert bent() == [(MESSAGE, "")] * 200


def test_a_flip_changes_one_bit_and_says_which() -> None:
    for data, note in bent(flip=1.0):
        bits = [(i, a ^ b) for i, (a, b) in enumerate(zip(data, MESSAGE, strict=True)) if a != b]
        assert len(bits) == 1 and bits[0][1].bit_count() == 1
        assert note == f"bit {bits[0][1].bit_length() - 1} of byte {bits[0][0]} flipped"


def test_shares_are_shares_and_counts_end() -> None:
    lost = sum(not data for data, _ in bent(1000, lose=0.1))
    assert 60 < lost < 140
    assert [not data for data, _ in bent(6, lose=1.0, count=2)] == [True, True, False, False, False, False]


@pytest.mark.parametrize("faults", [{"garbage": 1.0}, {"double": 1.0}])
def test_what_is_added_leaves_the_message_whole(faults: dict[str, float]) -> None:
    for data, note in bent(**faults):
        assert MESSAGE in data and len(data) > len(MESSAGE) and note
    assert all(data == 2 * MESSAGE for data, _ in bent(double=1.0))


@pytest.mark.parametrize("how", ["bytes", "cuts"])
def test_chopped_messages_keep_their_bytes(how: str) -> None:
    bender = Bender()
    bender.set(Faults(chop=how))
    for _ in range(50):
        pieces, _ = bender.bend(MESSAGE)
        assert b"".join(piece.data for piece in pieces) == MESSAGE and len(pieces) > 1
        assert all(piece.data for piece in pieces)
    assert bender.bend(b"x")[0] == [Piece(b"x", 0, how == "cuts")]


def test_a_character_takes_its_time() -> None:
    # 9 characters of 10 bits at 9600 baud: 9.375 ms, the line-time of half a TMCL exchange
    way = Way(10 / 9600 * 1e9)
    assert way.send([Piece(MESSAGE[:9])], 1_000) == pytest.approx(1_000 + 9.375e6, abs=2)
    assert b"".join(way.due(9_376_000 - 20_000)) == MESSAGE[:8]
    assert b"".join(way.due(9_376_100)) == MESSAGE[8:9] and way.next_ns is None


def test_a_later_message_waits_for_the_line_and_a_datagram_does_not() -> None:
    line, datagrams = Way(1e6), Way(1e6, in_order=False)
    for way, second_ns in ((line, 30_000_000), (datagrams, 20_000_000)):
        way.send([Piece(MESSAGE, delay_ns=-0)], 0)
        assert way.send([Piece(MESSAGE[:10])], 10_000_000) == second_ns


def test_a_late_message_holds_up_what_follows_it() -> None:
    way = Way()
    assert way.send([Piece(b"late", 5_000_000)], 0) == 5_000_000
    assert way.send([Piece(b"next")], 1_000_000) == 5_000_000
    assert way.due(4_999_999) == [] and way.due(5_000_000) == [b"late", b"next"]


def test_what_is_at_once_arrives_at_once() -> None:
    way = Way(1e5)
    way.send([Piece(MESSAGE, at_once=True)], 0)
    assert way.due(1_999_999) == [] and way.due(2_000_000) == [MESSAGE]
    assert (way.messages, way.characters) == (1, 20)
    way.send([Piece(MESSAGE)], 0)
    way.clear()
    assert way.next_ns is None


def test_what_a_device_pushes_goes_on_to_the_driver_until_the_cable_is_pulled() -> None:
    sockets = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(3)]
    with contextlib.ExitStack() as stack:
        sensor, driver, free = (stack.enter_context(each) for each in sockets)
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
        free.close()
        host, device = make_ends("pushed", f"127.0.0.1:{port}", Path("/nonexistent"))
        name, _, number = host.name.rpartition(":")
        driver.bind((name, int(number)))
        driver.settimeout(2.0)
        assert host.fds() == [] and readable(device.fds(), 0) == []
        for plugged in (True, False, True):
            (host.plug if plugged else host.unplug)()
            sensor.sendto(MESSAGE, ("127.0.0.1", port))
            (fd,) = readable(device.fds(), 2.0)
            data = device.read(fd)
            assert data == MESSAGE
            host.write(data + bytes((plugged,)))
        assert [driver.recv(100), driver.recv(100)] == 2 * [MESSAGE + b"\x01"]
        driver.setblocking(False)
        with pytest.raises(BlockingIOError):
            driver.recv(100)
