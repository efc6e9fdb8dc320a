"""The way of stops outlives whatever comes in, and a daemon that has gone."""

from __future__ import annotations

import errno
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import pytest
import zmq

from sioms.gateway import ways
from sioms.gateway.inflow import Inflow
from sioms.gateway.parts import Principal
from sioms.gateway.stops import Stops
from sioms.protocol.messages import decode_reply
from sioms.protocol.verbs import EmergencyStop

KATE = Principal("kate")


@pytest.fixture
def ends() -> Iterator[SimpleNamespace]:
    """Stops whose thread is not started, and what it logs."""
    context: Any = zmq.Context()
    said: list[str] = []
    sock = context.socket(zmq.ROUTER)
    found = Stops(context, sock, "/nowhere", lambda _: KATE, Inflow(), lambda *words, **more: said.append(str(more)))
    yield SimpleNamespace(stops=found, said=said)
    context.destroy(0)


class Gone:
    """A session at a daemon that has gone."""

    closed = 0

    def stop(self, _: EmergencyStop) -> int:
        raise OSError(errno.EIO, "the daemon has gone")

    def close(self) -> None:
        self.closed += 1


def test_a_daemon_that_lets_nobody_in_is_told(ends: SimpleNamespace, monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(*_: object) -> None:
        raise OSError(errno.EIO, "the daemon ended during the greeting")

    monkeypatch.setattr(ways, "Way", refused)
    for known in (False, True):
        way = Gone()
        if known:
            ends.stops._ways._ways[KATE, "lab2"] = way
        answer = decode_reply(ends.stops._ways._stop(KATE, "lab2", 7, EmergencyStop("", "why")))
        assert answer[1:4] == [7, errno.EIO, "the daemon ended during the greeting"]
        assert not ends.stops._ways._ways and way.closed == known


def test_a_daemon_that_has_been_started_again_is_asked_again(
    ends: SimpleNamespace, monkeypatch: pytest.MonkeyPatch
) -> None:
    ends.stops._ways._ways[KATE, "lab2"] = Gone()
    monkeypatch.setattr(ways, "Way", lambda *_: SimpleNamespace(stop=lambda _: 5, close=lambda: None))
    answer = decode_reply(ends.stops._ways._stop(KATE, "lab2", 7, EmergencyStop("", "why")))
    assert answer[1:3] == [7, 0]


def test_a_mistake_of_ours_does_not_end_the_thread(ends: SimpleNamespace) -> None:
    def broken() -> None:
        raise KeyError("a mistake")

    ends.stops._serve(broken)
    assert "a mistake" in ends.said[0]
