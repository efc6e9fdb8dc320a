"""What sessions of remote clients are made of, and what is around them. Pure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol

from sioms.protocol import verbs
from sioms.protocol.journal import Event
from sioms.protocol.link import PageShape


@dataclass(frozen=True, slots=True)
class Principal:
    """Who holds a key.

    Attributes:
        name: of the key.
        groups: of the key.
        public: the key itself.
    """

    name: str
    groups: tuple[str, ...] = ()
    public: str = ""


class Page(Protocol):
    """What is read of a page; see ``protocol.page.PageReader``."""

    @property
    def head(self) -> int:
        """Number of the newest snapshot."""

    def between(self, first: int, last: int) -> bytes:
        """Copy the snapshots of these numbers that are there."""

    def condition(self) -> tuple[int, int, int, bytes]:
        """Return what readers judge the page by."""


class Node(Protocol):
    """A node that has been opened at the daemon."""

    shape: PageShape

    @property
    def page(self) -> Page:
        """What is read of it."""

    def send(self, packet: bytes) -> None:
        """Send a packet to the driver; raises OSError."""

    def end(self) -> None:
        """Close the connection to the driver: what was owned is halted. The page stays."""

    def close(self) -> None:
        """Let go of everything."""


class Journal(Protocol):
    """A journal that the daemon has opened for a session."""

    def read(self, most_bytes: int) -> list[Event]:
        """Return events since the last look, oldest first."""

    def close(self) -> None:
        """Let go of it."""


class Line(Protocol):
    """A connection to the daemon."""

    def send(self, packet: bytes) -> None:
        """Send a packet; raises OSError."""

    def close(self) -> None:
        """Close it: what its session has open is closed."""


class Outside(Protocol):
    """Sockets, around the core."""

    def send(self, peer: bytes, frame: bytes) -> bool:
        """Send a frame to a client; False when it has gone, or takes no more."""

    def connect(self, session: Session) -> Line:
        """Connect to the daemon; raises OSError."""

    def attach(self, session: Session, handle: int, fds: Sequence[int]) -> Node:
        """Take the descriptors of an open."""

    def follow(self, session: Session, fds: Sequence[int]) -> Journal:
        """Take the descriptors of a journal; raises OSError."""

    def drop(self, fds: Sequence[int]) -> None:
        """Close descriptors that nobody wants."""

    def log(self, level: str, event: str, **words: object) -> None:
        """Write a line."""


@dataclass(slots=True, eq=False)
class Held:
    """A node that a remote client has open.

    Attributes:
        handle: number of the handle.
        name: of the node.
        node: at the daemon.
        lease_ns: longest age of the client's word, 0 = any: it owns nothing.
        until_ns: when the lease runs out.
        told_ns: what the driver has been told of when the client last said something.
        cursor: number of the newest snapshot that has been sent.
        ahead: frames of snapshots that are not confirmed.
        owed_ns: the instant that the client's readings have to show, by what was acknowledged; 0: none.
        sent_ns: when the last one was sent.
        woken: whether the driver has woken us for it since.
        ended: whether its connection has ended.
    """

    handle: int
    name: str
    node: Node
    lease_ns: int
    until_ns: int
    told_ns: int = 0
    cursor: int = 0
    ahead: int = 0
    owed_ns: int = 0
    sent_ns: int = 0
    state: tuple[int, int] = (-1, -1)
    woken: bool = False
    ended: bool = False


@dataclass(slots=True, eq=False)
class Followed:
    """A journal that a remote client has a copy of.

    Attributes:
        channel: of its frames.
        journal: at the daemon.
        ahead: frames of events that are not confirmed: of who does not confirm nothing more is read.
    """

    channel: int
    journal: Journal
    ahead: int = 0


@dataclass(slots=True, eq=False)
class Session:
    """A connected client.

    Attributes:
        peer: address of it for the transport.
        who: whose key it has; host: where it is.
        heard: number of its last frame.
        heard_ns: when that came; sent_ns: when something was last sent to it.
        due_ns: when it is to be attended to at the latest.
        urgent_ns: until when snapshots that are owed are sent as they come.
        line: to the daemon; None before the first packet.
        taken_in: whether the daemon has taken it for the key's.
        waiting: packets from before that, and the times that they repeat [ns].
        opens: what waits for an answer: leases by message number of the open.
        asked: opens that wait for what their node is, by number of the gateway's own request.
        held: open nodes by handle.
        asks: devices whose journals are asked for, by message number.
        followed: journals by device, '' = of the daemon.
    """

    peer: bytes
    who: Principal
    host: str
    heard_ns: int
    heard: int = 1
    sent_ns: int = 0
    due_ns: int = 0
    urgent_ns: int = 0
    line: Line | None = None
    taken_in: bool = False
    waiting: list[tuple[bytes, int]] = field(default_factory=list)
    opens: dict[int, tuple[str, float]] = field(default_factory=dict)
    asked: dict[int, tuple[int, verbs.Open]] = field(default_factory=dict)
    held: dict[int, Held] = field(default_factory=dict)
    asks: dict[int, str] = field(default_factory=dict)
    followed: dict[str, Followed] = field(default_factory=dict)

    def __str__(self) -> str:
        return f"{self.who.name}@{self.host}"
