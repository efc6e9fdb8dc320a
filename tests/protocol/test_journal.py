"""Journals: what was noted is read, and what was overwritten is counted."""

from __future__ import annotations

import random

import pytest

from sioms.protocol.journal import HEADER, MOST, Event, JournalReader, JournalWriter, Note, pack_events, take_events
from sioms.protocol.messages import MalformedMessage


def test_what_was_noted_is_read_once_in_order() -> None:
    memory = bytearray(HEADER + 4096)
    writer, reader = JournalWriter(memoryview(memory)), JournalReader(memory)
    assert reader.read() == []
    writer.note(Note.LOG, 5, "info", "up", {"device": "mod0"})
    writer.note(Note.CLOSED, 7, "mod0", "eva")
    first, second = reader.read()
    assert (first.kind, first.number, first.stamp_ns) == (Note.LOG, 1, 5)
    assert first.values() == ["info", "up", {"device": "mod0"}] and second.values() == ["mod0", "eva"]
    assert reader.read() == [] and reader.lost == 0


def test_who_reads_too_late_is_told_how_much_is_lost() -> None:
    chance = random.Random(5)
    memory = bytearray(HEADER + 2048)
    writer, reader, seen = JournalWriter(memoryview(memory)), JournalReader(memory), []
    for number in range(1, 3000):
        writer.note(Note.CLOSED, 7, "n" * chance.randrange(200), number)
        if chance.random() < 0.1:
            events = reader.read()
            assert [event.values()[1] for event in events] == [event.number for event in events]
            seen += [event.number for event in events]
    seen += [event.number for event in reader.read()]
    assert seen == sorted(set(seen)) and seen[-1] == 2999
    assert reader.lost == seen[-1] - seen[0] + 1 - len(seen) > 0


def test_a_successor_goes_on_where_a_writer_was_killed() -> None:
    memory = bytearray(HEADER + 1024)
    JournalWriter(memoryview(memory)).note(Note.CLOSED, 7, "a", "b")
    killed = memory[:]
    JournalWriter(memoryview(killed)).note(Note.CLOSED, 7, "half", "written")
    memory[HEADER:] = killed[HEADER:]  # its bytes, but not the head
    reader = JournalReader(memory)
    JournalWriter(memoryview(memory)).note(Note.CLOSED, 7, "c", "d")
    assert [event.values()[0] for event in reader.read()] == ["a", "c"]


def test_what_is_too_long_is_shortened() -> None:
    memory = bytearray(HEADER + 4 * MOST)
    writer, reader = JournalWriter(memoryview(memory)), JournalReader(memory)
    writer.note(Note.COMMAND, 7, "mod0", "eva", bytes(2 * MOST), 0, "")
    assert reader.read()[0].values() == ["mod0", "eva", bytes(MOST // 2), 0, ""]


def test_other_memory_is_refused() -> None:
    with pytest.raises(MalformedMessage, match="SIOMSjn1"):
        JournalReader(bytes(HEADER + 64))


def test_a_copy_has_the_numbers_of_its_original_and_tells_what_is_missing() -> None:
    memory = bytearray(HEADER + 4096)
    writer, reader = JournalWriter(memoryview(memory)), JournalReader(memory)
    sent = [Event(Note.LOG, number, 5 + number, b"\x90") for number in (7, 8, 11, 12)]
    for event in take_events(pack_events(sent)):
        writer.put(event)
    assert [(event.number, event.stamp_ns) for event in reader.read()] == [(7, 12), (8, 13), (11, 16), (12, 17)]
    assert reader.lost == 2, "what is missing between the first and the last"
    writer.put(Event(Note.LOG, 20, 5, b"\x90"))
    assert len(reader.read()) == 1 and reader.lost == 9


def test_a_reader_may_take_a_part_only() -> None:
    memory = bytearray(HEADER + 4096)
    writer, reader = JournalWriter(memoryview(memory)), JournalReader(memory)
    for _ in range(10):
        writer.note(Note.CLOSED, 7, "mod0", "eva")
    assert [event.number for event in reader.read(100)] == [1, 2, 3]
    assert [event.number for event in reader.read()] == [4, 5, 6, 7, 8, 9, 10] and reader.lost == 0


@pytest.mark.parametrize("data", [b"x", pack_events([Event(1, 1, 1, b"abc")])[:-1], pack_events([Event(1, 0, 1, b"")])])
def test_bytes_that_are_no_events_are_refused(data: bytes) -> None:
    with pytest.raises(MalformedMessage):
        take_events(data)
