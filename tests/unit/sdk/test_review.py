"""The line when the device never falls silent."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from typing import Any

import pytest

from sioms.sdk.connection import Connection
from sioms.sdk.exchange import Exchange, LinkError, Steps
from sioms.sdk.line import BABBLE_NS, Counters, Line, Priority
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
    raise LinkError(f"{data[:1]!r} is no reply")


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
