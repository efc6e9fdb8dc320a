"""What connections have brought and nobody has got: a message of many parts comes whole or not at all, so ZeroMQ keeps
what has come of one that does not end. Who lets more than a bound pile up loses his connection.

Concurrency: any threads; each number is one thread's.
"""

from __future__ import annotations

from .connections import Connection, received, shut_down

MOST, MOST_IN_ALL = 32 << 20, 256 << 20
"""Bytes that a connection, and all together, may be ahead: ZeroMQ queues 13 MB of one, and the kernel keeps some more.
"""
OVERHEAD = 128
"""Bytes that a frame has on the wire beside its own, at most."""


class Inflow:
    """What has come by each connection, and what has been taken."""

    def __init__(self) -> None:
        self._taken: dict[int, int] = {}
        self._inodes: dict[int, int] = {}
        """Which socket a descriptor was when it was looked at last."""
        self._heard: set[int] = set()

    def took(self, fd: int, size: int) -> None:
        """Note that a frame of a connection has been taken; fd < 0: nobody knows of which."""
        self._taken[fd] = self._taken.get(fd, 0) + size + OVERHEAD
        self._heard.add(fd)

    def has_heard(self, fd: int) -> bool:
        """Tell whether a frame of a connection has been taken."""
        return fd in self._heard

    def look(self, connections: dict[int, Connection]) -> list[int]:
        """Return the connections on which more has piled up than may; they have been shut down."""
        ahead, found = dict[int, int](), []
        for fd, one in connections.items():
            came = received(fd)
            if came < 0:  # a thread of ZeroMQ has closed it meanwhile
                continue
            if self._inodes.get(fd) != one.inode:
                self._taken[fd] = came  # of a new one nothing has piled up
            self._taken[fd] = min(self._taken.get(fd, 0), came)
            ahead[fd] = came - self._taken[fd]
        self._inodes = {fd: one.inode for fd, one in connections.items()}
        self._heard &= self._inodes.keys()
        in_all = sum(ahead.values())
        for fd in sorted(ahead, key=ahead.__getitem__, reverse=True):
            if ahead[fd] <= MOST and in_all <= MOST_IN_ALL:
                break
            in_all -= ahead[fd]
            found.append(fd)
            shut_down(fd)
        return found
