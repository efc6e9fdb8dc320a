"""Journals: what was noted is read, and what was overwritten is counted."""

from __future__ import annotations

import random

import pytest

from sioms.protocol.journal import HEADER, MOST, JournalReader, JournalWriter, Note
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
