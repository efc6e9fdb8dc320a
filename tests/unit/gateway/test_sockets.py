"""The gateway's ends of Unix sockets, on real ones."""

from __future__ import annotations

import os
import socket
from collections.abc import Iterator

import pytest
from gateway_rig import WRITE

from sioms.gateway import sockets
from sioms.gateway.sockets import DaemonLine, OpenNode
from sioms.protocol.flags import NodeClass
from sioms.protocol.messages import reply
from sioms.protocol.page import PageWriter, page_size


class Loop:
    """A loop that is never waited in."""

    def add(self, *_: object) -> None:
        pass

    def remove(self, _: int) -> None:
        pass


@pytest.fixture
def opened() -> Iterator[tuple[OpenNode, socket.socket, list[bytes]]]:
    """An open node, the driver's end of its socket, and what has come."""
    size = page_size(NodeClass.AXIS, 1, 8)
    memory = os.memfd_create("page")
    os.ftruncate(memory, size)
    page = bytearray(size)
    PageWriter(memoryview(page), NodeClass.AXIS, 1, 8, 10**12, 1, 77)
    os.pwrite(memory, page, 0)
    wake, other = os.pipe()
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    came: list[bytes] = []
    node = OpenNode((memory, wake, ours.detach()), Loop(), came.append, lambda: None)
    yield node, theirs, came
    node.close()
    theirs.close()
    os.close(other)


Opened = tuple[OpenNode, socket.socket, list[bytes]]


def test_an_answer_that_is_there_when_a_packet_has_been_sent_is_taken_at_once(opened: Opened) -> None:
    """A driver of a higher class on the same processor has answered by then."""
    node, theirs, came = opened
    node.send(WRITE)
    assert not came and theirs.recv(1000) == WRITE, "none is there yet, which is no end"
    theirs.send(reply(3))
    node.send(WRITE)
    assert came == [reply(3)]


@pytest.mark.parametrize("unread", [False, True])
def test_the_last_word_of_a_driver_that_has_ended_the_handle_comes_first(opened: Opened, unread: bool) -> None:
    """Also to who writes before reading it, and where the driver has not read everything."""
    node, theirs, came = opened
    if unread:
        node.send(WRITE)
    theirs.send(reply(0))
    theirs.close()
    node.send(WRITE)
    if not came:
        node._readable()
    node._readable()
    assert came == [reply(0), b""]


@pytest.mark.parametrize("unread", [False, True])
def test_the_last_word_of_a_daemon_comes_first(unread: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    monkeypatch.setattr(sockets, "connect", lambda _: ours)
    came: list[bytes] = []
    line = DaemonLine("", Loop(), lambda packet, _: came.append(packet))
    if unread:
        line.send(WRITE)
    theirs.send(reply(0))
    theirs.close()
    line.send(WRITE)
    line._readable()
    line._readable()
    assert came == [reply(0), b""]
    line.close()
