"""What connections have brought and nobody has got: a message of many parts comes whole or not at all, so ZeroMQ keeps
what has come of one that does not end. Who lets more than a bound pile up loses his connection.

Concurrency: any threads; each number is one thread's.
"""

from __future__ import annotations

import ctypes
import os
import socket
from contextlib import suppress

MOST, MOST_IN_ALL = 32 << 20, 256 << 20
"""Bytes that a connection, and all together, may be ahead: ZeroMQ queues 13 MB of one, and the kernel keeps some more.
"""
OVERHEAD = 128
"""Bytes that a frame has on the wire beside its own, at most."""
_TCP_INFO, _RECEIVED = 11, 128
_libc = ctypes.CDLL(None, use_errno=True)


def received(fd: int) -> int:
    """Return how many bytes have come by a TCP connection; -1: the descriptor is none."""
    info, size = ctypes.create_string_buffer(256), ctypes.c_uint32(256)
    if _libc.getsockopt(fd, socket.IPPROTO_TCP, _TCP_INFO, info, ctypes.byref(size)) or size.value < _RECEIVED + 8:
        return -1
    return int.from_bytes(info.raw[_RECEIVED : _RECEIVED + 8], "little")


class Inflow:
    """The connections of this process."""

    def __init__(self) -> None:
        self._taken: dict[int, int] = {}
        self._sockets: dict[int, int] = {}
        """Which socket a descriptor was when it was looked at last."""

    def took(self, fd: int, size: int) -> None:
        """Note that a frame of a connection has been taken; fd < 0: nobody knows of which."""
        self._taken[fd] = self._taken.get(fd, 0) + size + OVERHEAD

    def look(self) -> list[int]:
        """Return the connections on which more has piled up than may; they have been shut down."""
        sockets, ahead, found = dict[int, int](), dict[int, int](), []
        for fd in map(int, os.listdir("/proc/self/fd")):
            try:
                came, inode = received(fd), os.fstat(fd).st_ino
            except OSError:  # a thread of ZeroMQ has closed it meanwhile
                continue
            if came < 0:
                continue
            sockets[fd] = inode
            if self._sockets.get(fd) != sockets[fd]:
                self._taken[fd] = came  # of a new one nothing has piled up
            self._taken[fd] = min(self._taken.get(fd, 0), came)
            ahead[fd] = came - self._taken[fd]
        self._sockets = sockets
        in_all = sum(ahead.values())
        for fd in sorted(ahead, key=ahead.__getitem__, reverse=True):
            if ahead[fd] <= MOST and in_all <= MOST_IN_ALL:
                break
            in_all -= ahead[fd]
            found.append(fd)
            with suppress(OSError), socket.socket(fileno=os.dup(fd)) as sock:
                sock.shutdown(socket.SHUT_RDWR)
        return found
