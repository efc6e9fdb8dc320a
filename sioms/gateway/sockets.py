"""The gateway's ends of Unix sockets: a session at the daemon, and the nodes that it has opened there."""

from __future__ import annotations

import errno
import os
import socket
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from mmap import PROT_READ, mmap
from typing import TYPE_CHECKING, Protocol, TypeVar

from sioms.client.connecting import connect
from sioms.protocol.journal import Event, JournalReader
from sioms.protocol.link import PageShape
from sioms.protocol.messages import MAX_PACKET, MAX_WRITE, MalformedMessage
from sioms.protocol.page import PageReader

if TYPE_CHECKING:
    from _socket import socket as Socket

T = TypeVar("T")
MOST_QUEUED = MAX_WRITE + (1 << 20)
"""Bytes that wait for a driver that does not take them [one write of the largest size, and what is around it]."""
_WAKES = 4096


class Watch(Protocol):
    """The loop, as far as sockets need it."""

    def add(self, fd: int, readable: Callable[[], None], writable: Callable[[], None] | None = None) -> None:
        """Call back when a descriptor is readable, or writable if that is wanted; again: instead of before."""

    def remove(self, fd: int) -> None:
        """Watch it no more."""


def _received(receive: Callable[[], T]) -> T | None:
    """Return what one call receives, None for the end. Of who has closed before reading everything, a reset is
    reported once, ahead of the last word. Raises BlockingIOError: there is nothing yet.
    """
    for _ in range(2):
        try:
            return receive()
        except ConnectionResetError:
            continue
        except BlockingIOError:
            raise
        except OSError:
            break
    return None


class DaemonLine:
    """A session at the daemon; see ``core.Line``.

    Args:
        path: the daemon's socket.
        watch: the loop.
        packet: called with each packet and its descriptors; an empty packet is the end.

    Raises:
        OSError: no daemon there, with a sentence.
    """

    def __init__(self, path: str, watch: Watch, packet: Callable[[bytes, Sequence[int]], None]) -> None:
        self._sock = connect(path)
        self._sock.setblocking(False)
        self._watch = watch
        self._packet = packet
        watch.add(self._sock.fileno(), self._readable)

    def _readable(self) -> None:
        fds: list[int] = []
        space = socket.CMSG_SPACE(8 * 4)
        try:
            found = _received(lambda: self._sock.recvmsg(MAX_PACKET, space, socket.MSG_CMSG_CLOEXEC))
        except BlockingIOError:
            return
        packet, ancillary, _, _ = found or (b"", [], 0, None)
        for level, kind, data in ancillary:
            if (level, kind) == (socket.SOL_SOCKET, socket.SCM_RIGHTS):
                fds += memoryview(data[: len(data) - len(data) % 4]).cast("i")
        if not packet:
            self._watch.remove(self._sock.fileno())
        self._packet(packet, fds)

    def send(self, packet: bytes) -> None:
        """Send a packet; that a daemon has gone is noticed where its last word is read. Raises OSError."""
        with suppress(ConnectionError):
            self._sock.send(packet)

    def close(self) -> None:
        """Close it."""
        if self._sock.fileno() >= 0:
            self._watch.remove(self._sock.fileno())
            self._sock.close()


class OpenNode:
    """A node that the daemon has opened for a session; see ``core.Node``.

    Args:
        fds: of its page, its wake pipe and its socket, as the daemon passes them; owned from now on.
        watch: the loop.
        packet: called with each packet of the driver; an empty one is the end.
        woken: called when the driver has woken the subscriber.
    """

    def __init__(
        self, fds: Sequence[int], watch: Watch, packet: Callable[[bytes], None], woken: Callable[[], None]
    ) -> None:
        page_fd, self._wake_fd, sock_fd = fds
        self._sock: Socket | None = socket.socket(fileno=sock_fd)
        self._sock.setblocking(False)
        self._map = mmap(page_fd, os.fstat(page_fd).st_size, prot=PROT_READ)
        os.close(page_fd)
        self.page = page = PageReader(self._map)
        self.shape = PageShape(
            page.node_class, page.channels, page.slots, page.lease_ns, page.generation, page.device
        )  # fmt: skip
        self._watch = watch
        self._packet = packet
        self._told = woken
        self._queue: deque[bytes] = deque()
        self._queued = 0
        watch.add(sock_fd, self._readable)
        watch.add(self._wake_fd, self._woken)

    def _readable(self) -> None:
        if self._sock is None:
            return
        sock = self._sock
        try:
            packet = _received(lambda: sock.recv(MAX_PACKET)) or b""
        except BlockingIOError:
            return
        self._packet(packet)

    def _woken(self) -> None:
        try:
            if not os.read(self._wake_fd, _WAKES):
                self._watch.remove(self._wake_fd)
        except BlockingIOError:
            return
        self._told()

    def send(self, packet: bytes) -> None:
        """Send a packet to the driver, as soon as it takes one, and take an answer that is there at once: a driver on
        the same processor runs first; one that has gone is noticed where its last word is read. Raises BlockingIOError
        when it takes none for long.
        """
        if self._sock is None:
            return
        if not self._queue:
            try:
                self._sock.send(packet)
            except BlockingIOError:
                self._watch.add(self._sock.fileno(), self._readable, self._writable)
            except ConnectionError:
                return
            else:
                self._readable()
                return
        self._queue.append(packet)
        self._queued += len(packet)
        if self._queued > MOST_QUEUED:
            raise BlockingIOError("its driver takes no packets")

    def _writable(self) -> None:
        try:
            while self._queue and self._sock is not None:
                self._sock.send(self._queue[0])
                self._queued -= len(self._queue.popleft())
        except BlockingIOError:
            return
        except OSError:
            self._queue.clear()
        if self._sock is not None:
            self._watch.add(self._sock.fileno(), self._readable)

    def end(self) -> None:
        """Close the socket: the driver halts what it owned."""
        if self._sock is not None:
            self._watch.remove(self._sock.fileno())
            self._sock.close()
            self._sock = None
            self._watch.remove(self._wake_fd)

    def close(self) -> None:
        """Let go of everything."""
        self.end()
        if self._wake_fd >= 0:
            os.close(self._wake_fd)
            self._wake_fd = -1
            self.page.release()
            self._map.close()


class FollowedJournal:
    """A journal that the daemon has opened for a session; see ``core.Journal``.

    Args:
        fds: of its memory, and of what ends when the right to it does; owned from now on.
        watch: the loop.
        over: called when the right has ended.

    Raises:
        OSError: it cannot be mapped, or is none that this version reads.
    """

    def __init__(self, fds: Sequence[int], watch: Watch, over: Callable[[], None]) -> None:
        fd, self._leash = fds
        self._watch, self._over = watch, over
        try:
            self._map = mmap(fd, os.fstat(fd).st_size, prot=PROT_READ)
            self._reader = JournalReader(self._map)
        except (OSError, ValueError, MalformedMessage) as error:
            os.close(self._leash)
            raise OSError(errno.EIO, f"read a journal: {error}") from None
        finally:
            os.close(fd)
        watch.add(self._leash, over)

    def read(self, most_bytes: int) -> list[Event]:
        """Return events since the last look, oldest first; none if the right has ended meanwhile."""
        return [] if self._leash < 0 else self._reader.read(most_bytes)

    def close(self) -> None:
        """Let go of it."""
        if self._leash >= 0:
            self._watch.remove(self._leash)
            os.close(self._leash)
            self._leash = -1
            self._reader.release()
            self._map.close()
