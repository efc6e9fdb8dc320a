"""What a bridge serves has come just now, but for what it may have kept waiting."""

from __future__ import annotations

import time
from types import SimpleNamespace

from sioms.bridges.prompt import LATE_NS, SETTLE_NS, Prompt


def test_a_word_is_as_old_as_the_last_beat_before_all_was_held_up() -> None:
    now = [10**12]
    prompt = Prompt(lambda: now[0], beats=False)

    def go_on(ns: int, *, beats: bool = True) -> int:
        now[0] += ns
        if beats:
            prompt.beat()
        return prompt.came_ns()

    went_ns = now[0] + SETTLE_NS
    while now[0] < went_ns:
        assert go_on(LATE_NS) <= now[0]
    assert go_on(LATE_NS) == now[0], "in time, as long ago as it can be told"
    held_ns = now[0]
    assert go_on(LATE_NS + 1, beats=False) == held_ns, "also before the beat that is late"
    assert go_on(LATE_NS) == held_ns, "what came meanwhile may have its turn now"
    assert go_on(3 * LATE_NS) == held_ns, "held up again, it may wait still"
    for _ in range(SETTLE_NS // LATE_NS - 1):
        assert go_on(LATE_NS) == held_ns
    assert go_on(LATE_NS) == now[0]


def test_it_beats_by_itself() -> None:
    prompt = Prompt()
    made_ns, until_s = prompt._seen[0], time.monotonic() + 10.0
    while prompt._seen[0] == made_ns:
        assert time.monotonic() < until_s
        time.sleep(0.001)


def test_nothing_is_for_a_file_from_before_it_was_open() -> None:
    now = [10**12]
    prompt = Prompt(lambda: now[0], beats=False)

    def said_ns(*, asked_before: bool) -> int:
        node = SimpleNamespace(_channel=SimpleNamespace(carrier=None))
        with prompt.word():
            prompt.date(node, asked_before=asked_before)
        with prompt.word():
            told_ns: int = node._channel.said_ns()
        return told_ns

    held_ns = now[0]
    now[0] += 2 * LATE_NS
    assert said_ns(asked_before=True) == held_ns, "a put that waited behind the one that took the node"
    assert said_ns(asked_before=False) == now[0], "when it was opened"
