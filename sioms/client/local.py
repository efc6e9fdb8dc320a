"""The local transport of readings: a page of shared memory and a pipe, both passed by the daemon."""

from __future__ import annotations

import errno
import os
from _socket import socket
from mmap import PROT_READ, mmap

from sioms.protocol.nodeinfo import NodeInfo
from sioms.protocol.page import PageReader

from .channel import Channel, Descriptors

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Callable
    from typing import Any

    from sioms.protocol.clock import Clock

    from .carrying import Carrier

RENEWED_NS = 50_000_000
"""How often reading renews leases, unless one is shorter than four times that [ns]."""
_WAKES = 4096
"""Bytes taken out of the wake pipe in one go, one a publication."""


class LocalPage(PageReader):
    """The snapshots of a node out of shared memory; see ``transport.Readings``.

    Args:
        page_fd: of the page; it is closed.
        wake_fd: reading end of the wake pipe, owned from now on.
    """

    __slots__ = ("_map", "_wake_fd")

    def __init__(self, page_fd: int, wake_fd: int) -> None:
        self._map: mmap | None = mmap(page_fd, os.fstat(page_fd).st_size, prot=PROT_READ)
        os.close(page_fd)
        self._wake_fd = wake_fd
        super().__init__(self._map)

    @property
    def closed(self) -> bool:
        """Whether it has been released."""
        return self._map is None

    def fileno(self) -> int:
        """Return the descriptor that is readable after a publication that was subscribed to."""
        return self._wake_fd

    def drain(self) -> None:
        """Make the descriptor unreadable until the next publication."""
        try:
            os.read(self._wake_fd, _WAKES)
        except BlockingIOError:
            return

    def release(self) -> None:
        """Let go of memory and pipe."""
        if self._map is not None:
            super().release()
            self._map.close()
            self._map = None
            os.close(self._wake_fd)


class LeasedPage(LocalPage):
    """The same of a node behind a gateway: reading renews the leases of its session.

    Attributes:
        renew: does so.
        every_ns: how often at most [ns].
    """

    __slots__ = ("_due_ns", "every_ns", "renew")

    def __init__(self, page_fd: int, wake_fd: int, renew: Callable[[], None]) -> None:
        super().__init__(page_fd, wake_fd)
        self.renew, self.every_ns, self._due_ns = renew, RENEWED_NS, 0

    def latest(self, now_ns: int) -> bytes:
        """Copy the newest snapshot; see ``PageReader.latest``."""
        if now_ns > self._due_ns:
            self._due_ns = now_ns + self.every_ns
            self.renew()
        return super().latest(now_ns)


def node_parts(
    value: Any, fds: Descriptors, clock: Clock | None = None, carrier: Carrier | None = None
) -> tuple[Any, ...]:
    """Turn the answer to an open into the arguments of a node.

    Args:
        value: the answer.
        fds: that came with it.
        clock: of the cell, where that is another machine's.
        carrier: of the session, as of ``Channel``.

    Raises:
        OSError: EMFILE, this process has no descriptors left.
    """
    handle, packed, channels, bit, behind = value
    info = NodeInfo(packed)
    if len(fds) < 3:  # the kernel drops what goes beyond the limit; its driver sees that nobody has it
        raise OSError(errno.EMFILE, f"open {info.name}: too many open files in this process; close some")
    # In one step: a signal that came between two would leave a descriptor that nobody knows, and with it the node open.
    sock = next(map(socket, (-1,), (-1,), (-1,), iter(fds.pop, None)))
    carried = None if carrier is None else carrier.of(handle, sock)
    channel = Channel(sock, f"node {info.name}", False, behind=behind, clock=clock, carrier=carried)
    if clock is None:
        return info, handle, LocalPage(*fds.take()), list(channels), bit, channel

    def renew() -> None:
        try:
            if channel.fellows:
                channel.keepalive()
        except OSError:
            return  # its next request says what has happened

    page_fd, wake_fd = fds.take()
    page = LeasedPage(page_fd, wake_fd, renew)
    return info, handle, page, list(channels), bit, channel
