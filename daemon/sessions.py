"""Sessions and handles: what the daemon knows of its clients."""

from __future__ import annotations

import itertools
import os
import socket
import struct
import sys
from array import array
from collections.abc import Callable
from dataclasses import dataclass, field

from sioms.protocol.flags import Access, Right

from .journals import Leash
from .loop import Timer
from .names import Claim, Node
from .rights import Peer
from .users import Users

_SO_PEERGROUPS = 59  # not in the socket module; Linux 4.13
_MOST_GROUPS = 256
_SO_PEERPIDFD = 77  # Linux 6.5; not in the socket module of Python 3.11


LATER = object()
"""Returned by a verb whose answer comes later."""


class Refused(Exception):
    """A request is refused: errno and one sentence."""

    def __init__(self, errno_: int, text: str) -> None:
        super().__init__(text)
        self.errno = errno_


@dataclass(slots=True)
class Handle:
    """An open node.

    Attributes:
        number: unique in the daemon's life.
        session: who opened it.
        node: what was opened.
        access: how.
        since_ns: when.
        generation: of the driver process it is attached to.
        rights: what its user may do with it, as the driver was told.
        closing: message number of the close that waits for the driver, if any.
        ending: whether its end has been decided; the driver carries it out.
    """

    number: int
    session: Session
    node: Node
    access: Access
    since_ns: int
    generation: int
    rights: Right
    closing: int = 0
    ending: bool = False

    @property
    def claims(self) -> list[Claim]:
        """What it owns."""
        return self.node.claims()


@dataclass(slots=True, eq=False)
class Wait:
    """A request that is not answered yet.

    Attributes:
        what: the request in words.
        why: tells at its time-out what stands in the way.
        forget: drops it where it is kept; called when it has ended in whatever way.
    """

    number: int
    session: Session
    timer: Timer | None
    what: str
    why: Callable[[], str] | None = None
    forget: Callable[[], None] = lambda: None


@dataclass(slots=True, eq=False)
class Session:
    """One client's connection.

    Attributes:
        sock: its socket, non-blocking.
        peer: its credentials.
        pidfd: descriptor of its process, -1 when the kernel gives none.
        name: what it calls itself.
        handles: by number.
        waits: unanswered requests by message number.
        greeting: ends it if it says nothing; None once it has.
        greeted: whether it has said hello.
        leash: of the journals that it reads; None: of none.
        said_ns: when the reset that follows was sent at the earliest [ns, CLOCK_MONOTONIC]; 0: it has not been said.
        timestamp_ns: of the packet that is served, by the kernel [ns, CLOCK_REALTIME]; 0: it has none.
        early_bytes: how much lies in its socket that was sent before there were timestamps.
        number: no other session has had it.
    """

    sock: socket.socket
    peer: Peer
    pidfd: int
    name: str = ""
    handles: dict[int, Handle] = field(default_factory=dict)
    waits: dict[int, Wait] = field(default_factory=dict)
    greeting: Timer | None = None
    greeted: bool = False
    leash: Leash | None = None
    said_ns: int = 0
    timestamp_ns: int = 0
    early_bytes: int = 0
    number: int = field(default_factory=itertools.count(1).__next__)

    @property
    def user(self) -> str:
        """Whose it is."""
        return self.peer.user

    def cut(self) -> None:
        """Tell its client that it may read no journals any more."""
        if self.leash is not None:
            self.leash.cut()
            self.leash = None

    def __str__(self) -> str:
        name = f"({self.name})" if self.name and self.peer.key else self.name
        return f"{self.peer} {name}".rstrip()


def peer_of(sock: socket.socket, users: Users) -> Peer:
    """Return the credentials of the other end as they were when it connected, vouched for by the kernel, without groups
    left since.
    """
    pid, uid, gid = struct.unpack("3i", sock.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, 12))
    try:
        others = array("I", sock.getsockopt(socket.SOL_SOCKET, _SO_PEERGROUPS, 4 * _MOST_GROUPS))
    except OSError:
        others = array("I")  # more than fit: only the first counts
    name = users.name(uid)
    return Peer(pid, uid, name, users.remaining(uid, frozenset([gid, *others])))


def pidfd_of(sock: socket.socket, pid: int) -> int:
    """Return a descriptor of the peer's process; -1 when there is none to be had."""
    try:
        return int.from_bytes(sock.getsockopt(socket.SOL_SOCKET, _SO_PEERPIDFD, 4), sys.byteorder)
    except OSError:
        pass
    try:
        return os.pidfd_open(pid)
    except OSError:
        return -1
