"""Snapshots for remote readers: who keeps up gets each, who does not a few, and who waits hears at once."""

from __future__ import annotations

import itertools

import pytest
from gateway_rig import BEN, MS, World

from sioms.gateway.core import (
    IDLE_NODES,
)
from sioms.gateway.parts import Principal
from sioms.protocol import link
from sioms.protocol.flags import PageState
from sioms.protocol.link import Down, Up, Update
from sioms.protocol.messages import reply


@pytest.fixture
def world() -> World:
    return World()


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
                numbers += memoryview(Update.take(body, size := node.shape.slot_size).snapshots).cast("Q")[:: size // 8]
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


def test_who_asks_in_a_row_is_sent_few_readings_and_the_last_at_once(world: World) -> None:
    """Each costs an answer some of its time, and who asks again at once has not read."""
    world.begin(b"a")
    node, handle = world.open(b"a", 5), 5
    sent: list[int] = []
    for step in range(400):  # 0.1 ms each; the last 10 ms ask nothing
        world.now_ns += MS // 10
        if step % 10 == 0:
            node.publish(world.now_ns)
        if step % 3 == 0 and step < 300:
            last_ns = world.now_ns
            world.gateway.driver_packet(world.session(b"a"), handle, reply(step + 1, None, world.now_ns))
        if world.gateway.due_ns <= world.now_ns:
            world.gateway.tick()
        for _ in range(world.kinds(b"a").count(Down.UPDATE)):
            sent.append(world.now_ns)
            world.frame(b"a", Up.CREDIT, handle)
        world.sent[b"a"].clear()
    in_a_row = [at_ns for at_ns in sent if at_ns <= last_ns]
    assert all(1.9 * MS <= after - before <= 4 * MS for before, after in itertools.pairwise(in_a_row))
    assert len(in_a_row) > 8 and min(at_ns for at_ns in sent if at_ns > last_ns) - last_ns < 1.6 * MS


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
    assert [update.count for update in updates] == [2, 2, 1]
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
    effect_ns = world.now_ns + MS
    world.gateway.driver_packet(world.session(b"a"), 5, reply(3, 0, effect_ns))
    for shown in (True, True, False, False):  # until the instant of the effect is shown; then with the next batch
        before = len(world.sent[b"a"])
        world.now_ns += MS // 2 + 1
        node.publish(world.now_ns)
        world.gateway.tick()
        assert (Down.UPDATE in world.kinds(b"a")[before:]) is shown
    for answer in (reply(4, 0), b"no answer"):
        before = len(world.sent[b"a"])
        world.gateway.driver_packet(world.session(b"a"), 5, answer)
        node.publish(world.now_ns)
        world.gateway.tick()
        assert Down.UPDATE not in world.kinds(b"a")[before:], "a query changes no reading"


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
