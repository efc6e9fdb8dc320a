"""The page: writer and reader, lapping, a writer killed half-way, states and lease."""

from __future__ import annotations

import os
import threading
from struct import pack_into, unpack_from

import pytest

from sioms.protocol.flags import NodeClass, PageState
from sioms.protocol.page import (
    HEADER_SIZE,
    SLOT_HEADER,
    NotReadable,
    PageError,
    PageReader,
    PageWriter,
    page_size,
    set_daemon_state,
    slot_header,
    slot_size,
)  # fmt: skip

LEASE_NS = 100
CHANNELS = 3


class Page:
    def __init__(self, node_class: NodeClass = NodeClass.ANALOG, slots: int = 4) -> None:
        self.buffer = bytearray(page_size(node_class, CHANNELS, slots))
        self.writer = PageWriter(memoryview(self.buffer), node_class, CHANNELS, slots, LEASE_NS, 7, 99)
        self.payload = bytearray(slot_size(node_class, CHANNELS) - SLOT_HEADER)

    def reader(self) -> PageReader:
        return PageReader(memoryview(self.buffer).toreadonly())

    def good(self) -> PageReader:
        self.writer.set_state(PageState.GOOD)
        self.publish(1)
        return self._bytes_reader()

    def _bytes_reader(self) -> PageReader:
        # slices of a bytearray copy, as those of a mapping do
        return PageReader(self.buffer)

    def publish(self, value: int) -> None:
        for i in range(0, len(self.payload), 8):
            pack_into("<q", self.payload, i, value)
        self.writer.publish(memoryview(self.payload), 1000 + value, 2000 + value, 3000 + value)
        self.writer.alive(1000 + value)


def test_header_is_as_documented() -> None:
    page = Page(NodeClass.AXIS, 8)
    assert bytes(page.buffer[:8]) == b"SIOMSpg1"
    assert unpack_from("<IIII", page.buffer, 8) == (2, NodeClass.AXIS, CHANNELS, 13)
    assert unpack_from("<QQQQQ", page.buffer, 24) == (8, 32 + 8 * 13 * CHANNELS, HEADER_SIZE, LEASE_NS, 7)
    assert unpack_from("<II", page.buffer, 64) == (PageState.STARTING, PageState.GOOD)
    page.publish(5)
    assert unpack_from("<QQQ", page.buffer, 72) == (1, 1005, 99) and page.reader().device == 99
    slot = HEADER_SIZE + 1 * slot_size(NodeClass.AXIS, CHANNELS)
    assert unpack_from("<QQQQ", page.buffer, slot) == (1, 1005, 2005, 3005)


@pytest.mark.parametrize("slots", [0, 1, 2, 3, 5, 6, 100])
def test_a_ring_is_a_power_of_two_from_four_on(slots: int) -> None:
    with pytest.raises(PageError, match=f"{slots} slots; must be a power of two"):
        PageWriter(memoryview(bytearray(1 << 16)), NodeClass.ANALOG, 1, slots, 1, 1)


@pytest.mark.parametrize("head", [b"SIOMSpg2\2\0\0\0", b"SIOMSpg1\1\0\0\0", bytes(12)])
def test_what_is_no_page_is_refused(head: bytes) -> None:
    page = Page()
    page.buffer[:12] = head
    with pytest.raises(PageError, match="want b'SIOMSpg1', 2"):
        page.reader()


def test_reading_what_was_written() -> None:
    page = Page()
    reader = page.good()
    for value in range(2, 30):
        page.publish(value)
        raw = reader.latest(1000 + value)
        assert slot_header(raw) == (value, 1000 + value, 2000 + value)
        assert set(unpack_from(f"<{2 * CHANNELS}q", raw, SLOT_HEADER)) == {value}
    assert [n for n in range(40) if reader.numbered(n) is not None] == [26, 27, 28, 29]
    assert reader.numbered(0) is None and reader.numbered(30) is None and reader.numbered(25) is None


def test_nothing_is_read_before_the_first_publication() -> None:
    page = Page()
    page.writer.set_state(PageState.GOOD)
    page.writer.alive(1000)
    with pytest.raises(NotReadable) as refused:
        page._bytes_reader().latest(1000)
    assert refused.value.state is PageState.STARTING


def test_the_lease() -> None:
    page = Page()
    reader = page.good()
    reader.latest(1001 + LEASE_NS)
    reader.check(1001 + LEASE_NS)
    for call in (reader.latest, reader.check):
        with pytest.raises(NotReadable, match="has not ticked for") as refused:
            call(1002 + LEASE_NS)
        assert refused.value.state is PageState.STALE


@pytest.mark.parametrize("state", [s for s in PageState if s is not PageState.GOOD])
def test_no_state_but_good_is_readable(state: PageState) -> None:
    page = Page()
    reader = page.good()
    page.writer.set_state(state, "a reason")
    with pytest.raises(NotReadable, match="a reason") as refused:
        reader.latest(1001)
    assert refused.value.state is state
    page.writer.set_state(PageState.GOOD)
    reader.latest(1001)
    set_daemon_state(memoryview(page.buffer), state, "the daemon's reason")
    with pytest.raises(NotReadable, match="the daemon's reason") as refused:
        reader.latest(1001)
    assert refused.value.state is state


def test_a_long_reason_is_cut_and_stays_text() -> None:
    page = Page()
    reader = page.good()
    page.writer.set_state(PageState.FAULT, "ä" * 500)
    with pytest.raises(NotReadable) as refused:
        reader.latest(1001)
    assert 70 < len(refused.value.reason) < 90 and set(refused.value.reason) <= {"ä", "�"}
    assert unpack_from("<I", page.buffer, 64) == (PageState.FAULT,), "nothing beside it was touched"
    assert page.buffer[HEADER_SIZE - 1] == 0


def test_a_writer_killed_half_way_leaves_the_snapshot_before() -> None:
    """Every store of a publication is done up to some point and no further."""
    page = Page()
    reader = page.good()
    page.publish(2)
    slot = HEADER_SIZE + (3 & 3) * slot_size(NodeClass.ANALOG, CHANNELS)
    steps = [
        lambda: pack_into("<Q", page.buffer, slot, 0),
        lambda: pack_into("<Q", page.buffer, slot + 8, 9999),
        lambda: page.buffer.__setitem__(slice(slot + SLOT_HEADER, slot + SLOT_HEADER + 8), b"\xff" * 8),
        lambda: pack_into("<Q", page.buffer, slot, 3),
    ]
    for step in steps:
        step()
        assert slot_header(reader.latest(1002)) == (2, 1002, 2002)
    pack_into("<Q", page.buffer, 72, 3)
    assert slot_header(reader.latest(1002))[0] == 3


def test_a_publication_that_never_came_to_its_end_leaves_no_history_in_its_place() -> None:
    """The writer itself is cut off in the middle: after the stamp, before the values."""
    page = Page()
    reader = page.good()
    for value in range(2, 6):
        page.publish(value)
    assert reader.numbered(2) is not None
    with pytest.raises(ValueError):
        page.writer.publish(memoryview(b"too short"), 9999, 9999, 9999)
    assert reader.numbered(2) is None
    assert slot_header(reader.latest(1005))[0] == 5


class Lapping:
    """A buffer whose writer goes on while it is copied."""

    def __init__(self, page: Page, laps: int) -> None:
        self.page, self.laps = page, laps

    def __getitem__(self, part: slice) -> bytes:
        half = (part.start + part.stop) // 2
        first = bytes(self.page.buffer[part.start : half])
        if self.laps and part.start >= HEADER_SIZE:
            self.laps -= 1
            number = self.page.writer.number
            for value in range(number + 1, number + 9):  # two laps of the ring
                self.page.publish(value)
        return first + bytes(self.page.buffer[half : part.stop])


@pytest.mark.parametrize("laps", [1, 2, 7])
def test_a_reader_that_is_lapped_reads_again(laps: int) -> None:
    page = Page()
    reader = page.good()
    reader._buffer = Lapping(page, laps)
    raw = reader.latest(1001)
    number = slot_header(raw)[0]
    assert number == 1 + 8 * laps
    assert set(unpack_from(f"<{2 * CHANNELS}q", raw, SLOT_HEADER)) == {number}


def test_history_that_is_lapped_is_not_there() -> None:
    page = Page()
    reader = page.good()
    reader._buffer = Lapping(page, 1)
    assert reader.numbered(1) is None


def test_a_reader_in_another_process_sees_only_whole_snapshots() -> None:
    """The writer in a thread of its own as fast as it can; each snapshot holds one value throughout."""
    import mmap

    size = page_size(NodeClass.AXIS, 50, 4)
    memory = mmap.mmap(-1, size)
    writer = PageWriter(memoryview(memory), NodeClass.AXIS, 50, 4, 10**18, 1)
    writer.set_state(PageState.GOOD)
    writer.alive(0)
    done = threading.Event()
    child = os.fork()
    if child == 0:
        status = 1
        try:
            reader, last, seen = PageReader(memory), 0, 0
            while seen < 300:
                try:
                    raw = reader.latest(0)
                except NotReadable:
                    continue
                number = slot_header(raw)[0]
                values = set(unpack_from(f"<{13 * 50}q", raw, SLOT_HEADER))
                if values != {number} or number < last:
                    os._exit(2)
                seen += number > last
                last = number
            status = 0
        finally:
            os._exit(status)

    def write() -> None:
        number = 0
        while not done.is_set():
            number += 1
            writer.publish(memoryview(number.to_bytes(8, "little") * (13 * 50)), 0, 0, 0)

    thread = threading.Thread(target=write, daemon=True)
    thread.start()
    _, status = os.waitpid(child, 0)
    done.set()
    thread.join()
    assert os.waitstatus_to_exitcode(status) == 0
