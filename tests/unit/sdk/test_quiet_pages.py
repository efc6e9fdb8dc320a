"""Compiled steps publish snapshots as the loop does; run as Python where nothing is compiled."""

import os

import numpy as np

from sioms.descriptors import is_readable
from sioms.sdk import quiet_step
from sioms.sdk.quiet_step import FIRST, SLOT, Page, publish


def page(pipes=(), every=()):
    """Return a page of four slots of two words, and its memory."""
    words, slot = np.zeros(FIRST + 4 * (SLOT + 2), dtype=np.int64), SLOT + 2
    count = np.array([every[i] for i in range(len(every))], dtype=np.int64)
    made = Page(
        words=words, payload=np.array([5, 6], dtype=np.int64), count=2, slot=slot, mask=3, number=9,
        subscribers=len(pipes), pipes=np.array(pipes, dtype=np.int64), every=count, countdown=count.copy(),
    )  # fmt: skip
    return made, words


def test_a_snapshot_is_published_in_its_slot():
    made, words = page()
    publish(made, 100, 3, 90)
    at = FIRST + (10 & 3) * (SLOT + 2)
    assert words[at : at + 6].tolist() == [10, 100, 3, 90, 5, 6]
    assert words[quiet_step.HEAD] == 10 == made.number
    assert np.count_nonzero(np.delete(words, [quiet_step.HEAD, *range(at, at + 6)])) == 0


def test_who_subscribed_is_woken_every_so_many_publications():
    pipes = [os.pipe2(os.O_NONBLOCK) for _ in range(3)]
    try:
        made, _ = page([w for _, w in pipes], [1, 3, 0])
        woken = []
        for number in range(7):
            publish(made, number, number, number)
            for i, (r, _) in enumerate(pipes):
                if is_readable(r):
                    woken.append((number, i))
                    os.read(r, 8)
        assert woken == sorted([*((n, 0) for n in range(7)), (2, 1), (5, 1)])
    finally:
        for pair in pipes:
            for fd in pair:
                os.close(fd)
