"""Counters of the protocol near the ends of 31, 32, 53 and 63 bits: they only grow, and nothing is narrower than they.

Most are words of 64 bits, which no machine fills: at a million a second that takes 584,000 years. Numbers of requests
have 53 bits: 285 years of one connection.
"""

from __future__ import annotations

import pytest

from sioms.protocol import verbs
from sioms.protocol.compiled import add_decoders
from sioms.protocol.flags import NodeClass, PageState
from sioms.protocol.journal import HEADER, JournalReader, JournalWriter, Note
from sioms.protocol.latch import LATCH_SIZE, Latch
from sioms.protocol.markers import TABLE_SIZE, MarkerTable
from sioms.protocol.messages import MalformedMessage, decode, reply
from sioms.protocol.page import SLOT_HEADER, PageReader, PageWriter, page_size, slot_header, slot_size

ENDS = pytest.mark.parametrize("end", [1 << 31, 1 << 32, 1 << 53, 1 << 63])
AROUND = range(-3, 4)


@ENDS
def test_publications(end: int) -> None:
    buffer = bytearray(page_size(NodeClass.ANALOG, 2, 4))
    writer = PageWriter(memoryview(buffer), NodeClass.ANALOG, 2, 4, 100, 7, 99)
    writer.set_state(PageState.GOOD)
    writer.alive(end)
    writer._number = end + AROUND[0] - 1
    reader, payload = PageReader(buffer), memoryview(bytearray(slot_size(NodeClass.ANALOG, 2) - SLOT_HEADER))
    for step in AROUND:
        writer.publish(payload, end + step, end + step, end + step)
        assert writer.number == end + step
        assert slot_header(reader.latest(end)) == (end + step, end + step, end + step)
        assert reader.numbered(end + step) is not None and reader.numbered(end + step + 1) is None
        assert step < 1 or reader.numbered(end + step - 3) is not None


@ENDS
def test_stops_resets_and_orders(end: int) -> None:
    latch = Latch(memoryview(bytearray(LATCH_SIZE)))
    latch._words[1] = latch._words[5] = end + AROUND[0] - 1
    for step in AROUND:
        assert latch.stop(end + step, "somebody") and latch.stopped_ns == end + step
        latch.reset(1, (end + step, end + step))
        latch.ordered()
        latch.daemon_alive(end + step)
        assert (latch.resets, latch.orders, latch.daemon_alive_ns) == (end + step,) * 3
        assert latch.answered_request == (end + step, end + step) and not latch.stopped_ns


@ENDS
def test_generations_of_markers(end: int) -> None:
    table = MarkerTable(memoryview(bytearray(TABLE_SIZE)))
    table._words[5 * (TABLE_SIZE // 1024 // 8)] = end + AROUND[0] - 1
    for step in AROUND[::2]:
        generation = table.reserve(5, 77)
        assert generation == end + step and not table.is_signalled(5, generation)
        assert table.signal(5, generation, end) and not table.signal(5, generation, end)
        assert table.is_signalled(5, generation) and not table.is_signalled(5, generation + 1)
        table.free(5)
        assert table.generation(5) == generation + 1


@ENDS
def test_events_of_journals(end: int) -> None:
    memory = bytearray(HEADER + 1024)
    writer = JournalWriter(memoryview(memory))
    at = (end - 64) // 8 * 8
    writer._words[3] = writer._words[4] = at
    writer._words[5] = end + AROUND[0] - 1
    reader = JournalReader(memory)
    for step in AROUND:
        writer.note(Note.CLOSED, end + step, "node", end + step)
        (event,) = reader.read()
        assert (event.number, event.stamp_ns, event.values()) == (end + step, end + step, ["node", end + step])
    assert writer._words[4] > end and reader.lost == 0


@pytest.mark.parametrize("number", [(1 << 31) - 1, 1 << 31, (1 << 32) - 1, 1 << 32, (1 << 53) - 1])
def test_numbers_of_requests(number: int) -> None:
    add_decoders(verbs.ON_HANDLE)
    message = verbs.Write(0, 0.0, b"records")
    assert verbs.take(message.packed(number), verbs.ON_HANDLE) == (number, message)
    assert decode(reply(number, [number]))[1] == number
    with pytest.raises(MalformedMessage):
        decode(message.packed(1 << 53))
