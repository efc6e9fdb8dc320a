"""When a unit that does not answer is lost: after its silence, and not before; on an invented clock."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import pytest

from sioms.descriptors import is_readable, is_writable
from sioms.sdk.exchange import Exchange, Steps
from sioms.sdk.line_engine import LineEngine
from sioms.sdk.settings import LineSettings

TICK_NS = 5_000_000
QUESTION, ANSWER = b"?", b"!"


class Runtime:
    """What the engine needs of its process; keeps why units were lost."""

    def __init__(self) -> None:
        self.now, self.tick, self.running = 1_000_000_000, 0, True
        self.lost: list[str] = []

    def now_ns(self) -> int:
        return self.now

    as_of_ns = now_ns

    def lose(self, _: Any, reason: str) -> None:
        self.lost.append(reason)

    def nothing(self, *_: Any) -> int:
        return 0

    mark = set_link = watch = unwatch = set_line_timer = log = after_publication = note = nothing


class Unit:
    """A device that is asked one thing, and may take its time."""

    name, misses, silence_s = "unit", 3, 0.5

    def __init__(self, timeout_s: float) -> None:
        self.blocks: tuple[Any, ...] = ()
        self._ask = Exchange(QUESTION, lambda data: len(ANSWER), bytes, timeout_s, True, "ask")

    def open(self) -> Steps:
        yield self._ask

    poll = open


class Rig:
    """An engine at work with a unit that answers after ``late_s``, or not at all where that is None."""

    def __init__(self, port: socket.socket, timeout_s: float) -> None:
        self.runtime: Any = Runtime()
        line = LineSettings(tcp=f"127.0.0.1:{port.getsockname()[1]}")
        driver: Any = SimpleNamespace(
            line=line, side_line=None, blocks=(), settings=None, claims=lambda _: (), gap_s=0.0, recovery_s=0.0,
            units=[Unit(timeout_s)], overheard=None,
        )  # fmt: skip
        told = self.runtime
        parts: Any = SimpleNamespace(loop=told, pages=told, stops=told, outputs=told, effects=told, log=told.log)
        self.engine = LineEngine(parts, driver, 10.0)
        self.engine.tick(told.now)
        if self.engine._connecting is not None:
            is_writable(self.engine._connecting.fd, 5.0)
            self.engine.tick(told.now)
        self._device = port.accept()[0]
        self._device.setblocking(False)
        self._due: list[int] = []

    def run(self, seconds: float, late_s: float | None) -> None:
        for _ in range(round(seconds * 1e9 / TICK_NS)):
            line = self.engine.line
            assert line is not None
            try:
                asked = len(self._device.recv(100))
            except BlockingIOError:
                asked = 0
            if late_s is not None:
                self._due += [self.runtime.now + int(late_s * 1e9)] * asked
            if self._due and self._due[0] <= self.runtime.now:
                del self._due[0]
                self._device.send(ANSWER)
                is_readable(line.connection.fd, 5.0)
                self.engine._readable()
            self.runtime.now += TICK_NS
            self.engine.line_due()
            self.engine.tick(self.runtime.now)

    def close(self) -> None:
        self._device.close()
        assert self.engine.line is not None
        self.engine.line.close()


@pytest.fixture
def port() -> Iterator[socket.socket]:
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        one.listen(1)
        yield one


def test_a_unit_that_may_take_long_is_not_lost_before_its_silence(port: socket.socket) -> None:
    """turnaround_s = 0.45, as the pages of Moxa and WAGO advise for a slow network."""
    rig = Rig(port, 0.45)
    rig.run(0.2, 0.0)
    rig.run(3.0, 0.4)
    assert not rig.runtime.lost
    rig.close()


@pytest.mark.parametrize("timeout_s", [0.24, 2.0])
def test_a_unit_is_lost_after_its_silence(port: socket.socket, timeout_s: float) -> None:
    """However long its time-outs are: inputs that stop the workcell must not be blind for longer."""
    rig = Rig(port, timeout_s)
    rig.run(0.2, 0.0)
    rig.run(0.45, None)
    assert not rig.runtime.lost
    rig.run(0.2, None)
    assert [text.split(";")[0] for text in rig.runtime.lost] == ["unit: nothing for 0.5 s"]
    rig.close()
