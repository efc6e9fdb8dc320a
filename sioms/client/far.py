"""What a session of a link has here of nodes and journals at its other end: pages and copies in memory, sockets, pipes.

Concurrency: that of the session (``remote``).
"""

from __future__ import annotations

import os
import socket
from contextlib import suppress
from mmap import mmap

from sioms.protocol.journal import HEADER, JOURNAL_SIZE, JournalWriter, take_events
from sioms.protocol.link import MalformedFrame, PageShape
from sioms.protocol.messages import MalformedMessage
from sioms.protocol.page import PageCopy, page_size

STALE_S = 0.2
"""How much older than its driver's lease a reading may get on its way [s]; then it is none."""
_BUFFER = 1 << 19


class Far:
    """A node at the other end: its page here, and our ends of its sockets."""

    def __init__(self, shape: PageShape) -> None:
        size = page_size(shape.node_class, shape.channels, shape.slots)
        self.page_fd = os.memfd_create("sioms-page", os.MFD_CLOEXEC)
        os.ftruncate(self.page_fd, size)
        self._map = mmap(self.page_fd, size)
        lease_ns = shape.lease_ns + int(STALE_S * 1e9)
        self.shape = shape
        self.page = PageCopy(
            memoryview(self._map), shape.node_class, shape.channels, shape.slots, lease_ns, shape.generation,
            shape.device,
        )  # fmt: skip
        self.wake_read, self.wake = os.pipe2(os.O_CLOEXEC | os.O_NONBLOCK)
        self.ours, self.theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self.ours.setblocking(False)
        self.theirs.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _BUFFER)
        self.answer = b""
        self.unconfirmed = 0
        self.ended = False

    def hand_over(self, session: socket.socket) -> None:
        """Pass the program's ends along with the answer to its open."""
        fds = [self.page_fd, self.wake_read, self.theirs.fileno()]
        try:
            socket.send_fds(session, [self.answer], fds)
        finally:
            self.answer = b""
            os.close(self.page_fd)
            os.close(self.wake_read)
            self.page_fd = self.wake_read = -1
            self.theirs.close()

    def wake_up(self) -> None:
        """Make the program's end of the pipe readable."""
        with suppress(OSError):  # full, or closed
            os.write(self.wake, b"\1")

    def close(self) -> None:
        """Let go of everything; what the program has goes on being there."""
        self.ours.close()
        self.theirs.close()
        for fd in (self.wake, self.page_fd, self.wake_read):
            if fd >= 0:
                os.close(fd)
        self.page.release()
        self._map.close()


class FarJournal:
    """A journal at the other end: a copy here, which the program maps."""

    def __init__(self) -> None:
        self._fd = os.memfd_create("sioms-journal", os.MFD_CLOEXEC)
        os.ftruncate(self._fd, HEADER + JOURNAL_SIZE)
        self._map = mmap(self._fd, HEADER + JOURNAL_SIZE)
        self._writer = JournalWriter(memoryview(self._map))
        self._leash_read, self._leash = os.pipe2(os.O_CLOEXEC | os.O_NONBLOCK)

    def put(self, events: bytes) -> None:
        """Add events; raises MalformedFrame."""
        try:
            for event in take_events(events):
                self._writer.put(event)
        except MalformedMessage as error:
            raise MalformedFrame(str(error)) from None

    def hand_over(self, session: socket.socket, answer: bytes) -> None:
        """Pass it along with the answer to its request."""
        fd = os.open(f"/proc/self/fd/{self._fd}", os.O_RDONLY | os.O_CLOEXEC)
        try:
            socket.send_fds(session, [answer], [fd, self._leash_read])
        finally:
            os.close(fd)

    def close(self) -> None:
        """Let go of it; the program reads to the end what it has."""
        for fd in (self._leash, self._leash_read, self._fd):
            os.close(fd)
        self._writer.release()
        self._map.close()
