"""Frames of the link as bytes, and what is known of two clocks."""

from __future__ import annotations

import random

import pytest

from sioms.bench.clocks import trial
from sioms.protocol import link
from sioms.protocol.clock import UNKNOWN_NS, Clock, Offset, Wall
from sioms.protocol.flags import NodeClass, PageState
from sioms.protocol.link import Down, MalformedFrame, PageShape, Up, Update
from sioms.protocol.page import PageCopy, PageReader, PageWriter, page_size
from sioms.protocol.records import READ_SIZE

GOLDEN = [
    (link.pack(Up.HELLO, 1, 1), "0100000000000000010000000000000001000000000000000000000000000000"),
    (link.pack(Down.END, 5, 0, 7, b"x"), "160000000000000005000000000000000000000000000000070000000000000078"),
    (Update(9, 1, 2, b"y", True, [b"ab"]).packed(), "09000000000000000100000002000000010000000100010079" + "6162"),
    (link.ping(3), "0300000000000000"),
]


@pytest.mark.parametrize(("packed", "golden"), GOLDEN)
def test_golden_bytes(packed: bytes, golden: str) -> None:
    assert packed.hex() == golden


def test_frames_are_taken_as_they_were_made() -> None:
    shape = PageShape(NodeClass.AXIS, 3, 64, 10**8, 2, 1 << 63)
    taken, packet = link.take_opened(link.opened(shape, b"packet"))
    assert packet == b"packet" and all(getattr(taken, name) == getattr(shape, name) for name in shape.__slots__)
    update = Update.take(Update(9, 1, 2, b"why", False, [b"abcd", b"efgh"]).packed(), 4)
    assert (update.alive_ns, update.driver, update.daemon, update.reason) == (9, 1, 2, b"why")
    assert (update.wake, update.snapshots) == (False, [b"abcd", b"efgh"])
    assert link.take_pong(link.pong(-1, 2, 3, 4, 1)) == (-1, 2, 3, 4, 1)


def test_any_bytes_are_a_malformed_frame_or_a_right_one() -> None:
    rng = random.Random(3)
    takes = [
        link.take_opened, link.take_ping, link.take_pong, lambda body: Update.take(body, 8),
        lambda body: link.unpack(body, 64),
    ]  # fmt: skip
    for _ in range(5_000):
        body = rng.randbytes(rng.randrange(80))
        for take in takes:
            try:
                take(body)
            except MalformedFrame:
                continue


def test_a_copy_of_a_page_reads_as_the_page_does() -> None:
    size = page_size(NodeClass.AXIS, 2, 8)
    there, here = bytearray(size), bytearray(size)
    writer = PageWriter(memoryview(there), NodeClass.AXIS, 2, 8, 10**8, 1, 5)
    copy = PageCopy(memoryview(here), NodeClass.AXIS, 2, 8, 3 * 10**8, 1, 5)
    source, reader = PageReader(there), PageReader(here)
    for tick in range(20):
        writer.publish(memoryview(bytes([tick]) * 2 * READ_SIZE[NodeClass.AXIS]), tick, tick, tick)
    writer.set_state(PageState.GOOD)
    for number in (14, 15, 18, 20, 19):
        raw = source.numbered(number)
        assert raw is not None
        copy.put(raw)
    copy.set_condition(100, *source.condition()[1:])
    assert reader.latest(100) == source.numbered(20) == reader.numbered(20)
    assert [n for n in range(21) if reader.numbered(n)] == [14, 15, 18, 20], "an older one never replaces a newer one"
    writer.set_state(PageState.FAULT, "it burns")
    copy.set_condition(100, *source.condition()[1:])
    with pytest.raises(Exception, match="it burns"):
        reader.check(100)


def test_the_stated_error_holds_the_truth_however_the_link_delays() -> None:
    rng = random.Random(1)
    for _ in range(300):
        ppm, start = rng.uniform(-150, 150), rng.randrange(-(10**15), 10**15)
        offset, now = Offset(), rng.randrange(10**12)
        zero = now

        def there(here: int, ppm: float = ppm, start: int = start, zero: int = zero) -> int:
            return start + here + int((here - zero) * ppm * 1e-6)

        for _ in range(30):
            sent = now + rng.randrange(10**9)
            got = sent + int(rng.expovariate(1 / 200e3))
            answered = got + rng.randrange(100_000)
            back = answered + int(rng.expovariate(1 / 200e3)) + (10**8 if rng.random() < 0.2 else 0)
            offset.exchange(sent, there(got), there(answered), back)
            now = back + rng.randrange(10**9)
            assert abs(offset.ns - (there(now) - now)) <= offset.error_ns(now) + 1
        assert offset.restarts == 0 and offset.error_ns(now) < 1_000_000


@pytest.mark.parametrize(("jumps", "most"), [(0.0, 0), (0.1, 4)])
def test_the_stated_error_holds_the_truth_of_clocks_that_wander_over_links_with_bursts(jumps: float, most: int) -> None:
    chance = random.Random(7)
    found = [trial(chance, jumps) for _ in range(400)]
    assert sum(off_ns > error_ns for off_ns, error_ns in found) <= most
    assert sorted(error_ns for _, error_ns in found)[200] < 50_000_000


def test_a_clock_that_jumped_is_known_anew() -> None:
    offset = Offset()
    assert offset.error_ns(0) == UNKNOWN_NS and not offset.known
    offset.exchange(0, 1_000_100, 1_000_200, 300)
    offset.exchange(10_000, 9_010_100, 9_010_200, 10_300)
    assert offset.restarts == 1 and abs(offset.ns - 9_000_000) < 200
    with pytest.raises(ValueError, match="exchange"):
        offset.exchange(10, 5, 9_999, 20)


def test_utc_is_of_the_cells_wall_clock_and_says_how_good_it_is() -> None:
    clock = Clock()
    assert clock.here(5) == clock.there(5) == 5 and clock.utc(5).source == "none"
    clock.wall = Wall(1_000, 7, 2)
    assert (clock.utc(5).ns, clock.utc(5).error_ns, clock.utc(5).source) == (1_005, 7, "PTP")
