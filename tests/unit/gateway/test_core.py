"""Sessions of remote clients without a socket: leases, numbers of frames, revocation, hostile frames."""

from __future__ import annotations

import errno
import itertools
import random
from collections.abc import Callable

import pytest
from gateway_rig import BEN, KATE, MS, WRITE, World, heard, said

from sioms.gateway.core import (
    MOST_OF_A_KEY,
    MOST_SESSIONS,
    OWN_NUMBERS,
    READ,
    TOLD,
)
from sioms.gateway.parts import Principal
from sioms.protocol import link, verbs
from sioms.protocol.flags import Request
from sioms.protocol.link import Down, Up
from sioms.protocol.messages import MAX_INLINE, decode, decode_reply, refusal, reply


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


def test_what_the_daemon_alone_reads_is_passed_on_as_it_is(world: World) -> None:
    line = world.begin(b"a")
    info = verbs.Info("mod0").packed(2**32 - 1)
    passed = [verbs.List().packed(2), info, info[:-1], info + b"more"]  # what is damaged is the daemon's to judge
    for packet in passed:
        world.frame(b"a", Up.PACKET, 0, packet)
    assert line.got[-len(passed) :] == passed


def test_whose_stop_a_request_past_the_daemon_is_no_client_says(world: World) -> None:
    """All that pass through a gateway share its process, by which the daemon knows whose a request is."""
    line = world.begin(b"a")
    world.frame(b"a", Up.PACKET, 0, verbs.EmergencyStop("", "enough", True, 1234).packed(3))
    assert verbs.take(line.got[-1], verbs.FROM_CLIENT) == (3, verbs.EmergencyStop("", "enough", True, 0))


@pytest.mark.parametrize("how", ["as clients do", "longer"])
def test_what_the_gateway_reads_it_reads_however_it_is_packed(world: World, how: str) -> None:
    def packed(packet: bytes) -> bytes:
        return packet if how == "as clients do" else b"\xdc\x00" + bytes((packet[0] & 15, 0xCC)) + packet[1:]

    line = world.begin(b"a")
    told_ns, got = world.told(b"a"), len(line.got)
    world.now_ns += 500 * MS
    world.frame(b"a", Up.PACKET, 0, packed(verbs.Supervise(2.0).packed(3)), stamp_ns=told_ns)
    assert [tuple(verbs.take(each, verbs.FROM_CLIENT)[1]) for each in line.got[got:]] == [(1.5,)]
    samples = {
        verbs.Represent: ("root", "here", []), verbs.Supervise: (1.0,), verbs.Journal: ("mod0",), verbs.Cancel: (7,),
        verbs.Open: ("mod0", 3, 0.0, 0.0), verbs.List: (), verbs.Said: (7,), verbs.Reset: ("mod0",),
        verbs.EmergencyStop: ("", "enough", False, 7),
    }  # fmt: skip
    assert samples.keys() == {*READ, verbs.List}
    for name, fields in samples.items():  # none of them with a number that is the gateway's
        line = world.begin(name.__name__.encode())
        world.frame(name.__name__.encode(), Up.PACKET, 0, packed(name(*fields).packed(OWN_NUMBERS + 1)))
        assert name.__name__.encode() not in world.gateway.sessions and len(line.got) == 2


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
    assert node.got == [verbs.Passed(told_ns, WRITE).packed()], "the lease of the driver began 190 ms ago"
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


def test_how_old_the_resets_of_a_client_are_is_told_to_driver_and_daemon(world: World) -> None:
    """On a reader's handle, too, which has no lease, and by who has not been told any time yet."""
    line = world.begin(b"a")
    node, told_ns = world.open(b"a", 5, read_only=True), world.told(b"a")
    reset = verbs.Ioctl(Request.RESET, None, None).packed(7)
    world.now_ns += 190 * MS
    world.frame(b"a", Up.PACKET, 5, reset, stamp_ns=told_ns)
    assert node.got == [verbs.Passed(told_ns, reset).packed()]
    long = verbs.Part(8, bytes(MAX_INLINE)).packed()
    told_ns = world.told(b"a")
    world.frame(b"a", Up.PACKET, 5, long, stamp_ns=told_ns + 1)
    assert node.got[1:] == [verbs.Heard(told_ns + 1).packed(), long], "a packet has its bounds"
    for stamp_ns, said_ns in ((told_ns, told_ns), (0, 1)):
        count = len(line.got)
        world.frame(b"a", Up.PACKET, 0, verbs.Reset("mod0").packed(9), stamp_ns=stamp_ns)
        assert line.got[count:] == [verbs.Said(said_ns).packed(), verbs.Reset("mod0").packed(9)]


@pytest.mark.parametrize(
    "packed",
    [b"\x93\x07\x00", b"\x93\xcc\x07\x00", b"\xdc\x00\x03\x07\x00", b"\xdd\x00\x00\x00\x03\xcd\x00\x07\x00",
     b"\x94\x08\x00", b"\x94\xcc\x08\x00"],
)  # fmt: skip
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
