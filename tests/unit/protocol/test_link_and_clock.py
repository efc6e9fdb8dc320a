"""Frames of the link as bytes, and what is known of two clocks."""

from __future__ import annotations

import random
from struct import pack
from typing import Any

import pytest

from sioms.bench.clocks import trial
from sioms.protocol import link
from sioms.protocol.clock import UNKNOWN_NS, Clock, Offset, Wall
from sioms.protocol.flags import NodeClass, PageState
from sioms.protocol.link import Down, MalformedFrame, PageShape, Up, Update
from sioms.protocol.page import SLOT_HEADER, PageCopy, PageReader, PageWriter, page_size
from sioms.protocol.records import READ_SIZE

GOLDEN = [
    (link.pack(Up.HELLO, 1, 1), "0100000000000000010000000000000001000000000000000000000000000000"),
    (link.pack(Down.END, 5, 0, 7, b"x"), "160000000000000005000000000000000000000000000000070000000000000078"),
    (Update(9, 1, 2, b"y", True, 1, b"ab").packed(), "09000000000000000100000002000000010000000100010079" + "6162"),
    (link.ping(3), "0300000000000000"),
]


@pytest.mark.parametrize(("packed", "golden"), GOLDEN)
def test_golden_bytes(packed: bytes, golden: str) -> None:
    assert packed.hex() == golden


def test_frames_are_taken_as_they_were_made() -> None:
    shape = PageShape(NodeClass.AXIS, 3, 64, 10**8, 2, 1 << 63)
    taken, packet = link.take_opened(link.opened(shape, b"packet"))
    assert packet == b"packet" and all(getattr(taken, name) == getattr(shape, name) for name in shape.__slots__)
    update = Update.take(Update(9, 1, 2, b"why", False, 2, b"abcdefgh").packed(), 4)
    assert (update.alive_ns, update.driver, update.daemon, update.reason) == (9, 1, 2, b"why")
    assert (update.wake, update.count, update.snapshots) == (False, 2, b"abcdefgh")
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


def _numbered(number: int) -> bytes:
    """A snapshot of two axes, each byte of whose payload tells its number."""
    return pack("<4Q", number, number, number, number) + bytes([number % 251]) * 2 * READ_SIZE[NodeClass.AXIS]


@pytest.mark.parametrize("seed", range(20))
def test_snapshots_that_come_together_are_kept_as_one_by_one(seed: int) -> None:
    chance, size = random.Random(seed), page_size(NodeClass.AXIS, 2, 8)
    pages = [bytearray(size), bytearray(size)]
    one_by_one, together = (PageCopy(memoryview(page), NodeClass.AXIS, 2, 8, 10**8, 1, 5) for page in pages)
    number = chance.choice((0, 5, 1 << 40))
    for _ in range(50):
        number = max(0, number + chance.choice((0, 0, 0, 1, 3, 9, -2)))
        count = chance.choice((0, 1, 2, 5, 8, 9, 40))
        numbers = list(range(number + 1, number + 1 + count))
        if chance.random() < 0.2:
            chance.shuffle(numbers)
        for each in numbers:
            one_by_one.put(_numbered(each))
        together.put_all(b"".join(map(_numbered, numbers)))
        number += count
        assert pages[0] == pages[1]


class _Written(bytearray):
    """A page to which its writer adds snapshots while it is copied: half of a copy is from before."""

    writer: PageWriter
    more = 0

    def __getitem__(self, key: Any) -> Any:
        if not isinstance(key, slice):
            return super().__getitem__(key)
        before = bytes(super().__getitem__(key))
        for _ in range(self.more):
            number = self.writer.number + 1
            self.writer.publish(memoryview(_numbered(number)[SLOT_HEADER:]), number, number, number)
        self.more = 0
        half = len(before) // 2
        return before[:half] + bytes(super().__getitem__(key))[half:]


@pytest.mark.parametrize("more", range(20))
@pytest.mark.parametrize("behind", range(1, 8))
def test_what_is_written_while_it_is_copied_is_left_out(more: int, behind: int) -> None:
    page = _Written(page_size(NodeClass.AXIS, 2, 8))
    page.writer = PageWriter(memoryview(page), NodeClass.AXIS, 2, 8, 10**8, 1, 5)
    page.more = 29
    _ = page[:0]
    page.more = more
    raw, size = PageReader(page).between(29 - behind + 1, 29), SLOT_HEADER + 2 * READ_SIZE[NodeClass.AXIS]
    copies = [raw[at : at + size] for at in range(0, len(raw), size)]
    numbers = [int.from_bytes(copy[:8], "little") for copy in copies]
    assert copies == [_numbered(number) for number in numbers]
    assert numbers == [n for n in range(30 - behind, 30) if n > 29 + more - 8]


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
