"""The line when the device never falls silent; verbs that come before a late tick."""

from __future__ import annotations

import socket
from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from sioms.motion import AxisBank, AxisSettings
from sioms.protocol.flags import ControlMode, NodeClass
from sioms.protocol.records import numpy_dtype
from sioms.sdk.connection import Connection
from sioms.sdk.exchange import Exchange, LinkError, Steps
from sioms.sdk.line import BABBLE_NS, Counters, Line, Priority
from sioms.sdk.line_engine import _named
from sioms.sdk.settings import LineSettings

MS = 1_000_000


@pytest.fixture
def babbler() -> Iterator[tuple[Line, socket.socket]]:
    """A line, and the device at its other end."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        connection = Connection(LineSettings(tcp=f"127.0.0.1:{listener.getsockname()[1]}"))
        device, _ = listener.accept()
        assert connection.is_connected()
        yield Line(connection, 0.0, 0.05, Counters()), device
        connection.close()
        device.close()


def _want(data: bytes) -> int | None:
    raise LinkError(f"{data[:1]!r} is not a reply")


def _poll() -> Steps:
    yield Exchange(b"?", _want, bytes, 0.1, False, "poll")


def test_a_device_that_never_falls_silent_is_a_failed_exchange_and_lets_a_stop_out(
    babbler: tuple[Line, socket.socket],
) -> None:
    line, device = babbler
    ended: list[Any] = []
    line.submit(_poll(), Priority.POLL, lambda _, error: ended.append(error), 0)
    line.submit(_poll(), Priority.STOP, lambda _, error: ended.append(error), 0)
    sent, now = b"", 0
    while b"??" not in sent and now < 10 * BABBLE_NS:
        device.sendall(b"x")
        now += 10 * MS
        line.receive(now)
        line.advance_time(now)
        sent += _received(device)
    assert b"??" in sent, f"sent: {sent!r}"
    assert now < 2 * BABBLE_NS


def _received(device: socket.socket) -> bytes:
    try:
        return device.recv(64, socket.MSG_DONTWAIT)
    except BlockingIOError:
        return b""


class _NoMarkers:
    """Nobody has reserved a marker."""

    def capture(self, token_or_number: int, *, signal: bool) -> tuple[int, int]:
        raise AssertionError("no command here names a marker")

    def state(self, number: int, generation: int) -> bool | None:
        return None

    def signal(self, number: int, generation: int, now_ns: int) -> None:
        raise AssertionError("no command here names a marker")


VERBS: dict[str, Callable[[AxisBank, int], None]] = {
    "stop": lambda bank, now: bank.stop([0], now),
    "stop of another axis": lambda bank, now: bank.stop([1], now),
    "emergency stop": lambda bank, now: bank.emergency_stop([0, 1], now),
    "fault": lambda bank, now: bank.fault([0], "as planned", now),
    "synch": lambda bank, now: bank.synch([1], now, now) and None,
    "write": lambda bank, now: bank.append(_to(0.0), [1], now),
    "replacing write": lambda bank, now: bank.append(_to(0.0), [0], now, replace=True),
    "question": lambda bank, now: bank.is_idle([1]) and None,
}


def _to(position: float) -> np.ndarray[Any, Any]:
    record = np.zeros(1, numpy_dtype(NodeClass.AXIS))
    record["control_mode"], record["position"] = int(ControlMode.POSITION), position
    return record


@pytest.mark.parametrize("verb", VERBS)
@pytest.mark.parametrize("gap_ms", [60, 400])
def test_no_verb_lets_the_set_point_run_on_before_a_late_tick(verb: str, gap_ms: int) -> None:
    settings = [
        AxisSettings(name, "m", velocity_max=1.0, acceleration_max=10.0, position_min=-1.0, position_max=1.0, k=100.0)
        for name in "xy"
    ]
    bank = AxisBank(settings, tick_s=1e-3, markers=_NoMarkers())
    position, now = np.zeros(2), 1000 * MS
    bank.tick(now, position)
    bank.append(_to(0.3), [0, 1], now)
    for _ in range(100):
        now += MS
        bank.tick(now, position)
        position = bank.rows["commanded_position"].copy()
    velocity = bank.rows["commanded_velocity"][0]
    assert 0.04 < position[0] < 0.06 and velocity > 0.5
    now += gap_ms * MS
    VERBS[verb](bank, now)
    bank.tick(now + 1000, position)
    assert bank.rows["commanded_position"][0] == pytest.approx(position[0], abs=1e-4), (
        "it brakes from where it was last put out"
    )


@pytest.mark.parametrize(
    ("error", "told"),
    [
        ("nothing for 0.5 s", "io: nothing for 0.5 s"),
        ("let go of io x: it is in state 8 yet", "let go of io x: it is in state 8 yet"),
        ("an action was refused", "io: an action was refused"),
    ],
)
def test_an_error_names_its_unit_once(error: str, told: str) -> None:
    unit: Any = SimpleNamespace(name="io")
    assert _named(unit, OSError(error)) == told
