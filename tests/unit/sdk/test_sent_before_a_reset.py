"""What was sent before the reset of what it is for is not carried out after it; everything else is."""

from __future__ import annotations

import errno
import random
from collections.abc import Iterator

import pytest
from own_writes_devices import Device, OnLine
from own_writes_rig import CLOCK, SENT, Client, World
from sender_rig import AXIS, LATER_NS, Sender, fault, jog, order, stop_and_reset, world

from sioms.drivers.sim.axes import SimAxes
from sioms.drivers.sim.io import SimIo
from sioms.protocol.driver_verbs import DriverVerb
from sioms.protocol.flags import Request
from sioms.protocol.messages import MalformedMessage
from sioms.protocol.verbs import Heard, Part, Passed, Write


@pytest.fixture
def axes() -> Iterator[World]:
    yield from world(SimAxes, {"axis": [{"name": "x", **AXIS}, {"name": "y", **AXIS}]})


@pytest.fixture
def port() -> Iterator[World]:
    yield from world(SimIo, {"outputs": 8, "safe": 0})


@pytest.fixture
def line() -> Iterator[World]:
    yield from world(OnLine, {}, Device(random.Random(1)))


def test_a_node_that_was_stopped_and_reset_takes_nothing_of_before(axes: World) -> None:
    owner = Sender(axes, axes.open(0, [0, 1], exclusive=True))
    owner.jog()
    stop_and_reset(axes, [0])
    owner.jog()
    assert owner.served() == [errno.ECANCELED, None]


def test_an_axis_that_was_not_stopped_takes_what_is_for_it_alone(axes: World) -> None:
    owner = Sender(axes, axes.open(0, [0, 1], exclusive=True))
    owner.jog(1)
    owner.jog(0)
    owner.post(owner.client.node._ioctl(Request.HOME, 1, None))
    stop_and_reset(axes, [0])
    assert owner.served() == [None, errno.ECANCELED, errno.ECANCELED], "HOME is judged by all axes of its node"


def test_a_reset_of_what_was_not_stopped_is_in_nobodys_way(axes: World) -> None:
    owner = Sender(axes, axes.open(0, [0], exclusive=True))
    owner.jog()
    order(axes, DriverVerb.NODE_RESET, [0])
    owner.jog(velocity=0.0)
    assert owner.served() == [None, None]


def test_an_axis_in_fault_that_is_reset_counts_as_stopped(axes: World) -> None:
    owner = Sender(axes, axes.open(0, [0], exclusive=True))
    owner.jog()
    fault(axes)
    order(axes, DriverVerb.NODE_RESET, [0])
    assert owner.served() == [errno.ECANCELED]


def test_what_a_client_sends_behind_its_own_reset_is_taken(axes: World) -> None:
    owner, eva = (Sender(axes, axes.open(0, [0], exclusive=exclusive)) for exclusive in (True, False))
    order(axes, DriverVerb.NODE_STOP, [0])
    owner.reset()
    owner.jog()
    assert owner.served() == [None, None]
    order(axes, DriverVerb.NODE_STOP, [0])
    owner.jog()
    eva.reset()
    assert eva.served() == [None]
    assert owner.served()[2:] == [errno.ECANCELED]


def test_own_resets_hide_no_later_ones_of_others(axes: World) -> None:
    owner = Sender(axes, axes.open(0, [0], exclusive=True))
    order(axes, DriverVerb.NODE_STOP, [0])
    owner.reset()
    assert owner.served() == [None]
    owner.jog()
    stop_and_reset(axes, [0])
    assert owner.served()[1:] == [errno.ECANCELED]


@pytest.mark.parametrize("is_seen", [True, False])
def test_the_workcell_takes_nothing_of_before_its_reset(axes: World, is_seen: bool) -> None:
    owner = Sender(axes, axes.open(0, [0], exclusive=True))
    owner.jog()
    axes.latch.stop(CLOCK(), "eva")
    if is_seen:
        axes.runtime.heed()
    CLOCK.now_ns += LATER_NS
    axes.latch.reset(CLOCK())
    owner.jog()
    assert owner.served() == [errno.ECANCELED, None]


def test_a_second_reset_that_ends_no_stop_makes_nothing_stale(axes: World) -> None:
    owner = Sender(axes, axes.open(0, [0], exclusive=True))
    owner.jog()
    axes.latch.stop(CLOCK(), "eva")
    axes.latch.reset(CLOCK())
    owner.jog()
    CLOCK.now_ns += LATER_NS
    axes.latch.reset(CLOCK())
    assert owner.served() == [errno.ECANCELED, None]


def test_a_reset_of_a_workcell_that_was_not_stopped_changes_nothing(axes: World) -> None:
    owner = Sender(axes, axes.open(0, [0], exclusive=True))
    owner.jog()
    assert owner.served() == [None]
    for _ in range(200):
        axes.tick()
    owner.jog(velocity=0.2)
    axes.latch.reset(CLOCK())
    assert owner.served() == [None, None]
    for _ in range(200):
        axes.tick()
    rows = axes.runtime.blocks[0].bank.rows  # type: ignore[attr-defined]
    assert rows["commanded_velocity"][0] == pytest.approx(0.2)


@pytest.mark.parametrize("is_seen", [True, False])
def test_a_reset_of_the_workcell_resets_a_node_that_alone_was_stopped(axes: World, is_seen: bool) -> None:
    owner = Sender(axes, axes.open(0, [0, 1], exclusive=True))
    order(axes, DriverVerb.NODE_STOP, [0])
    if is_seen:
        axes.runtime.heed()
    owner.jog(0)
    owner.jog(1)
    CLOCK.now_ns += LATER_NS
    axes.latch.reset(CLOCK())
    owner.jog(0)
    assert owner.served() == [errno.ECANCELED, None, None]


def test_a_stop_of_a_node_that_is_heard_of_after_the_reset_stops_what_moves(axes: World) -> None:
    owner = Sender(axes, axes.open(0, [0, 1], exclusive=True))
    owner.jog(0)
    owner.jog(1)
    assert owner.served() == [None, None]
    order(axes, DriverVerb.NODE_STOP, [0])
    axes.latch.reset(CLOCK())
    for _ in range(500):
        axes.tick()
    rows = axes.runtime.blocks[0].bank.rows  # type: ignore[attr-defined]
    assert rows["commanded_velocity"].tolist() == [0.0, pytest.approx(0.1)]
    owner.jog(0)
    assert owner.served()[2:] == [None], "it is not stopped any more"


def test_a_second_stop_that_was_missed_behind_one_that_was_seen_stops_too(axes: World) -> None:
    axes.latch.stop(CLOCK(), "eva")
    axes.runtime.heed()
    axes.latch.reset(CLOCK())
    axes.runtime.heed()
    owner = Sender(axes, axes.open(0, [0], exclusive=True))
    owner.jog()
    assert owner.served() == [None]
    axes.latch.stop(CLOCK(), "eva")
    axes.latch.reset(CLOCK())
    axes.latch.reset(CLOCK())
    axes.runtime.heed()
    for _ in range(500):
        axes.tick()
    assert axes.runtime.blocks[0].bank.rows["commanded_velocity"][0] == 0.0  # type: ignore[attr-defined]


def test_a_client_that_the_driver_hears_of_only_after_the_reset_is_judged_too(axes: World) -> None:
    early: list[Sender] = []

    def act(client: Client) -> None:
        early.append(Sender(axes, client))
        early[0].jog()
        axes.latch.stop(CLOCK(), "eva")
        CLOCK.now_ns += LATER_NS
        axes.latch.reset(CLOCK())
        axes.runtime.heed()

    axes.open(0, [0], exclusive=True, early=act)
    early[0].jog()
    assert early[0].served() == [errno.ECANCELED, None]


def test_of_a_client_behind_a_gateway_that_it_hears_of_only_then_too(axes: World) -> None:
    """What such a client sends may be under way when the driver hears of it, too."""
    before_ns = CLOCK()

    def act(_: Client) -> None:
        axes.latch.stop(CLOCK(), "eva")
        CLOCK.now_ns += LATER_NS
        axes.latch.reset(CLOCK())
        axes.runtime.heed()

    client = axes.open(0, [0], exclusive=True, early=act)
    early = Sender(axes, client)
    client.channel._sock.send(Heard(before_ns).packed())
    early.jog()
    client.channel._sock.send(Heard(CLOCK()).packed())
    early.jog()
    assert early.served() == [errno.ECANCELED, None]


def test_a_reset_that_is_seen_while_a_packet_is_being_served_is_not_missed(
    axes: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    owner = Sender(axes, axes.open(0, [0], exclusive=True))
    looks, heed = [0], axes.runtime.heed

    def late() -> None:
        looks[0] += 1
        if looks[0] == 2:  # between the look before it is received and the look before it is done
            stop_and_reset(axes, [0])
        heed()

    owner.jog()
    monkeypatch.setattr(axes.runtime, "heed", late)
    assert owner.served() == [errno.ECANCELED]


def test_stops_and_questions_of_before_are_served(axes: World) -> None:
    owner = Sender(axes, axes.open(0, [0], exclusive=True))
    for request in (Request.STOP, Request.GET_LIMITS, Request.EMERGENCY_STOP):
        owner.post(owner.client.node._ioctl(request, None, None))
    stop_and_reset(axes, [0])
    assert owner.served() == [None, None, None]


@pytest.mark.parametrize("is_received", [True, False])
def test_a_write_that_was_sent_in_part_is_refused_as_a_whole(axes: World, is_received: bool) -> None:
    owner = Sender(axes, axes.open(0, [0, 1], exclusive=True))
    number, sock = 900, owner.client.channel._sock
    owner.client.pending[number] = owner.answers.append
    SENT.note()
    sock.send(Part(number, jog(0)).packed(0))
    if is_received:
        axes.runtime.clients._readable(axes.runtime.clients.handles[owner.client.node.handle])
    stop_and_reset(axes, [0])
    CLOCK.now_ns += LATER_NS
    SENT.note()
    sock.send(Write(0, 0.0, jog(1)).packed(number))  # for the other axis, and behind the reset
    owner.jog(1)
    assert owner.served() == [errno.ECANCELED, None]


def test_a_write_in_parts_for_what_was_not_stopped_is_taken(axes: World) -> None:
    owner = Sender(axes, axes.open(0, [0, 1], exclusive=True))
    number, sock = 900, owner.client.channel._sock
    owner.client.pending[number] = owner.answers.append
    SENT.note()
    records = jog(1) * 3
    sock.send(Part(number, records[:200]).packed(0))  # parts end anywhere
    axes.runtime.clients._readable(axes.runtime.clients.handles[owner.client.node.handle])
    stop_and_reset(axes, [0])
    sock.send(Write(0, 0.0, records[200:]).packed(number))
    assert owner.served() == [None]


def test_bits_that_were_not_stopped_take_what_was_sent(port: World) -> None:
    owner = Sender(port, port.open(0, [0], exclusive=True))
    owner.set_bits(0b0100, 0b0100)
    owner.set_bits(0b1000, 0b1000)
    owner.set_bits(0b0101, 0)
    stop_and_reset(port, [0], bit=3)
    assert owner.served() == [None, errno.ECANCELED, errno.ECANCELED]
    port.tick()
    assert int(port.runtime.blocks[0].data[0]) == 0b0100  # type: ignore[attr-defined]


def test_a_node_of_one_bit_is_judged_by_that_bit(port: World) -> None:
    beside = Sender(port, port.open(0, [0], exclusive=True, bit=2))
    same = Sender(port, port.open(0, [0], exclusive=True, bit=3))
    for sender in (beside, same):
        sender.set_bits(1, 0)
    stop_and_reset(port, [0], bit=3)
    assert beside.served() == [None] and same.served() == [errno.ECANCELED]


def test_a_write_that_waits_for_the_line_does_not_come_behind_the_stop_of_its_output(line: World) -> None:
    """Though the output has no safe value; bits that are not stopped are written."""
    block = 1
    same, beside = (Sender(line, line.open(block, [0], exclusive=True, bit=bit)) for bit in (1, 2))
    for sender in (same, beside):
        sender.set_bits(1, 0)
        assert sender.served() == [], "they wait for the line"
    line.order(DriverVerb.NODE_STOP, block, [0], 1, "eva", line.latch.resets, CLOCK())
    line.runtime.heed()
    for _ in range(200):
        line.turn(calm=True)
    assert same.served() == [errno.ECANCELED] and beside.served() == [None]
    assert line.device is not None and line.device.outputs == 0b100


def test_a_client_that_leaves_takes_its_waiting_write_along(line: World) -> None:
    owner = Sender(line, line.open(1, [0], exclusive=True))
    owner.set_bits(0b11, 0)
    assert owner.served() == []
    line.close_node(owner.client)
    for _ in range(200):
        line.turn(calm=True)
    assert line.device is not None and line.device.outputs == 0


def test_what_was_under_way_on_a_network_is_of_before_and_what_knows_of_the_reset_is_not(axes: World) -> None:
    """A gateway says when its client sent something at the earliest: the word of the gateway that that repeats."""
    owner = Sender(axes, axes.open(0, [0], exclusive=True))
    sock, before_ns = owner.client.channel._sock, CLOCK()
    sock.send(Heard(before_ns).packed())
    owner.jog()
    assert owner.served() == [None]
    stop_and_reset(axes, [0])
    axes.runtime.heed()
    axes.tick()
    owner.jog()  # passed on by now, and as old as the last one
    assert owner.served() == [None, errno.ECANCELED]
    sock.send(Heard(CLOCK()).packed())
    owner.jog()
    assert owner.served() == [None, errno.ECANCELED, None]


def test_so_it_is_where_a_gateway_says_it_in_the_packet_that_it_passes_on(axes: World) -> None:
    owner = Sender(axes, axes.open(0, [0], exclusive=True))
    channel, handle = owner.client.channel, axes.runtime.clients.handles[owner.client.node.handle]
    said_ns, send = 0, channel._put
    channel._put = lambda packet: send(Passed(said_ns, packet).packed())  # type: ignore[method-assign]
    said_ns = before_ns = CLOCK()
    owner.jog()
    assert owner.served() == [None] and handle.heard_ns == before_ns and handle.passed_on
    stop_and_reset(axes, [0])
    axes.runtime.heed()
    axes.tick()
    owner.jog()  # passed on by now, and as old as the last one
    assert owner.served() == [None, errno.ECANCELED]
    said_ns = CLOCK()
    owner.jog()
    assert owner.served() == [None, errno.ECANCELED, None]
    stop_and_reset(axes, [0])
    axes.runtime.heed()
    axes.runtime.clients.heard(handle, CLOCK())  # its bridge is there, and its client's word is as old as it was
    owner.jog()
    assert owner.served() == [None, errno.ECANCELED, None, errno.ECANCELED]
    with pytest.raises(MalformedMessage, match="twice"):
        axes.runtime.clients._taken(handle, Passed(said_ns, Passed(said_ns, b"").packed()).packed())
