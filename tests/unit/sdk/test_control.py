"""The driver's end of its socket to the daemon: orders overtake, the rest keeps its order, no look takes for ever."""

from __future__ import annotations

import socket

import pytest

from sioms.protocol.driver_verbs import InUse, NodeReset, NodeStop, Shutdown
from sioms.sdk.control import MOST_AHEAD, Control


def _pair() -> tuple[socket.socket, Control]:
    daemon, driver = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    return daemon, Control(driver.detach())


def test_orders_overtake_and_the_rest_keeps_its_order_up_to_the_end_of_the_daemon() -> None:
    daemon, control = _pair()
    stop, reset = NodeStop(0, [0], -1, "an operator", 3, 8), NodeReset(0, [0], -1, "an operator", 3, 9, 9)
    for message in (InUse(True), stop, InUse(False), reset, Shutdown()):
        daemon.send(message.packed())
    daemon.close()
    assert [*control.orders()] == [stop, reset]
    assert not [*control.orders()]
    assert control.is_behind
    taken = [control.take() for _ in range(3)]
    assert taken == [(InUse(True), []), (InUse(False), []), (Shutdown(), [])]
    assert not control.is_behind
    with pytest.raises(EOFError):  # not before what the daemon has sent
        control.take()
    control.close()


def test_messages_that_do_not_end_do_not_hold_up_a_tick(monkeypatch: pytest.MonkeyPatch) -> None:
    daemon, control = _pair()
    monkeypatch.setattr(control, "_receive", lambda: (InUse(True), []))
    assert not [*control.orders()]
    assert len(control._kept) == MOST_AHEAD
    daemon.close()
    control.close()
