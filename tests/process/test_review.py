"""What a client must not be able to do to driver or daemon, and what must not go on after a loss."""

from __future__ import annotations

import errno
import mmap
import os

import pytest
from daemon_rig import Daemon

import sioms
from sioms.client.channel import Call, Channel, connect
from sioms.protocol.flags import PROTOCOL_VERSION
from sioms.protocol.latch import REQUEST_SIZE
from sioms.protocol.messages import ClientVerb


def test_the_stop_request_page_cannot_be_taken_away(daemon: Daemon, cell: sioms.Workcell) -> None:
    channel = Channel(connect(daemon.socket), "the daemon")
    (fd,) = channel.call(Call("hello", ClientVerb.HELLO, PROTOCOL_VERSION, "rogue")).fds
    try:
        for size in (0, 2 * REQUEST_SIZE):  # whoever maps a page that has shrunk dies of SIGBUS
            with pytest.raises(OSError) as refused:
                os.ftruncate(fd, size)
            assert refused.value.errno == errno.EPERM
        mmap.mmap(fd, REQUEST_SIZE)[8:16] = bytes(8)  # writable all the same
    finally:
        os.close(fd)
        channel.close()
    assert cell.status()["pid"] == daemon.pid
