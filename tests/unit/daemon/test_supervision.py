"""Supervisors: who they are, until when, and what their loss does."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import pytest

from sioms.daemon.loop import Timer
from sioms.daemon.supervision import Supervision


class World:
    """A loop whose time is set, and what has been stopped."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, lease_s: float) -> None:
        self.now_ns, self.lease_s = 10**9, lease_s
        self.stops: list[str] = []
        self.timer: tuple[int, Timer] | None = None
        monkeypatch.setattr(time, "monotonic_ns", lambda: self.now_ns)
        self.supervision = Supervision(self, lambda: self.lease_s, self.stops.append)  # type: ignore[arg-type]

    def at(self, when_ns: int, callback: Callable[[], None]) -> Timer:
        self.timer = (when_ns, Timer(callback))
        return self.timer[1]

    def pass_time(self, seconds: float) -> None:
        self.now_ns += int(seconds * 1e9)
        while self.timer and self.timer[0] <= self.now_ns:
            callback, self.timer = self.timer[1].callback, None
            if callback:
                callback()


def test_the_last_supervisor_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    world, one, two = World(monkeypatch, 0.5), "one", "two"
    supervision: Any = world.supervision
    supervision.take_up()
    assert supervision.missing and "sioms supervise" in world.stops.pop()
    assert supervision.renew(one, 9.0) == supervision.renew(two, 0.3) == 0.5 and not supervision.missing
    world.pass_time(0.35)
    assert not world.stops, "one of two is enough"
    world.pass_time(0.2)
    assert supervision.missing and "supervisor one was silent for longer than 0.5 s" in world.stops.pop()
    supervision.renew(one, 9.0)
    for _ in range(20):
        world.pass_time(0.4)
        supervision.renew(one, 9.0)
    assert not world.stops
    supervision.end_session("nobody")
    assert not world.stops
    supervision.end_session(one)
    assert world.stops == ["supervisor one has gone"]
    world.pass_time(5.0)
    assert len(world.stops) == 1


def test_supervisors_that_are_silent_together_are_missed_once(monkeypatch: pytest.MonkeyPatch) -> None:
    world = World(monkeypatch, 0.5)
    supervision: Any = world.supervision
    for name in ("one", "two", "three"):
        supervision.renew(name, 9.0)
    world.pass_time(2.0)
    assert supervision.missing and len(world.stops) == 1 and "was silent" in world.stops[0]


def test_a_workcell_that_asks_for_none_needs_none(monkeypatch: pytest.MonkeyPatch) -> None:
    world = World(monkeypatch, 0.0)
    supervision: Any = world.supervision
    supervision.take_up()
    assert supervision.renew("one", 1.0) == 0.0 and not supervision.missing
    supervision.end_session("one")
    world.pass_time(5.0)
    assert not world.stops
    world.lease_s = 1.0  # a reload asks for one
    supervision.take_up()
    assert len(world.stops) == 1
