"""The TCP connections by which clients come to this process, and who of them is a stranger: one that has not proved who
he is. ZeroMQ accepts connections without a bound; here is one, and who has been admitted keeps his place.

Concurrency: one thread; other threads may close connections meanwhile.
"""

from __future__ import annotations

import ctypes
import math
import os
import socket
import time
from collections.abc import Callable, Collection
from contextlib import suppress
from dataclasses import dataclass

MOST_STRANGERS = 256
"""Connections of strangers, at most."""
PROOF_S = 3.0
"""How long one may stay a stranger [s]; ZeroMQ ends a handshake that takes 2 s."""
SAID_S = 10.0
"""How often the log says so, at most [s]."""
_TCP_INFO, _RECEIVED = 11, 128
_libc = ctypes.CDLL(None, use_errno=True)


@dataclass(frozen=True, slots=True)
class Connection:
    """A connection.

    Attributes:
        inode: of its socket: a descriptor may become another one's.
        port: of ours at which it came in.
        peer: the other end, HOST:PORT.
        since_s: when it was seen first [s, CLOCK_MONOTONIC].
    """

    inode: int
    port: int
    peer: str
    since_s: float


def received(fd: int) -> int:
    """Return how many bytes have come by a TCP connection; -1: the descriptor is none."""
    info, size = ctypes.create_string_buffer(256), ctypes.c_uint32(256)
    if _libc.getsockopt(fd, socket.IPPROTO_TCP, _TCP_INFO, info, ctypes.byref(size)) or size.value < _RECEIVED + 8:
        return -1
    return int.from_bytes(info.raw[_RECEIVED : _RECEIVED + 8], "little")


def shut_down(fd: int) -> None:
    """End a connection that a library owns: it finds it ended, and closes it."""
    with suppress(OSError), socket.socket(fileno=os.dup(fd)) as sock:
        sock.shutdown(socket.SHUT_RDWR)


class Connections:
    """The connections of this process that came in at some of its ports.

    Args:
        ports: of ours; None: any.
    """

    def __init__(self, ports: Collection[int] | None = None) -> None:
        self._ports = ports
        self._seen: dict[int, Connection | None] = {}  # None: no connection, or one of another port
        self._inodes: dict[int, int] = {}

    def look(self) -> dict[int, Connection]:
        """Return them by descriptor.

        Raises:
            OSError: no descriptor is left for looking.
        """
        inodes, now_s = dict[int, int](), time.monotonic()
        for fd in map(int, os.listdir("/proc/self/fd")):
            try:
                inodes[fd] = os.fstat(fd).st_ino
                if self._inodes.get(fd) != inodes[fd]:
                    self._seen[fd] = self._about(fd, inodes[fd], now_s)
            except OSError:  # a thread of the library has closed it meanwhile
                inodes.pop(fd, None)
        for fd in self._inodes.keys() - inodes.keys():
            del self._seen[fd]
        self._inodes = inodes
        return {fd: one for fd in inodes if (one := self._seen[fd]) is not None}

    def _about(self, fd: int, inode: int, now_s: float) -> Connection | None:
        if received(fd) < 0:
            return None
        with socket.socket(fileno=os.dup(fd)) as sock:
            try:
                port, (host, of_peer) = sock.getsockname()[1], sock.getpeername()[:2]
            except OSError:  # it listens
                return None
        if self._ports is not None and port not in self._ports:
            return None
        return Connection(inode, port, f"[{host}]:{of_peer}" if ":" in host else f"{host}:{of_peer}", now_s)


class Strangers:
    """Ends the connections of strangers that are too many, or stay too long.

    Args:
        log: writes a line.
    """

    def __init__(self, log: Callable[..., None]) -> None:
        self._log = log
        self._ended, self._said_s = 0, -math.inf

    def turn_away(self, connections: dict[int, Connection], is_known: Callable[[int, Connection], bool]) -> None:
        """End what has to end.

        Args:
            connections: all, by descriptor.
            is_known: tells who has proved who he is.
        """
        now_s = time.monotonic()
        for fd in too_many(connections, is_known, now_s):
            shut_down(fd)
            self._ended += 1
        if self._ended and now_s - self._said_s > SAID_S:
            why = f"nobody has proved who he is; at most {MOST_STRANGERS} such ones may wait, each {PROOF_S:g} s"
            self._log("warning", "connections ended", count=self._ended, why=why)
            self._ended, self._said_s = 0, now_s


def too_many(
    connections: dict[int, Connection], is_known: Callable[[int, Connection], bool], now_s: float
) -> list[int]:
    """Return the connections to be ended: of strangers who had the time for a proof, and the newest above the bound.

    Args:
        connections: all, by descriptor.
        is_known: tells who has proved who he is.
        now_s: CLOCK_MONOTONIC [s].
    """
    unknown = [(one.since_s, fd) for fd, one in connections.items() if not is_known(fd, one)]
    unknown.sort()
    late = sum(now_s - since_s > PROOF_S for since_s, _ in unknown)
    return [fd for _, fd in (*unknown[:late], *unknown[late + MOST_STRANGERS :])]
