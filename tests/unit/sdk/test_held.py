"""Axes of other devices that a device holds: what goes to them, in which order, and who is told when they are deaf."""

from __future__ import annotations

import errno
import socket
from collections.abc import Iterator
from typing import Any

import pytest

from sioms.protocol.driver_verbs import HeldSilent
from sioms.protocol.flags import NodeClass, Request
from sioms.protocol.messages import MAX_PACKET, refusal, reply
from sioms.protocol.records import WRITE, WRITE_STRUCT
from sioms.protocol.verbs import ON_HANDLE, Ioctl, Message, Write, take
from sioms.sdk.driver import AtLimitError
from sioms.sdk.held import Held

MOST_NS = 100_000_000
_VELOCITY = list(WRITE[NodeClass.AXIS]).index("velocity")


class Driver:
    """The driver of what is held: it serves when it is told to."""

    def __init__(self) -> None:
        ours, self.sock = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self.sock.setblocking(False)
        self.now_ns = 1_000_000_000
        self.told: list[Message] = []
        self.held = Held("x", MOST_NS, lambda: self.now_ns, self.told.append)
        self.held.attach(ours.detach(), [])

    def take(self) -> tuple[int, Any] | None:
        """Return the number of the next request, and it: a velocity, or a Request."""
        try:
            number, message = take(self.sock.recv(MAX_PACKET), ON_HANDLE)
        except BlockingIOError:
            return None
        if isinstance(message, Write):
            return number, WRITE_STRUCT[NodeClass.AXIS].unpack(message[2])[_VELOCITY]
        assert isinstance(message, Ioctl)
        return number, Request(message[0])

    def serve(self) -> list[Any]:
        """Answer everything; return what it was."""
        found = []
        while (request := self.take()) is not None:
            found.append(request[1])
            if request[1] is not Request.WAIT_UNTIL_IDLE:
                self.sock.send(reply(request[0], None, self.now_ns))
        return found


@pytest.fixture
def driver() -> Iterator[Driver]:
    made = Driver()
    yield made
    made.held.detach()
    made.sock.close()


def test_commands_that_are_not_served_do_not_queue_and_the_last_one_comes(driver: Driver) -> None:
    held = driver.held
    for velocity in range(50):
        held.drive([float(velocity)])
        assert held.trouble() is None
    assert driver.serve() == [0.0, Request.WAIT_UNTIL_IDLE], "one is on its way, and no more"
    assert held.trouble() is None
    assert driver.serve() == [49.0], "the last, though nobody calls drive again"
    assert held.trouble() is None
    assert driver.serve() == []


def test_a_stop_takes_the_place_of_the_command_that_waits(driver: Driver) -> None:
    driver.held.drive([1.0])
    driver.held.drive([2.0])
    driver.held.stop()
    assert driver.serve() == [1.0, Request.WAIT_UNTIL_IDLE, Request.STOP]
    assert driver.held.trouble() is None
    assert driver.serve() == []


@pytest.mark.parametrize("order", ["drive", "stop", "reset"])
def test_an_order_that_is_not_answered_in_time_is_told_to_the_daemon(driver: Driver, order: str) -> None:
    held = driver.held
    {"drive": lambda: held.drive([1.0]), "stop": held.stop, "reset": lambda: held.reset(5)}[order]()
    driver.now_ns += MOST_NS
    assert held.trouble() is None and not driver.told
    driver.now_ns += 1
    trouble = held.trouble()
    assert trouble is not None and trouble.errno == errno.ETIMEDOUT and "x: " in str(trouble)
    assert not held.is_there
    assert [type(message) for message in driver.told] == [HeldSilent] and driver.told[0][0] == "x"
    assert held.trouble() is None and len(driver.told) == 1, "once"


def test_answers_that_lie_there_count_however_late_they_are_looked_at(driver: Driver) -> None:
    driver.held.drive([1.0])
    driver.serve()
    driver.now_ns += 10 * MOST_NS
    assert driver.held.trouble() is None and not driver.told


def test_a_device_that_has_no_room_for_orders_is_told_to_the_daemon(driver: Driver) -> None:
    while driver.held.is_there:
        driver.held.stop()
    assert [type(message) for message in driver.told] == [HeldSilent]


def test_a_stop_by_somebody_ends_the_watch_with_its_reason(driver: Driver) -> None:
    driver.held.drive([1.0])
    requests = [driver.take(), driver.take()]
    driver.sock.send(reply(requests[0][0], None, 1))  # type: ignore[index]
    driver.sock.send(refusal(requests[1][0], errno.ECANCELED, "stopped by eva"))  # type: ignore[index]
    assert "stopped by eva" in str(driver.held.trouble())


def test_an_axis_that_was_stopped_at_its_own_limit_is_told_apart(driver: Driver) -> None:
    driver.held.drive([1.0])
    requests = [driver.take(), driver.take()]
    driver.sock.send(refusal(requests[1][0], errno.ERANGE, "stopped at the limit"))  # type: ignore[index]
    assert isinstance(driver.held.trouble(), AtLimitError)
    driver.sock.send(refusal(requests[0][0], errno.ERANGE, "velocity 9"))  # type: ignore[index]
    trouble = driver.held.trouble()
    assert trouble is not None and not isinstance(trouble, AtLimitError), "a command that was refused is no end"


def test_how_a_watch_ends_that_a_stop_of_our_own_has_ended_tells_nothing(driver: Driver) -> None:
    driver.held.drive([1.0])
    requests = [driver.take(), driver.take()]
    driver.held.stop()
    driver.sock.send(refusal(requests[1][0], errno.ERANGE, "stopped at the limit"))  # type: ignore[index]
    assert driver.held.trouble() is None


def test_refusals_from_before_a_reset_tell_nothing_and_its_own_does(driver: Driver) -> None:
    held = driver.held
    held.drive([1.0])
    held.reset(5)
    assert held.shows_reset_ns > driver.now_ns, "not before it is answered"
    numbers = [driver.take()[0] for _ in range(3)]  # type: ignore[index]
    driver.sock.send(refusal(numbers[0], errno.EPERM, "stopped"))
    driver.sock.send(refusal(numbers[1], errno.EIO, "stopped"))
    driver.sock.send(reply(numbers[2], None, 7))
    assert held.trouble() is None
    assert held.shows_reset_ns == 7
    held.reset(6)
    number, _ = driver.take()  # type: ignore[misc]
    driver.sock.send(refusal(number, errno.EAGAIN, "stopped since", 9))
    assert "stopped since" in str(held.trouble())
    assert held.shows_reset_ns == 9


def test_a_device_that_is_lost_and_there_again_before_anybody_looks_has_been_lost(driver: Driver) -> None:
    driver.held.drive([1.0])
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with theirs:
        driver.held.attach(ours.detach(), [])
        assert "was lost" in str(driver.held.trouble()) and driver.held.trouble() is None
        driver.held.detach()
        again, _ = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        driver.held.attach(again.detach(), [])
        assert driver.held.trouble() is None, "who has let go, or was told, hears nothing more"


def test_what_is_heard_between_two_ticks_is_told_once_and_kept_for_the_tick(driver: Driver) -> None:
    watched: list[int] = []
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    held = Held("x", MOST_NS, lambda: driver.now_ns, driver.told.append, watched.append, watched.remove)
    held.attach(ours.detach(), [])
    assert len(watched) == 1
    held.drive([1.0])
    assert held.hear() is None
    theirs.close()
    heard = held.hear()
    assert heard is not None and "does not serve it any more" in str(heard) and not watched
    assert held.hear() is None, "once, or what it brings about would call it again"
    assert held.trouble() is heard and held.trouble() is None


def test_what_is_no_answer_lets_the_node_go_and_has_it_stopped(driver: Driver) -> None:
    driver.sock.send(b"\x93\x00\x00\x00")
    trouble = driver.held.trouble()
    assert trouble is not None and trouble.errno == errno.EPROTO and "array of 0, id" in str(trouble)
    assert not driver.held.is_there and [type(message) for message in driver.told] == [HeldSilent]
