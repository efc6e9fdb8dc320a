"""The driver's end of its socket to the daemon: orders overtake, the rest keeps its order, no look takes for ever."""

from __future__ import annotations

import os
import socket

import pytest

from sioms.descriptors import is_readable, receive
from sioms.protocol.driver_verbs import (
    FROM_DRIVER,
    HeldSilent,
    InUse,
    LogLine,
    MarkerSignalled,
    NodeReset,
    NodeStop,
    Ready,
    Shutdown,
)
from sioms.protocol.verbs import Message, take
from sioms.sdk.control import MOST_AHEAD, MOST_UNSENT, Control


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


def test_what_a_daemon_that_is_held_up_has_left_no_room_for_is_sent_later_in_its_order() -> None:
    """A fault, a lost link, a node that takes no orders: nothing tells of them again."""
    daemon, driver = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    watched: list[bool] = []
    control = Control(driver.detach(), watched.append)
    told: list[Message] = [*(MarkerSignalled(n) for n in range(1000)), HeldSilent("mod0", "mute")]
    for message in told:
        control.tell(message)
    for _ in range(MOST_UNSENT):
        control.tell(LogLine("info", "again and again"))
    assert watched == [True] and len(control._unsent) < 1000
    heard: list[Message] = []
    while len(heard) < len(told):
        while len(control._unsent) < len(told) and is_readable(daemon):
            heard.append(take(daemon.recv(1 << 16), FROM_DRIVER, state="up")[1])
        control.send_rest()
    assert heard[: len(told)] == told and not any(isinstance(each, LogLine) for each in heard)
    assert watched == [True, False]
    for _ in range(1000):
        control.tell(MarkerSignalled(1))
    daemon.close()
    control.send_rest()
    assert not control._unsent and watched == [True, False, True, False]
    control.close()


def test_a_driver_that_has_much_to_tell_while_it_starts_is_ready_when_there_is_room() -> None:
    """With no room in the socket the start ended with an error, or the pages came ahead of what was told before."""
    daemon, driver = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    control = Control(driver.detach())
    while not control.waits_for_room:
        control.tell(LogLine("info", "looking for the drive"))
    control.tell(HeldSilent("mod0", "mute"))
    page = os.memfd_create("page")
    control.tell_ready([page])
    os.close(page)
    heard: list[tuple[Message, int]] = []
    while control.waits_for_room or is_readable(daemon):
        packet, fds = receive(daemon, 1 << 16, 8)
        heard.append((take(packet, FROM_DRIVER, state="starting")[1], len(fds)))
        for fd in fds:
            os.close(fd)
        control.send_rest()
    assert heard[-2:] == [(HeldSilent("mod0", "mute"), 0), (Ready(1), 1)]
    control.tell_ready([])
    daemon.close()
    control.close()
