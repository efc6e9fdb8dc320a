"""The way of stops outlives whatever comes in, and a daemon that has gone."""

from __future__ import annotations

import errno
import os
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import zmq

from sioms.client.channel import Descriptors
from sioms.gateway import ways, zenoh
from sioms.gateway.inflow import Inflow
from sioms.gateway.parts import Principal
from sioms.gateway.stop_queue import EACH, Stop, StopQueue
from sioms.gateway.stops import Stops
from sioms.protocol import link
from sioms.protocol.link import Up
from sioms.protocol.messages import decode_reply
from sioms.protocol.stopfile import StopRequest
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
    found.close()
    context.destroy(0)


class Gone:
    """A session at a daemon that has gone."""

    closed = 0

    def stop(self, _: EmergencyStop, begun: object = None) -> int:
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
        answer = decode_reply(ends.stops._ways._stop(KATE, "lab2", 7, EmergencyStop("", "why", False, 0)))
        assert answer[1:4] == [7, errno.EIO, "the daemon ended during the greeting"]
        assert not ends.stops._ways._ways and way.closed == known


def test_a_daemon_that_has_been_started_again_is_asked_again(
    ends: SimpleNamespace, monkeypatch: pytest.MonkeyPatch
) -> None:
    ends.stops._ways._ways[KATE, "lab2"] = Gone()
    monkeypatch.setattr(ways, "Way", lambda *_: SimpleNamespace(stop=lambda *_: 5, close=lambda: None))
    answer = decode_reply(ends.stops._ways._stop(KATE, "lab2", 7, EmergencyStop("", "why", False, 0)))
    assert answer[1:3] == [7, 0]


def test_a_mistake_of_ours_does_not_end_the_thread(ends: SimpleNamespace) -> None:
    def broken() -> None:
        raise KeyError("a mistake")

    ends.stops._serve(broken)
    assert "a mistake" in ends.said[0]


# --- drivers brake before anybody is told ----------------------------------------------------------


@pytest.fixture
def request_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[StopRequest]:
    """The stop-request file of a daemon that takes the sessions for stops, and does nothing else."""
    for name in ("stop", "stopped"):
        (tmp_path / name).write_bytes(bytes(8))

    def call(_: object, call: Any) -> Any:
        names = ("stop", "stopped") if call.what == "hello" else ()
        return SimpleNamespace(fds=Descriptors(os.open(tmp_path / name, os.O_RDWR) for name in names))

    monkeypatch.setattr(ways, "connect", lambda _: None)
    monkeypatch.setattr(ways, "Channel", type("Channel", (), {"__init__": lambda *_: None, "call": call,
                                                              "close": lambda _: None}))  # fmt: skip
    with closing(StopRequest(*(os.open(tmp_path / name, os.O_RDONLY) for name in ("stop", "stopped")))) as found:
        yield found


def _frame(stop: EmergencyStop) -> bytes:
    return link.pack(Up.PACKET, body=stop.packed(7))


def test_a_stop_is_begun_at_once_and_once(request_file: StopRequest) -> None:
    found, stop = ways.Ways("/nowhere"), _frame(EmergencyStop("", "enough", False, 0))
    before = request_file.mark
    assert found.begin(KATE, stop) is None, "nobody of hers has come in"
    assert found.answer(KATE, "lab2", link.pack(Up.HELLO)) is None
    of_a_node = _frame(EmergencyStop("mod0", "", False, 0))
    for none in (of_a_node, b"nothing", link.pack(Up.PACKET, body=b"\xff"), stop[:-1]):
        assert found.begin(KATE, none) is None
    assert found.begin(None, stop) is None and found.begin(Principal("ben"), stop) is None
    assert request_file.mark == before, "none of these stops anything"
    begun = found.begin(KATE, stop)
    assert begun is not None and not begun() and "enough" in request_file.source
    mark = request_file.mark
    answer = found.answer(KATE, "lab2", stop, begun)
    assert answer is not None and decode_reply(link.unpack(answer, len(answer))[4])[1:3] == [7, 0]
    assert request_file.mark == mark, "what has been asked for is not asked for again, perhaps behind a reset"
    found.close()
    assert found.begin(KATE, stop) is None, "its file may be another one by now"


def test_over_zenoh_drivers_brake_before_the_stop_waits_for_its_turn() -> None:
    said: list[str] = []

    class Queue(StopQueue):
        def put(self, number: str, stop: Stop) -> bool:
            said.append("queued")
            return super().put(number, stop)

    gateway = SimpleNamespace(
        _prompt=SimpleNamespace(enter=lambda: None), _stops=Queue(), _loop=SimpleNamespace(principal=lambda _: KATE),
        _ways=SimpleNamespace(begin=lambda who, frame: said.append(f"{who.name} {bytes(frame)!r}")),
    )  # fmt: skip
    sample = SimpleNamespace(
        key_expr="sioms/stop/cert-0001/0123456789abcdef", kind=zenoh.zenoh.SampleKind.PUT,
        payload=SimpleNamespace(to_bytes=lambda: b"stop"),
    )  # fmt: skip
    take: Any = zenoh.Zenoh._stop
    for _ in range(3 * EACH):
        take(gateway, sample)
    assert said == ["kate b'stop'", "queued"] * EACH, "and who floods has no more begun than can wait"
