"""Where the daemon's loop stands among its drivers, by the priorities that it asks for."""

from __future__ import annotations

import os
import select
import threading
import time
from collections.abc import Iterator
from contextlib import suppress

import pytest

from sioms.daemon.precedence import BESIDE, Precedence

LATER_NS = 2**62


class Stage:
    """A precedence whose watching thread is the test itself.

    Attributes:
        asked: what it has asked for: whether for the loop by its number, and the priority.
    """

    def __init__(self, monkeypatch: pytest.MonkeyPatch, starts: bool = True) -> None:
        def start(_thread: threading.Thread) -> None:
            if not starts:
                raise RuntimeError("can't start new thread")

        monkeypatch.setattr(threading.Thread, "start", start)
        self.asked: list[tuple[bool, int]] = []
        self.epoll = select.epoll()
        self.pipe = os.pipe()
        self.epoll.register(self.pipe[0], select.EPOLLIN)
        self.it = Precedence(self.epoll.fileno(), 99, lambda who, priority: self.asked.append((who != 0, priority)))

    def happen(self) -> None:
        os.write(self.pipe[1], b"x")

    def close(self) -> None:
        for fd in self.pipe:
            os.close(fd)
        self.epoll.close()


@pytest.fixture
def stage(monkeypatch: pytest.MonkeyPatch) -> Iterator[Stage]:
    one = Stage(monkeypatch)
    yield one
    one.close()


def test_it_waits_beside_the_first_of_its_drivers_and_works_ahead(stage: Stage) -> None:
    stage.it.adopt([0, 60, 20])
    for _ in range(2):
        stage.it.wait(LATER_NS)
        stage.it.work()
    assert stage.asked == [(False, BESIDE), (False, 99), (False, 60), (False, 99), (False, 60), (False, 99)]


def test_no_driver_is_as_high(stage: Stage) -> None:
    stage.it.adopt([99])
    stage.it.wait(LATER_NS)
    assert stage.asked[-1] == (False, stage.it.most) == (False, 98)


def test_beside_ordinary_drivers_it_stays_where_it_is(stage: Stage) -> None:
    stage.it.adopt([50])
    stage.it.adopt([0])
    stage.asked.clear()
    stage.it.wait(LATER_NS)
    stage.it.work()
    assert not stage.asked
    stage.it.adopt([50])
    assert stage.asked[-1] == (False, 99), "and goes ahead again when it has to"


def test_who_is_kept_from_what_has_come_is_put_ahead(stage: Stage) -> None:
    stage.it.adopt([50])
    stage.it.wait(LATER_NS)
    assert not stage.it.look(0), "nothing has come"
    stage.happen()
    found = stage.it.look(0)
    assert found and stage.asked[-1] == (False, 50), "it may have come just now"
    assert stage.it.look(found) == found and stage.asked[-1] == (True, 99)
    stage.it.work()
    stage.it.wait(LATER_NS)
    assert stage.asked[-1] == (False, 99), "and has some time ahead"


def test_a_timer_that_is_due_counts_as_well(stage: Stage) -> None:
    stage.it.adopt([50])
    stage.it.wait(time.monotonic_ns())
    assert stage.it.look(stage.it.look(0)) and stage.asked[-1] == (True, 99)


def test_who_works_or_waits_anew_is_let_be(stage: Stage) -> None:
    stage.it.adopt([50])
    stage.happen()
    stage.it.wait(LATER_NS)
    found = stage.it.look(0)
    stage.it.work()
    assert not stage.it.look(found), "it works"
    stage.it.wait(LATER_NS)
    assert stage.it.look(found) != found and stage.asked[-1] == (False, 50)


def test_without_a_thread_it_waits_ahead(monkeypatch: pytest.MonkeyPatch) -> None:
    stage = Stage(monkeypatch, starts=False)
    with suppress(RuntimeError):
        stage.it.adopt([50])
    stage.it.wait(LATER_NS)
    assert stage.asked[-1] == (False, 99)
    stage.close()
