"""Journals that remote clients follow: what is asked of the daemon, sent and kept, who is slow, when it ends."""

from __future__ import annotations

import errno

import pytest
from gateway_rig import Journal, World

from sioms.gateway.core import (
    JOURNAL_BYTES,
    JOURNAL_NS,
)
from sioms.protocol import link, verbs
from sioms.protocol.journal import HEADER, Event, JournalReader, JournalWriter, Note, take_events
from sioms.protocol.link import Down, Up
from sioms.protocol.messages import decode_reply, refusal, reply


@pytest.fixture
def world() -> World:
    return World()


def follow(world: World, peer: bytes, number: int = 7) -> Journal:
    """Have the daemon grant a journal, which keeps three events."""
    journal = Journal()
    world.journals.append(journal)
    for _ in range(3):
        journal.writer.note(Note.CLOSED, world.now_ns, "mod0", "eva")
    world.ask(peer, number, verbs.Journal("mod0"))
    world.gateway.daemon_packet(world.session(peer), reply(number, 1), (11, 12))
    return journal


def events(world: World, peer: bytes, since: int) -> list[int]:
    """Return the numbers of the events that a client was sent."""
    frames = [body for kind, *_, body in world.sent[peer][since:] if kind == Down.EVENTS]
    return [event.number for body in frames for event in take_events(body)]


def test_a_journal_is_asked_of_the_daemon_and_sent_with_what_it_keeps(world: World) -> None:
    line = world.begin(b"a")
    journal = follow(world, b"a")
    assert line.got[-1] == verbs.Journal("mod0").packed(7), "the daemon judges the key's right"
    (kind, channel, _, _, body) = world.sent[b"a"][-1]
    packet, kept = link.take_followed(body)
    assert (kind, channel, packet) == (Down.FOLLOWED, link.JOURNAL | 7, reply(7, 1))
    assert [event.number for event in take_events(kept)] == [1, 2, 3] and world.dropped == []
    since = len(world.sent[b"a"])
    journal.writer.note(Note.STOP, world.now_ns, "EMERGENCY", "a test", [])
    world.gateway.tick()
    assert events(world, b"a", since) == [4]
    world.frame(b"a", Up.BYE)
    assert journal.closed


def test_a_refused_journal_is_an_answer(world: World) -> None:
    world.begin(b"a")
    world.ask(b"a", 7, verbs.Journal("mod0"))
    world.gateway.daemon_packet(world.session(b"a"), refusal(7, errno.EPERM, "no right"))
    assert decode_reply(world.sent[b"a"][-1][4])[2] == errno.EPERM and not world.session(b"a").followed


def test_who_does_not_confirm_events_gets_four_frames_and_hears_of_what_was_overwritten(world: World) -> None:
    world.begin(b"a")
    world.begin(b"b")
    journal = follow(world, b"a")
    since = len(world.sent[b"a"])
    for _ in range(300):
        world.now_ns += JOURNAL_NS
        journal.writer.note(Note.CLOSED, world.now_ns, "n" * 100, "eva")
        world.frame(b"a", Up.PING, body=link.ping(1))
        world.gateway.tick()
    assert events(world, b"a", since) == [4, 5, 6, 7], "of who does not confirm nothing more is read"
    for _ in range(4):
        world.frame(b"a", Up.CREDIT, link.JOURNAL | 7)
    world.now_ns += JOURNAL_NS
    world.gateway.tick()
    got = events(world, b"a", since)
    assert got[4] > 8 and got[4:] == list(range(got[4], 304)), "the newest, whose numbers tell what is missing"
    copy = bytearray(HEADER + (1 << 16))
    writer, reader = JournalWriter(memoryview(copy)), JournalReader(copy)
    for number in [1, 2, 3, *got]:
        writer.put(Event(Note.CLOSED, number, 7, b"\x90"))
    reader.read()
    assert reader.lost == got[4] - 8
    assert events(world, b"b", 0) == []


def test_events_come_in_frames_of_bounded_size(world: World) -> None:
    world.begin(b"a")
    journal = follow(world, b"a")
    memory = bytearray(HEADER + (1 << 19))
    journal.writer, journal._reader = JournalWriter(memoryview(memory)), JournalReader(memory)
    since = len(world.sent[b"a"])
    for _ in range(40):
        journal.writer.note(Note.COMMAND, 7, "mod0", "eva", bytes(10_000), 0, "")
    for _ in range(12):
        world.now_ns += JOURNAL_NS
        world.gateway.tick()
        world.frame(b"a", Up.CREDIT, link.JOURNAL | 7)
    sizes = [len(body) for kind, *_, body in world.sent[b"a"][since:] if kind == Down.EVENTS]
    assert max(sizes) < JOURNAL_BYTES + 11_000 and events(world, b"a", since) == list(range(1, 41))


def test_a_right_that_ends_ends_the_following_at_once(world: World) -> None:
    world.begin(b"a")
    journal = follow(world, b"a")
    since = len(world.sent[b"a"])
    journal.writer.note(Note.CLOSED, 7, "mod0", "eva")
    world.gateway.unfollow(world.session(b"a"))
    world.gateway.tick()
    kinds = [kind for kind, *_ in world.sent[b"a"][since:]]
    assert journal.closed and Down.UNFOLLOWED in kinds and Down.EVENTS not in kinds
    assert b"a" in world.gateway.sessions, "the session goes on"


def test_a_journal_that_is_asked_for_again_replaces_the_first(world: World) -> None:
    world.begin(b"a")
    first, second = follow(world, b"a", 7), follow(world, b"a", 8)
    assert first.closed and not second.closed and len(world.session(b"a").followed) == 1
