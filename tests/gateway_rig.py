"""A gateway without sockets: what is around it is written down, its clock is set, a client sends frames."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from sioms.gateway.core import (
    OWN_NUMBERS,
    Gateway,
)
from sioms.gateway.parts import Principal, Session
from sioms.protocol import link, verbs
from sioms.protocol.clock import Wall
from sioms.protocol.flags import NodeClass, PageState
from sioms.protocol.journal import HEADER, Event, JournalReader, JournalWriter
from sioms.protocol.link import PageShape, Up
from sioms.protocol.messages import decode, reply
from sioms.protocol.page import PageReader, PageWriter, page_size
from sioms.protocol.records import READ_SIZE

KATE, BEN = Principal("kate", ("ops",)), Principal("ben")
MS = 1_000_000
HEARD, PASSED = verbs.Heard(0).packed()[:2], verbs.Passed(0, b"").packed()[:2]
WRITE = verbs.Write(0, 0.0, b"").packed(3)


class Node:
    """A node whose driver takes everything and publishes when told."""

    def __init__(self) -> None:
        memory = bytearray(page_size(NodeClass.AXIS, 1, 8))
        self.writer = PageWriter(memoryview(memory), NodeClass.AXIS, 1, 8, 10**12, 1, 77)
        self.writer.set_state(PageState.GOOD)
        self.page = PageReader(memory)
        self.shape = PageShape(NodeClass.AXIS, 1, 8, 10**12, 1, 77)
        self.got: list[bytes] = []
        self.state = "open"

    def publish(self, now_ns: int) -> None:
        self.writer.alive(now_ns)
        self.writer.publish(memoryview(bytes(READ_SIZE[NodeClass.AXIS])), now_ns, 1, now_ns)

    def send(self, packet: bytes) -> None:
        self.got.append(packet)

    def end(self) -> None:
        self.state = "ended"

    def close(self) -> None:
        if self.state != "closed":
            self.state = "closed"
            self.page.release()


class Journal:
    """A journal in memory."""

    def __init__(self) -> None:
        memory = bytearray(HEADER + 8192)
        self.writer, self._reader = JournalWriter(memoryview(memory)), JournalReader(memory)
        self.closed = False

    def read(self, most_bytes: int) -> list[Event]:
        assert not self.closed
        return self._reader.read(most_bytes)

    def close(self) -> None:
        self.closed = True


class Line:
    """A connection to a daemon that is written down."""

    def __init__(self) -> None:
        self.got: list[bytes] = []
        self.closed = False

    def send(self, packet: bytes) -> None:
        self.got.append(packet)

    def close(self) -> None:
        self.closed = True


class World:
    """What is around a gateway: a clock that is set, frames that are written down."""

    def __init__(self) -> None:
        self.now_ns = 1_000 * MS
        self.sent: dict[bytes, list[tuple[int, int, int, int, bytes]]] = {}
        self.nodes: dict[int, Node] = {}
        self.lines: list[Line] = []
        self.dropped: list[int] = []
        self.journals: list[Journal] = []
        self.takes = True
        self.numbers: dict[bytes, int] = {}
        self.gateway = Gateway(self, lambda: self.now_ns, lambda: Wall(5, 7, 1))

    def send(self, peer: bytes, frame: bytes) -> bool:
        self.sent.setdefault(peer, []).append(link.unpack(frame, link.MAX_FROM_GATEWAY))
        return self.takes

    def connect(self, session: Session) -> Line:
        self.lines.append(Line())
        return self.lines[-1]

    def attach(self, session: Session, handle: int, fds: Sequence[int]) -> Node:
        self.nodes[handle] = Node()
        return self.nodes[handle]

    def follow(self, session: Session, fds: Sequence[int]) -> Journal:
        return self.journals[-1]

    def drop(self, fds: Sequence[int]) -> None:
        self.dropped += fds

    def log(self, level: str, event: str, **words: object) -> None:
        pass

    # --- a client --------------------------------------------------------------------------------

    def frame(
        self, peer: bytes, kind: int, channel: int = 0, body: bytes = b"", who: Principal | None = KATE, **head: int
    ) -> None:
        self.numbers[peer] = number = head.get("number", self.numbers.get(peer, 0) + 1)
        stamp_ns = head.get("stamp_ns", self.told(peer))
        self.gateway.frame(peer, who, "lab2", link.pack(kind, channel, number, stamp_ns, body))

    def told(self, peer: bytes) -> int:
        return max([stamp_ns for _, _, _, stamp_ns, _ in self.sent.get(peer, ())], default=0)

    def ask(self, peer: bytes, number: int, message: verbs.Message) -> None:
        self.frame(peer, Up.PACKET, 0, message.packed(number))

    def session(self, peer: bytes) -> Session:
        return self.gateway.sessions[peer]

    def begin(self, peer: bytes, who: Principal = KATE) -> Line:
        """Begin a session, and have the daemon take it in."""
        self.frame(peer, Up.HELLO, link.VERSION, who=who)
        self.frame(peer, Up.PACKET, 0, verbs.Hello(2, "test").packed(1), who)
        self.gateway.daemon_packet(self.session(peer), reply(OWN_NUMBERS))
        return self.lines[-1]

    def open(self, peer: bytes, handle: int, lease_s: float = 0.0, *, read_only: bool = False) -> Node:
        line: Any = self.session(peer).line
        self.ask(peer, 100 + handle, verbs.Open("mod0", 3, 0.0, lease_s))
        own = decode(line.got[-1])
        assert verbs.FROM_CLIENT[own[0]] is verbs.Info
        self.gateway.daemon_packet(self.session(peer), reply(own[1], ["mod0", 3, read_only, []]))
        answer = reply(100 + handle, [handle, [], [0], -1, [1, 1]])
        self.gateway.daemon_packet(self.session(peer), answer, [7, 8, 9])
        return self.nodes[handle]

    def last(self, peer: bytes, kind: int) -> tuple[int, bytes]:
        return [(channel, body) for k, channel, _, _, body in self.sent[peer] if k == kind][-1]

    def kinds(self, peer: bytes) -> list[int]:
        return [kind for kind, *_ in self.sent[peer]]


def said(node: Node) -> list[bytes]:
    """Return what a driver has got of its client, without what the gateway says of it."""
    return [
        decode(packet)[3] if packet.startswith(PASSED) else packet
        for packet in node.got
        if not packet.startswith(HEARD)
    ]


def heard(node: Node) -> list[int]:
    """Return when the client said what its driver has got, as the gateway tells."""
    return [decode(packet)[2] for packet in node.got if packet.startswith((HEARD, PASSED))]
