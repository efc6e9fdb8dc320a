"""The gateway's ends of Unix sockets, on real ones."""

from __future__ import annotations

import os
import socket

from gateway_rig import WRITE

from sioms.gateway.sockets import OpenNode
from sioms.protocol.flags import NodeClass
from sioms.protocol.messages import reply
from sioms.protocol.page import PageWriter, page_size


class Loop:
    """A loop that is never waited in."""

    def add(self, *_: object) -> None:
        pass

    def remove(self, _: int) -> None:
        pass


def test_an_answer_that_is_there_when_a_packet_has_been_sent_is_taken_at_once() -> None:
    """A driver of a higher class on the same processor has answered by then."""
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
    node.send(WRITE)
    assert not came and theirs.recv(1000) == WRITE, "none is there yet, which is no end"
    theirs.send(reply(3))
    node.send(WRITE)
    assert came == [reply(3)]
    node.close()
    theirs.close()
    os.close(other)
