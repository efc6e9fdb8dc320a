"""The local transport of readings: a page of shared memory and a pipe, both passed by the daemon."""

from __future__ import annotations

import os
from _socket import socket
from mmap import PROT_READ, mmap

from sioms.protocol.nodeinfo import NodeInfo
from sioms.protocol.page import PageReader

from .channel import Channel

TYPE_CHECKING = False
if TYPE_CHECKING:
    from typing import Any

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


def node_parts(value: Any, fds: list[int]) -> tuple[Any, ...]:
    """Turn the answer to an open into the arguments of a node."""
    handle, packed, channels, bit, behind = value
    info = NodeInfo(packed)
    channel = Channel(socket(fileno=fds[2]), f"node {info.name}", False, behind=behind)
    return info, handle, LocalPage(fds[0], fds[1]), list(channels), bit, channel
