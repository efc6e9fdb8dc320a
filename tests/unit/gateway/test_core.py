"""Sessions of remote clients without a socket: leases, numbers of frames, revocation, hostile frames, slow readers."""

from __future__ import annotations

import errno
import itertools
import random
from collections.abc import Callable, Sequence
from typing import Any

import pytest

from sioms.gateway.core import (
    IDLE_NODES,
    JOURNAL_BYTES,
    JOURNAL_NS,
    MOST_OF_A_KEY,
    MOST_SESSIONS,
    OWN_NUMBERS,
    TOLD,
    Gateway,
)
from sioms.gateway.parts import Principal, Session
from sioms.protocol import link, verbs
from sioms.protocol.clock import Wall
from sioms.protocol.flags import NodeClass, PageState
from sioms.protocol.journal import HEADER, Event, JournalReader, JournalWriter, Note, take_events
from sioms.protocol.link import Down, PageShape, Up, Update
from sioms.protocol.messages import decode, decode_reply, refusal, reply
from sioms.protocol.page import PageReader, PageWriter, page_size
from sioms.protocol.records import READ_SIZE

KATE, BEN = Principal("kate", ("ops",)), Principal("ben")
MS = 1_000_000
HEARD = verbs.Heard(0).packed()[:2]
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
    return [packet for packet in node.got if not packet.startswith(HEARD)]


def heard(node: Node) -> list[int]:
    """Return when the client said what its driver has got, as the gateway tells."""
    return [decode(packet)[2] for packet in node.got if packet.startswith(HEARD)]


@pytest.fixture
def world() -> World:
    return World()


def test_the_daemon_is_told_first_on_whose_behalf(world: World) -> None:
    world.frame(b"a", Up.HELLO, link.VERSION)
    assert not world.lines, "nothing is asked of the daemon before the client asks"
    hello = verbs.Hello(2, "test").packed(1)
    world.frame(b"a", Up.PACKET, 0, hello)
    [line] = world.lines
    assert line.got == [verbs.Represent("kate", "lab2", ["ops"]).packed(OWN_NUMBERS)]
    world.gateway.daemon_packet(world.session(b"a"), reply(OWN_NUMBERS))
    assert line.got[1:] == [hello]
    world.gateway.daemon_packet(world.session(b"a"), reply(1, [2, "cell", 7]), [3, 4])
    assert world.dropped == [3, 4], "what the daemon passes along stays on its machine"
    assert decode_reply(world.last(b"a", Down.PACKET)[1])[1] == 1


def test_who_is_not_taken_in_hears_why_and_may_ask_again(world: World) -> None:
    world.frame(b"a", Up.HELLO, link.VERSION)
    world.ask(b"a", 1, verbs.Hello(2, "test"))
    world.gateway.daemon_packet(world.session(b"a"), refusal(OWN_NUMBERS, errno.EAGAIN, "it is starting"))
    assert decode_reply(world.last(b"a", Down.PACKET)[1])[1:4] == [1, errno.EAGAIN, "it is starting"]
    world.ask(b"a", 2, verbs.Hello(2, "test"))
    assert len(world.lines) == 2 and world.lines[0].closed


def test_a_client_says_nothing_in_the_gateways_name(world: World) -> None:
    line = world.begin(b"a")
    world.ask(b"a", 2, verbs.Represent("root", "here", []))
    assert b"a" not in world.gateway.sessions and line.closed and len(line.got) == 2
    world.begin(b"b")
    world.ask(b"b", OWN_NUMBERS + 5, verbs.List())
    assert b"b" not in world.gateway.sessions


@pytest.mark.parametrize(("asked_s", "gets_s"), [(0.0, link.DEFAULT_LEASE_S), (2.0, 2.0)])
def test_what_can_be_written_has_a_lease_at_gateway_and_driver(world: World, asked_s: float, gets_s: float) -> None:
    line = world.begin(b"a")
    node = world.open(b"a", 5, asked_s)
    assert decode(line.got[-1])[2:] == ["mod0", 3, 0.0, gets_s]
    until_ns = world.now_ns + int(gets_s * 1e9)
    while world.now_ns <= until_ns:
        assert node.state == "open"
        world.now_ns = max(world.now_ns + 1, min(world.gateway.tick(), until_ns + 1))
        world.frame(b"a", Up.PING, 0, link.ping(1))  # the thread of a client that hangs
    world.gateway.tick()
    assert node.state == "ended"
    words = [decode_reply(body) for kind, _, _, _, body in world.sent[b"a"] if kind == Down.PACKET and body]
    assert words[-1][1:3] == [0, errno.ETIMEDOUT] and "lease" in words[-1][3]
    assert world.last(b"a", Down.PACKET) == (5, b""), "and its end of file"


def test_a_lease_of_a_reader_is_none_and_one_that_is_too_long_is_refused(world: World) -> None:
    line = world.begin(b"a")
    node = world.open(b"a", 5, 0.5, read_only=True)
    assert decode(line.got[-1])[2:] == ["mod0", 3, 0.0, 0.0]
    for _ in range(20):
        world.now_ns += 100 * MS
        world.frame(b"a", Up.PING, 0, link.ping(1))
        world.gateway.tick()
    assert node.state == "open"
    world.ask(b"a", 9, verbs.Open("mod0", 3, 0.0, 60.0))
    assert decode_reply(world.last(b"a", Down.PACKET)[1])[1:3] == [9, errno.EINVAL]


def test_an_open_that_is_cancelled_before_it_reached_the_daemon_opens_nothing(world: World) -> None:
    line = world.begin(b"a")
    world.ask(b"a", 9, verbs.Open("mod0", 3, 0.0, 0.0))
    info = line.got[-1]
    world.ask(b"a", 10, verbs.Cancel(9))
    answers = [decode_reply(body)[1:3] for kind, _, _, _, body in world.sent[b"a"] if kind == Down.PACKET]
    assert answers[-2:] == [[9, errno.ECANCELED], [10, 0]]
    world.gateway.daemon_packet(world.session(b"a"), reply(decode(info)[1], ["mod0", 3, False, []]))
    assert line.got[-1] == info, "the open does not follow its cancellation"
    world.ask(b"a", 11, verbs.Cancel(8))
    assert line.got[-1] == verbs.Cancel(8).packed(11), "what the daemon has is the daemon's to cancel"


def test_a_lease_runs_from_what_the_client_had_been_told_so_a_late_burst_renews_nothing(world: World) -> None:
    world.begin(b"a")
    node = world.open(b"a", 5)
    told_ns = world.told(b"a")
    for _ in range(15):  # the link holds back what the client sends: the gateway goes on telling the time
        world.now_ns += 10 * MS
        world.gateway.tick()
    world.frame(b"a", Up.PACKET, 5, b"write 1", stamp_ns=told_ns)
    assert said(node) == [b"write 1"]
    world.now_ns = told_ns + int(link.DEFAULT_LEASE_S * 1e9) + 1
    world.frame(b"a", Up.PACKET, 5, b"write 2", stamp_ns=told_ns)
    assert said(node) == [b"write 1"] and node.state == "ended", "not a nanosecond longer, and no late write"
    world.frame(b"a", Up.PACKET, 5, b"write 3")
    assert said(node) == [b"write 1"], "nothing resumes"


def test_the_driver_is_told_how_old_its_clients_word_is_so_that_a_gateway_that_falls_asleep_extends_nothing(
    world: World,
) -> None:
    world.begin(b"a")
    node = world.open(b"a", 5)
    told_ns = world.told(b"a")
    world.now_ns += 190 * MS
    world.frame(b"a", Up.PACKET, 5, WRITE, stamp_ns=told_ns)
    assert node.got == [verbs.Heard(told_ns).packed(), WRITE], "the lease of the driver began 190 ms ago"
    for _ in range(100):
        world.now_ns += MS
        world.gateway.tick()
        for packet in (WRITE, verbs.Keepalive().packed()):
            world.frame(b"a", Up.PACKET, 5, packet)
    since = [told_ns, *heard(node)[1:]]
    step_ns = int(link.DEFAULT_LEASE_S * 1e9) // TOLD
    assert all(step_ns < after - before <= 30 * MS for before, after in itertools.pairwise(since[1:]))
    assert world.now_ns - since[-1] < 30 * MS and len(since) < 40, "often enough, and not with each packet"
    assert set(said(node)) == {WRITE}, "nothing that renews from now on"


@pytest.mark.parametrize(
    "packed", [b"\x93\x07\x00", b"\x93\xcc\x07\x00", b"\xdc\x00\x03\x07\x00", b"\xdd\x00\x00\x00\x03\xcd\x00\x07\x00"]
)
def test_a_client_does_not_say_how_old_its_own_word_is(world: World, packed: bytes) -> None:
    """The driver would take that of a client whose word lay in a slow link for new."""
    world.begin(b"a")
    node = world.open(b"a", 5)
    world.frame(b"a", Up.PACKET, 5, packed + b"\xcf" + (world.now_ns + MS).to_bytes(8, "big"))
    assert b"a" not in world.gateway.sessions and not said(node)


def test_what_comes_late_renews_a_lease_from_when_its_client_was_told_the_time(world: World) -> None:
    world.begin(b"a")
    node = world.open(b"a", 5)
    lease_ns, told_ns = int(link.DEFAULT_LEASE_S * 1e9), world.told(b"a")
    world.now_ns = told_ns + lease_ns - 1  # within the lease, and all but late
    world.frame(b"a", Up.PACKET, 5, b"write 1", stamp_ns=told_ns)
    world.gateway.tick()
    assert node.state == "open"
    world.now_ns = told_ns + lease_ns + 1
    world.gateway.tick()
    assert said(node) == [b"write 1"] and node.state == "ended"


@pytest.mark.parametrize("late_s", [0.0, 0.4, 0.999, 1.0, 7.0])
def test_a_word_of_a_supervisor_holds_from_when_its_client_was_told_the_time(world: World, late_s: float) -> None:
    line = world.begin(b"a")
    told_ns, count = world.told(b"a"), len(line.got)
    world.now_ns = told_ns + int(late_s * 1e9)
    world.frame(b"a", Up.PACKET, 0, verbs.Supervise(1.0).packed(9), stamp_ns=told_ns)
    if late_s < 1.0:
        (packet,) = line.got[count:]
        _, message = verbs.take(packet, verbs.FROM_CLIENT)
        assert isinstance(message, verbs.Supervise) and message.lease_s == pytest.approx(1.0 - late_s)
    else:
        assert line.got[count:] == [] and "late" in decode_reply(world.last(b"a", Down.PACKET)[1])[3]


def test_a_session_that_owns_something_is_told_the_time_often_enough_to_renew(world: World) -> None:
    world.begin(b"a")
    world.open(b"a", 5)
    began_ns, count = world.now_ns, len(world.sent[b"a"])
    while world.now_ns < began_ns + 100 * MS:
        world.frame(b"a", Up.PACKET, 5, b"alive")
        world.now_ns = max(world.now_ns + 1, world.gateway.tick())
    assert len(world.sent[b"a"]) - count >= 4


def test_a_frame_is_taken_once_and_in_order(world: World) -> None:
    world.begin(b"a")
    node = world.open(b"a", 5)
    world.frame(b"a", Up.PACKET, 5, b"one")
    number = world.numbers[b"a"]
    for _ in range(3):
        world.frame(b"a", Up.PACKET, 5, b"one", number=number)
    world.frame(b"a", Up.PACKET, 5, b"before", number=2)
    world.numbers[b"a"] = number
    world.frame(b"a", Up.PACKET, 5, b"two")
    assert said(node) == [b"one", b"two"]
    world.frame(b"a", Up.PACKET, 5, b"four", number=number + 3)
    assert b"a" not in world.gateway.sessions and node.state == "closed", "what is missing may have been a stop"
    assert said(node) == [b"one", b"two"]


def test_frames_of_before_a_cut_begin_nothing(world: World) -> None:
    world.begin(b"a")
    node = world.open(b"a", 5)
    world.gateway.end(world.session(b"a"), errno.EIO, "cut")
    for kind in Up.__members__.values():
        world.frame(b"a", kind, 5, b"late")
        world.frame(b"new connection", kind, 5, b"late", number=77)
    assert not world.gateway.sessions and not node.got


def test_a_time_that_was_not_told_is_no_time(world: World) -> None:
    world.begin(b"a")
    node = world.open(b"a", 5)
    world.frame(b"a", Up.PACKET, 5, b"write", stamp_ns=world.now_ns + 10_000 * MS)
    assert b"a" not in world.gateway.sessions and not node.got


@pytest.mark.parametrize("keys", [[], [BEN], [Principal("kate")], [Principal("kate", ("ops",), "another key")]])
def test_a_revoked_key_loses_what_it_has_at_once(world: World, keys: list[Principal]) -> None:
    line = world.begin(b"a")
    node = world.open(b"a", 5)
    world.gateway.allow([KATE, BEN])
    assert node.state == "open"
    world.gateway.allow(keys)
    assert node.state == "closed" and line.closed and not world.gateway.sessions
    channel, body = world.last(b"a", Down.END)
    assert channel == errno.EACCES and b"revoked" in body


def test_a_message_of_a_key_that_is_not_allowed_is_not_looked_at(world: World) -> None:
    world.begin(b"a")
    node = world.open(b"a", 5)
    world.frame(b"a", Up.PACKET, 5, b"write", who=None)
    assert node.state == "closed" and not node.got
    world.frame(b"b", Up.HELLO, link.VERSION, who=None)
    assert not world.gateway.sessions and b"b" not in world.sent


def test_another_version_is_told_and_sessions_are_bounded(world: World) -> None:
    world.frame(b"a", Up.HELLO, link.VERSION + 1)
    assert b"same release" in world.last(b"a", Down.END)[1] and not world.gateway.sessions
    for i in range(MOST_SESSIONS + 3):
        world.frame(b"%d" % i, Up.HELLO, link.VERSION, who=Principal(f"key{i % 7}"))
    assert len(world.gateway.sessions) == MOST_SESSIONS


def test_one_key_does_not_keep_others_out(world: World) -> None:
    for i in range(MOST_SESSIONS):
        world.frame(b"%d" % i, Up.HELLO, link.VERSION)
    assert len(world.gateway.sessions) == MOST_OF_A_KEY
    assert b"key kate has 48 sessions open" in world.last(b"200", Down.END)[1]
    world.begin(b"b", BEN)


@pytest.mark.parametrize("lease_s", [1e-12, 1e-4, -1.0, float("-inf"), float("inf")])
def test_no_lease_is_so_short_that_it_is_none(world: World, lease_s: float) -> None:
    line = world.begin(b"a")
    sent = len(line.got)
    world.ask(b"a", 9, verbs.Open("mod0", 3, 0.0, lease_s))
    assert len(line.got) == sent
    assert decode_reply(world.last(b"a", Down.PACKET)[1])[2] == errno.EINVAL


def test_a_mistake_of_ours_costs_one_session(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(_: bytes) -> int:
        raise RuntimeError("a mistake")

    world.begin(b"a")
    world.begin(b"b", BEN)
    monkeypatch.setattr(link, "take_ping", broken)
    world.frame(b"a", Up.PING, 0, link.ping(1))
    assert list(world.gateway.sessions) == [b"b"] and b"a mistake" in world.last(b"a", Down.END)[1]


def test_one_session_has_no_hold_on_what_is_anothers(world: World) -> None:
    world.begin(b"a")
    node = world.open(b"a", 5)
    world.begin(b"b", BEN)
    for kind in (Up.PACKET, Up.CLOSED, Up.CREDIT):
        world.frame(b"b", kind, 5, b"stolen", BEN)
    assert node.state == "open" and not node.got


@pytest.mark.parametrize("end", ["bye", "silence", "daemon", "no answer"])
def test_the_end_of_a_session_halts_what_it_held(world: World, end: str) -> None:
    line = world.begin(b"a")
    node = world.open(b"a", 5, 10.0)
    if end == "bye":
        world.frame(b"a", Up.BYE)
    elif end == "silence":
        world.now_ns += int(link.GONE_S * 1e9) + 1
        world.gateway.tick()
    elif end == "daemon":
        world.gateway.daemon_packet(world.session(b"a"), b"")
    else:
        world.takes = False  # ZeroMQ knows of no such peer any more
        world.now_ns += 100 * MS
        world.gateway.tick()
    assert node.state == "closed" and line.closed and not world.gateway.sessions


def test_a_client_that_vanishes_with_many_nodes_open_disturbs_nobody(world: World) -> None:
    world.begin(b"a")
    nodes = [world.open(b"a", handle, 10.0, read_only=handle > 6) for handle in range(5, 9)]
    world.now_ns += 100 * MS
    for node in nodes:
        node.publish(world.now_ns)
    world.takes = False
    world.gateway.tick()
    assert {node.state for node in nodes} == {"closed"} and not world.gateway.sessions


def test_a_reader_that_confirms_gets_every_snapshot_and_one_that_does_not_gets_four_frames(world: World) -> None:
    world.begin(b"a")
    node = world.open(b"a", 5, read_only=True)
    world.begin(b"dead", BEN)
    idle = world.open(b"dead", 6, read_only=True)
    numbers: list[int] = []
    for _ in range(500):
        world.now_ns += MS
        for each in (node, idle):
            each.publish(world.now_ns)
        world.gateway.tick()
        for kind, _, _, _, body in world.sent[b"a"]:
            if kind == Down.UPDATE:
                raws = Update.take(body, node.shape.slot_size).snapshots
                numbers += [int.from_bytes(raw[:8], "little") for raw in raws]
                world.frame(b"a", Up.CREDIT, 5)
        world.sent[b"a"].clear()
        world.numbers.setdefault(b"dead", 0)
        world.frame(b"dead", Up.PING, 0, link.ping(1), BEN, stamp_ns=0)
    assert numbers == list(range(1, numbers[-1] + 1)) and numbers[-1] >= 490
    assert world.kinds(b"dead").count(Down.UPDATE) == link.WINDOW


def test_many_nodes_that_nobody_waits_for_take_no_more_than_a_few(world: World) -> None:
    def frames(sessions: int) -> float:
        first = len(world.gateway.sessions)
        for i in range(first, sessions):
            world.begin(b"%d" % i, Principal(f"key{i}"))
            world.open(b"%d" % i, i, read_only=True)
        count, began_ns = 0, world.now_ns
        while world.now_ns < began_ns + 500 * MS:
            world.now_ns += MS
            for node in world.nodes.values():
                node.publish(world.now_ns)
            world.gateway.tick()
            for i in range(sessions):
                for _ in range(world.kinds(b"%d" % i).count(Down.UPDATE)):
                    world.frame(b"%d" % i, Up.CREDIT, i, who=Principal(f"key{i}"), stamp_ns=0)
                    count += 1
                world.sent[b"%d" % i].clear()
        return count / 0.5

    few, many = frames(IDLE_NODES), frames(6 * IDLE_NODES)
    assert few == pytest.approx(IDLE_NODES * 200, rel=0.2) and many < 1.3 * few


def test_of_large_snapshots_as_many_go_at_once_as_the_client_confirms(
    world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    world.begin(b"a")
    node = world.open(b"a", 5, read_only=True)
    since = len(world.sent[b"a"])
    monkeypatch.setattr("sioms.gateway.core.BATCH_BYTES", 2 * node.shape.slot_size)
    for _ in range(5):
        node.publish(world.now_ns)
    world.gateway.woken(world.session(b"a"), 5)
    bodies = [body for kind, *_, body in world.sent[b"a"][since:] if kind == Down.UPDATE]
    assert len(bodies) == 3
    updates = [Update.take(body, node.shape.slot_size) for body in bodies]
    assert [len(update.snapshots) for update in updates] == [2, 2, 1]
    assert [update.wake for update in updates] == [False, False, True], "who is woken finds them all"


def test_who_waits_for_news_or_has_been_answered_gets_them_at_once(world: World) -> None:
    world.begin(b"a")
    node = world.open(b"a", 5)

    def credit() -> None:
        world.frame(b"a", Up.CREDIT, 5)

    credit()
    node.publish(world.now_ns)
    before = len(world.sent[b"a"])
    world.gateway.tick()
    assert Down.UPDATE not in world.kinds(b"a")[before:], "nobody waits: with the next batch"
    world.gateway.woken(world.session(b"a"), 5)
    assert Down.UPDATE in world.kinds(b"a")[before:]
    assert Update.take(world.last(b"a", Down.UPDATE)[1], node.shape.slot_size).wake
    world.gateway.driver_packet(world.session(b"a"), 5, b"an answer")
    world.now_ns += MS
    node.publish(world.now_ns)
    before = len(world.sent[b"a"])
    world.gateway.tick()
    assert Down.UPDATE in world.kinds(b"a")[before:]


def test_the_end_of_a_driver_is_an_end_of_file_and_its_page_tells_why(world: World) -> None:
    world.begin(b"a")
    node = world.open(b"a", 5)
    world.gateway.driver_gone(world.session(b"a"), 5)
    assert world.last(b"a", Down.PACKET) == (5, b"") and node.state == "ended"
    node.writer.set_state(PageState.FAULT, "it burns")
    world.now_ns += 6 * MS
    world.gateway.tick()
    update = Update.take(world.last(b"a", Down.UPDATE)[1], node.shape.slot_size)
    assert update.driver == PageState.FAULT and update.reason == b"it burns"


def test_hostile_frames_end_their_own_session_and_open_nothing(world: World) -> None:
    rng = random.Random(7)
    makers: list[Callable[[], bytes]] = [
        lambda: rng.randbytes(rng.randrange(80)),
        lambda: link.pack(rng.randrange(40), rng.choice((0, 5, 99)), rng.randrange(9), 0, rng.randbytes(9)),
        lambda: link.pack(Up.PACKET, 0, world.numbers[b"x"] + 1, 0, rng.randbytes(rng.randrange(60))),
        lambda: link.pack(1 << 63, 1 << 63, world.numbers[b"x"] + 1, 0),
        lambda: bytes(link.MAX_TO_GATEWAY + 1),
    ]
    world.begin(b"a")
    node = world.open(b"a", 5, 10.0)
    for _ in range(3_000):
        if b"x" not in world.gateway.sessions:
            world.numbers[b"x"] = 0
            world.begin(b"x", BEN)
            world.sent[b"x"].clear()
        world.gateway.frame(b"x", BEN, "lab3", rng.choice(makers)())
        session = world.gateway.sessions.get(b"x")
        world.numbers[b"x"] = session.heard if session else 0
        assert not session or not session.held
    assert node.state == "open" and not node.got


def follow(world: World, peer: bytes, number: int = 7) -> Journal:
    """Have the daemon grant a journal, which keeps three events."""
    journal = Journal()
    world.journals.append(journal)
    for _ in range(3):
        journal.writer.note(Note.CLOSED, world.now_ns, "mod0", "eva")
    world.ask(peer, number, verbs.Journal("mod0"))
    world.gateway.daemon_packet(world.session(peer), reply(number, 1), (11, 12))
    return journal


def events(world: World, peer: bytes, since: int) -> list[int]:
    """Return the numbers of the events that a client was sent."""
    frames = [body for kind, *_, body in world.sent[peer][since:] if kind == Down.EVENTS]
    return [event.number for body in frames for event in take_events(body)]


def test_a_journal_is_asked_of_the_daemon_and_sent_with_what_it_keeps(world: World) -> None:
    line = world.begin(b"a")
    journal = follow(world, b"a")
    assert line.got[-1] == verbs.Journal("mod0").packed(7), "the daemon judges the key's right"
    (kind, channel, _, _, body) = world.sent[b"a"][-1]
    packet, kept = link.take_followed(body)
    assert (kind, channel, packet) == (Down.FOLLOWED, link.JOURNAL | 7, reply(7, 1))
    assert [event.number for event in take_events(kept)] == [1, 2, 3] and world.dropped == []
    since = len(world.sent[b"a"])
    journal.writer.note(Note.STOP, world.now_ns, "EMERGENCY", "a test", [])
    world.gateway.tick()
    assert events(world, b"a", since) == [4]
    world.frame(b"a", Up.BYE)
    assert journal.closed


def test_a_refused_journal_is_an_answer(world: World) -> None:
    world.begin(b"a")
    world.ask(b"a", 7, verbs.Journal("mod0"))
    world.gateway.daemon_packet(world.session(b"a"), refusal(7, errno.EPERM, "no right"))
    assert decode_reply(world.sent[b"a"][-1][4])[2] == errno.EPERM and not world.session(b"a").followed


def test_who_does_not_confirm_events_gets_four_frames_and_hears_of_what_was_overwritten(world: World) -> None:
    world.begin(b"a")
    world.begin(b"b")
    journal = follow(world, b"a")
    since = len(world.sent[b"a"])
    for _ in range(300):
        world.now_ns += JOURNAL_NS
        journal.writer.note(Note.CLOSED, world.now_ns, "n" * 100, "eva")
        world.frame(b"a", Up.PING, body=link.ping(1))
        world.gateway.tick()
    assert events(world, b"a", since) == [4, 5, 6, 7], "of who does not confirm nothing more is read"
    for _ in range(4):
        world.frame(b"a", Up.CREDIT, link.JOURNAL | 7)
    world.now_ns += JOURNAL_NS
    world.gateway.tick()
    got = events(world, b"a", since)
    assert got[4] > 8 and got[4:] == list(range(got[4], 304)), "the newest, whose numbers tell what is missing"
    copy = bytearray(HEADER + (1 << 16))
    writer, reader = JournalWriter(memoryview(copy)), JournalReader(copy)
    for number in [1, 2, 3, *got]:
        writer.put(Event(Note.CLOSED, number, 7, b"\x90"))
    reader.read()
    assert reader.lost == got[4] - 8
    assert events(world, b"b", 0) == []


def test_events_come_in_frames_of_bounded_size(world: World) -> None:
    world.begin(b"a")
    journal = follow(world, b"a")
    memory = bytearray(HEADER + (1 << 19))
    journal.writer, journal._reader = JournalWriter(memoryview(memory)), JournalReader(memory)
    since = len(world.sent[b"a"])
    for _ in range(40):
        journal.writer.note(Note.COMMAND, 7, "mod0", "eva", bytes(10_000), 0, "")
    for _ in range(12):
        world.now_ns += JOURNAL_NS
        world.gateway.tick()
        world.frame(b"a", Up.CREDIT, link.JOURNAL | 7)
    sizes = [len(body) for kind, *_, body in world.sent[b"a"][since:] if kind == Down.EVENTS]
    assert max(sizes) < JOURNAL_BYTES + 11_000 and events(world, b"a", since) == list(range(1, 41))


def test_a_right_that_ends_ends_the_following_at_once(world: World) -> None:
    world.begin(b"a")
    journal = follow(world, b"a")
    since = len(world.sent[b"a"])
    journal.writer.note(Note.CLOSED, 7, "mod0", "eva")
    world.gateway.unfollow(world.session(b"a"))
    world.gateway.tick()
    kinds = [kind for kind, *_ in world.sent[b"a"][since:]]
    assert journal.closed and Down.UNFOLLOWED in kinds and Down.EVENTS not in kinds
    assert b"a" in world.gateway.sessions, "the session goes on"


def test_a_journal_that_is_asked_for_again_replaces_the_first(world: World) -> None:
    world.begin(b"a")
    first, second = follow(world, b"a", 7), follow(world, b"a", 8)
    assert first.closed and not second.closed and len(world.session(b"a").followed) == 1
