"""A connection that is opened again after every loss, on a real port and an invented clock."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from itertools import pairwise
from types import SimpleNamespace
from typing import Any

import pytest

from sioms.descriptors import is_readable, is_writable
from sioms.sdk.connected import LONGEST_PAUSE_NS, Connected
from sioms.sdk.settings import LineSettings

STEP_NS = 50_000_000


class Runtime:
    """What a connection needs of the process; counts what is told about its loss."""

    def __init__(self) -> None:
        self.now, self.told = 1_000_000_000, 0

    def now_ns(self) -> int:
        return self.now

    def lose(self, *_: Any) -> None:
        self.told += 1

    def set_link(self, *_: Any) -> None:
        self.told += 1

    def watch(self, *_: Any) -> None:
        pass

    unwatch = set_line_timer = log = watch


class Reading(Connected):
    def connected(self, now_ns: int) -> None:
        pass


@pytest.fixture
def port() -> Iterator[socket.socket]:
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        one.listen(1)
        yield one


@pytest.mark.parametrize("accepts", [True, False])
def test_a_port_that_accepts_and_closes_is_tried_less_and_less_often(port: socket.socket, accepts: bool) -> None:
    """Nobody has said anything: that is not a device, and each try costs lines in the log."""
    line = LineSettings(tcp=f"127.0.0.1:{port.getsockname()[1]}")
    if not accepts:
        port.close()
    runtime = Runtime()
    driver: Any = SimpleNamespace(line=line, side_line=None, blocks=(), settings=None, claims=lambda _: ())
    parts: Any = SimpleNamespace(
        loop=runtime, pages=runtime, stops=runtime, outputs=None, effects=None, log=runtime.log
    )
    engine, tries = Reading(parts, driver, 0.0, 0.0), []
    while runtime.now < 61_000_000_000:
        runtime.now += STEP_NS
        told = runtime.told
        up = engine.connect(runtime.now)
        if accepts and engine._connecting is not None:
            is_writable(engine._connecting.fd, 5.0)
            up = engine.connect(runtime.now)
        if up:
            port.accept()[0].close()
            is_readable(engine.line.connection.fd, 5.0)  # type: ignore[union-attr]
            engine._readable()
            assert engine.line is None
        if runtime.told > told:
            tries.append(runtime.now)
    pauses = [b - a for a, b in pairwise(tries)]
    assert pauses == sorted(pauses) and pauses[0] <= 300_000_000
    assert pauses[-1] == pytest.approx(LONGEST_PAUSE_NS, abs=2 * STEP_NS)
    assert len(tries) < 22, "in a minute"
