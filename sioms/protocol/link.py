"""Frames between a client on another machine and a gateway: a head of fixed size, then a body.

    head  kind u64, channel u64, number u64, stamp_ns u64 (little endian)

``channel`` is the number of a handle, 0 the session itself. ``stamp_ns`` is in the gateway's clock: of a frame of the
gateway when it was sent, of a frame of the client that of the newest frame it had got by then; leases run from it
(docs/decisions/0210-one-gateway-on-keys-and-leases.md). The client numbers its frames from 1; a number that the gateway
has had is a duplicate, one that is missing ends the session.

Packets are those of the local protocol (``messages``), whose numbers, verbs and answers are between client and daemon.
"""

from __future__ import annotations

from struct import Struct

from .flags import NodeClass
from .messages import MAX_PACKET
from .page import REASON_SIZE, slot_size

TYPE_CHECKING = False
if TYPE_CHECKING:
    from enum import IntEnum
else:
    from .enumeration import IntEnum

VERSION = 2
HEAD = Struct("<QQQQ")
MAX_TO_GATEWAY = HEAD.size + MAX_PACKET
"""Bytes of a frame that a gateway takes."""
MAX_FROM_GATEWAY = 1 << 20
"""Bytes of a frame that a client takes."""
WINDOW = 4
"""Sets of snapshots of a node that a gateway sends ahead of the confirmations of its client."""
DEFAULT_LEASE_S, SHORTEST_LEASE_S, LONGEST_LEASE_S = 0.2, 0.001, 10.0
"""Of what can be written, when the client asks for none, and the least and the most it gets [s]."""
BEACON_S = 0.02
"""A gateway sends a frame at least so often to a session that holds something [s], so that leases can be renewed."""
PING_S = 0.25
"""A client asks for the time so often [s]."""
GONE_S = 3.0
"""A link on which nothing has come for so long is lost [s]."""
JOURNAL = 1 << 62
"""Channels of journals: this, and the number of the request."""
_PAGE = Struct("<IIIIQQQ")
_UPDATE = Struct("<QIIIHH")
_PING = Struct("<q")
_PONG = Struct("<qqqQQ")


class Up(IntEnum):
    """Kinds of frames of a client. The numbers are wire facts."""

    HELLO = 1
    """Begin a session; ``channel`` is the version of these frames."""
    PACKET = 2
    """A packet for the daemon, or for the driver of a handle."""
    CREDIT = 3
    """Sets of snapshots or events have been taken; the body is how many, one if it is empty."""
    CLOSED = 4
    """The client has closed a handle's connection."""
    PING = 5
    BYE = 6
    """The session ends."""


class Down(IntEnum):
    """Kinds of frames of a gateway. The numbers are wire facts."""

    PACKET = 2
    OPENED = 18
    """The answer to an open that was granted: what the page is, then the packet."""
    UPDATE = 19
    """The state of a page, and snapshots of it, the oldest first."""
    BEACON = 20
    """The time, for leases."""
    PONG = 21
    END = 22
    """The session has ended; ``channel`` is an errno and the body a sentence."""
    FOLLOWED = 23
    """The answer to a journal that was granted, and the events that it keeps; see ``followed``."""
    EVENTS = 24
    """Events of a journal, in order; what is missing in their numbers was overwritten before it could be sent."""
    UNFOLLOWED = 25
    """The right to journals has ended, and with it all that follow them in this session."""


class MalformedFrame(Exception):
    """A frame that is none of these."""


def pack(kind: int, channel: int = 0, number: int = 0, stamp_ns: int = 0, body: bytes = b"") -> bytes:
    """Return a frame."""
    return HEAD.pack(kind, channel, number, stamp_ns) + body


def unpack(frame: bytes, most: int) -> tuple[int, int, int, int, bytes]:
    """Take a frame apart into kind, channel, number, stamp and body.

    Args:
        frame: as it came.
        most: bytes that it may have.

    Raises:
        MalformedFrame: too short or too long.
    """
    if not HEAD.size <= len(frame) <= most:
        raise MalformedFrame(f"a frame of {len(frame)} bytes; want {HEAD.size} to {most}")
    kind, channel, number, stamp_ns = HEAD.unpack_from(frame)
    return kind, channel, number, stamp_ns, frame[HEAD.size :]


class PageShape:
    """What a page is laid out by; see ``page``."""

    __slots__ = ("channels", "device", "generation", "lease_ns", "node_class", "slots")

    def __init__(
        self, node_class: NodeClass, channels: int, slots: int, lease_ns: int, generation: int, device: int
    ) -> None:
        self.node_class, self.channels, self.slots = node_class, channels, slots
        self.lease_ns, self.generation, self.device = lease_ns, generation, device

    @property
    def slot_size(self) -> int:
        """Bytes of a snapshot."""
        return slot_size(self.node_class, self.channels)


def opened(shape: PageShape, packet: bytes) -> bytes:
    """Return the body of OPENED."""
    head = _PAGE.pack(
        shape.node_class, shape.channels, shape.slots, 0, shape.lease_ns, shape.generation, shape.device
    )  # fmt: skip
    return head + packet


def take_opened(body: bytes) -> tuple[PageShape, bytes]:
    """Take the body of OPENED apart; raises MalformedFrame."""
    try:
        cls, channels, slots, _, lease_ns, generation, device = _PAGE.unpack_from(body)
        shape = PageShape(NodeClass(cls), channels, slots, lease_ns, generation, device)
    except (ValueError, ArithmeticError) as error:
        raise MalformedFrame(f"an open: {error}") from None
    except Exception as error:  # struct.error, without its module
        raise MalformedFrame(f"an open of {len(body)} bytes") from error
    if not (0 < channels <= 1 << 16 and 4 <= slots <= 1 << 20 and not slots & (slots - 1)):
        raise MalformedFrame(f"a page of {slots} snapshots of {channels} channels")
    if slots * shape.slot_size > 1 << 30:
        raise MalformedFrame(f"a page of {slots * shape.slot_size} bytes")
    return shape, body[_PAGE.size :]


def followed(packet: bytes, events: bytes) -> bytes:
    """Return the body of FOLLOWED."""
    return len(packet).to_bytes(4, "little") + packet + events


def take_followed(body: bytes) -> tuple[bytes, bytes]:
    """Take the body of FOLLOWED apart into a packet and events; raises MalformedFrame."""
    size = int.from_bytes(body[:4], "little")
    if len(body) < 4 + size:
        raise MalformedFrame(f"a packet of {size} bytes in {len(body)}")
    return body[4 : 4 + size], body[4 + size :]


class Update:
    """The state of a page, and snapshots.

    Attributes:
        alive_ns: when its driver was last seen alive, in the cell's clock.
        driver, daemon: state words, by PageState; reason: why one is not good, as in the page.
        wake: whether the driver has woken the subscriber.
        count, snapshots: how many snapshots, and these as they are in the page, one after the other.
    """

    __slots__ = ("alive_ns", "count", "daemon", "driver", "reason", "snapshots", "wake")

    def __init__(
        self, alive_ns: int, driver: int, daemon: int, reason: bytes, wake: bool, count: int, snapshots: bytes
    ) -> None:
        self.alive_ns, self.driver, self.daemon = alive_ns, driver, daemon
        self.reason, self.wake, self.count, self.snapshots = reason, wake, count, snapshots

    def packed(self) -> bytes:
        """Return the body of UPDATE."""
        head = _UPDATE.pack(self.alive_ns, self.driver, self.daemon, self.wake, len(self.reason), self.count)
        return head + self.reason + self.snapshots

    @classmethod
    def take(cls, body: bytes, size: int) -> Update:
        """Take the body of UPDATE apart; raises MalformedFrame.

        Args:
            body: as it came.
            size: bytes of a snapshot of this page.
        """
        if len(body) < _UPDATE.size:
            raise MalformedFrame(f"snapshots in {len(body)} bytes")
        alive_ns, driver, daemon, wake, length, count = _UPDATE.unpack_from(body)
        start = _UPDATE.size + length
        if length > REASON_SIZE or len(body) != start + count * size:
            raise MalformedFrame(f"{count} snapshots of {size} bytes in {len(body)}")
        return cls(alive_ns, driver, daemon, body[_UPDATE.size : start], bool(wake), count, body[start:])


def take_credit(body: bytes) -> int:
    """Take the body of CREDIT apart; raises MalformedFrame."""
    if len(body) > 1:
        raise MalformedFrame(f"a credit of {len(body)} bytes")
    return body[0] if body else 1


def ping(sent_ns: int) -> bytes:
    """Return the body of PING: when it was sent, in the clock of the client."""
    return _PING.pack(sent_ns)


def take_ping(body: bytes) -> int:
    """Take the body of PING apart; raises MalformedFrame."""
    if len(body) != _PING.size:
        raise MalformedFrame(f"a ping of {len(body)} bytes")
    sent_ns: int = _PING.unpack(body)[0]
    return sent_ns


def pong(sent_ns: int, got_ns: int, utc_ahead_ns: int, error_ns: int, source: int) -> bytes:
    """Return the body of PONG.

    Args:
        sent_ns: that of the ping.
        got_ns: when that came, in the clock of the gateway; the frame's stamp is when this was sent.
        utc_ahead_ns, error_ns, source: of the gateway's wall clock; see ``clock.Wall``.
    """
    return _PONG.pack(sent_ns, got_ns, utc_ahead_ns, error_ns, source)


def take_pong(body: bytes) -> tuple[int, int, int, int, int]:
    """Take the body of PONG apart; raises MalformedFrame."""
    if len(body) != _PONG.size:
        raise MalformedFrame(f"a pong of {len(body)} bytes")
    sent_ns, got_ns, ahead_ns, error_ns, source = _PONG.unpack(body)
    return sent_ns, got_ns, ahead_ns, error_ns, source
