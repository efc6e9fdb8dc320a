"""What was sent before the reset of what it is for is not carried out after it; everything else is."""

from __future__ import annotations

import errno
import os
import random
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import pytest
from own_writes_devices import Device, OnLine
from own_writes_rig import CLOCK, SENT, Client, World, own_time

from sioms.drivers.sim.axes import SimAxes
from sioms.drivers.sim.io import SimIo
from sioms.protocol.driver_verbs import DriverVerb
from sioms.protocol.flags import ControlMode, NodeClass, Reaction, Request
from sioms.protocol.messages import MalformedMessage
from sioms.protocol.records import AXIS_WRITE, WRITE, WRITE_STRUCT
from sioms.protocol.stopjournal import StopJournal, node_entry, parts_of, replay
from sioms.protocol.verbs import Heard, Part, Passed, Write
from sioms.sdk.stops import SHOWN_NS

AXIS = {"velocity_max": 0.5, "acceleration_max": 5.0, "motor": {"mass": 1.0}, "force_max": 60.0}
LATER_NS = SHOWN_NS // 2


def _world(driver: Any, table: dict[str, Any], device: Device | None = None) -> Iterator[World]:
    made: list[World] = []
    with own_time(made):
        made.append(World.__new__(World))
        made[0].__init__(driver, table, random.Random(1), device)  # type: ignore[misc]
        yield made[0]
        made[0].close()


@pytest.fixture
def axes() -> Iterator[World]:
    yield from _world(SimAxes, {"axis": [{"name": "x", **AXIS}, {"name": "y", **AXIS}]})


@pytest.fixture
def port() -> Iterator[World]:
    yield from _world(SimIo, {"outputs": 8, "safe": 0})


@pytest.fixture
def line() -> Iterator[World]:
    yield from _world(OnLine, {}, Device(random.Random(1)))


def jog(axis: int, velocity: float = 0.1) -> bytes:
    """Return the record of a move at a velocity."""
    fields = {"axis": axis, "control_mode": int(ControlMode.VELOCITY), "velocity": velocity}
    return AXIS_WRITE.pack(*(fields.get(name, 0) for name in WRITE[NodeClass.AXIS]))


class Sender:
    """A client, and what its requests have been answered, in their order."""

    def __init__(self, world: World, client: Client) -> None:
        self.world, self.client = world, client
        self.answers: list[Any] = []

    def post(self, call: Any) -> None:
        CLOCK.now_ns += LATER_NS
        self.client.post(call, self.answers.append)

    def jog(self, axis: int = 0, velocity: float = 0.1) -> None:
        self.post(self.client.node._write(jog(axis, velocity), 0.0, False))

    def set_bits(self, bits: int, mask: int) -> None:
        self.post(self.client.node._write(WRITE_STRUCT[NodeClass.BINARY].pack(0, 0, bits, mask), 0.0, False))

    def reset(self) -> None:
        self.post(self.client.node._ioctl(Request.RESET, None, None))

    def served(self) -> list[int | None]:
        """Let the driver come to what was sent; return the errnos of the answers, None: done."""
        CLOCK.now_ns += LATER_NS
        handle = self.world.runtime.clients.handles[self.client.node.handle]
        for _ in range(8):
            self.world.runtime.clients._readable(handle)
        self.client.take()
        return [answer.errno if isinstance(answer, OSError) else None for answer in self.answers]


def _order(world: World, verb: DriverVerb, channels: list[int], bit: int = -1) -> None:
    CLOCK.now_ns += LATER_NS
    sent = [CLOCK()] * (verb == DriverVerb.NODE_RESET)
    world.order(verb, 0, channels, bit, "eva", world.latch.resets, CLOCK(), *sent)


def _stop_and_reset(world: World, channels: list[int], bit: int = -1) -> None:
    _order(world, DriverVerb.NODE_STOP, channels, bit)
    _order(world, DriverVerb.NODE_RESET, channels, bit)


def test_a_node_that_was_stopped_and_reset_takes_nothing_of_before(axes: World) -> None:
    owner = Sender(axes, axes.open(0, [0, 1], exclusive=True))
    owner.jog()
    _stop_and_reset(axes, [0])
    owner.jog()
    assert owner.served() == [errno.ECANCELED, None]


def test_an_axis_that_was_not_stopped_takes_what_is_for_it_alone(axes: World) -> None:
    owner = Sender(axes, axes.open(0, [0, 1], exclusive=True))
    owner.jog(1)
    owner.jog(0)
    owner.post(owner.client.node._ioctl(Request.HOME, 1, None))
    _stop_and_reset(axes, [0])
    assert owner.served() == [None, errno.ECANCELED, errno.ECANCELED], "HOME is judged by all axes of its node"


def test_a_reset_of_what_was_not_stopped_is_in_nobodys_way(axes: World) -> None:
    owner = Sender(axes, axes.open(0, [0], exclusive=True))
    owner.jog()
    _order(axes, DriverVerb.NODE_RESET, [0])
    owner.jog(velocity=0.0)
    assert owner.served() == [None, None]


def test_an_axis_in_fault_that_is_reset_counts_as_stopped(axes: World) -> None:
    owner = Sender(axes, axes.open(0, [0], exclusive=True))
    owner.jog()
    _fault(axes)
    _order(axes, DriverVerb.NODE_RESET, [0])
    assert owner.served() == [errno.ECANCELED]


def _fault(world: World, axis: int = 0) -> None:
    """Put an axis in fault, and let everybody see it."""
    CLOCK.now_ns += LATER_NS
    world.runtime.blocks[0].bank.fault([axis], "it jams", CLOCK() - LATER_NS)  # type: ignore[attr-defined]
    world.runtime.publish(world.runtime.blocks[0], CLOCK())


def _in_fault(world: World, axis: int = 0) -> bool:
    return bool(world.runtime.blocks[0].bank.is_in_fault(axis))  # type: ignore[attr-defined]


def test_a_reset_on_a_handle_that_was_sent_before_a_fault_leaves_it(axes: World) -> None:
    owner = Sender(axes, axes.open(0, [0, 1], exclusive=True))
    owner.reset()
    _fault(axes)
    assert owner.served() == [errno.EAGAIN] and "it jams" in str(owner.answers[0])
    assert _in_fault(axes)
    owner.reset()
    assert owner.served()[1:] == [None] and not _in_fault(axes)


def test_a_fault_that_nobody_can_have_seen_is_younger_than_any_reset(axes: World) -> None:
    owner = Sender(axes, axes.open(0, [0], exclusive=True))
    axes.runtime.blocks[0].bank.fault([0], "it jams", CLOCK())  # type: ignore[attr-defined]
    owner.reset()  # neither a reading nor an answer has told of it
    assert owner.served() == [errno.EAGAIN] and _in_fault(axes)


def test_a_refusal_tells_of_a_fault_as_a_reading_does(axes: World) -> None:
    owner = Sender(axes, axes.open(0, [0], exclusive=True))
    axes.runtime.blocks[0].bank.fault([0], "it jams", CLOCK())  # type: ignore[attr-defined]
    owner.jog()
    assert owner.served() == [errno.EIO]
    owner.reset()
    assert owner.served()[1:] == [None] and not _in_fault(axes)


def test_a_stop_by_an_alarm_that_nobody_can_have_seen_is_younger_than_any_reset(axes: World) -> None:
    owner = Sender(axes, axes.open(0, [0], exclusive=True))
    block: Any = axes.runtime.blocks[0]
    rule: Any = SimpleNamespace(node="mod0.x", stops=[0], bit=-1)
    axes.runtime.stops.stop_by_alarm(Reaction.STOP_NODE, block, rule, "too far")
    owner.reset()  # it has been stopped, but no reading shows that
    assert owner.served() == [errno.EAGAIN] and block.bank.is_stopped(0)
    axes.runtime.stops.stop_by_alarm(Reaction.STOP_NODE, block, rule, "too far")
    CLOCK.now_ns += LATER_NS
    axes.runtime.publish(block, CLOCK())
    owner.reset()
    assert owner.served()[1:] == [None] and not block.bank.is_stopped(0)


def test_a_stop_by_an_alarm_that_the_daemon_shows_is_reset_though_a_slow_device_shows_it_later(axes: World) -> None:
    """The daemon had acknowledged it, and the driver did nothing: at 10 Hz a reading shows a stop 100 ms later."""
    block: Any = axes.runtime.blocks[0]
    rule: Any = SimpleNamespace(node="mod0.x", stops=[0], bit=-1)
    axes.runtime.stops.stop_by_alarm(Reaction.STOP_NODE, block, rule, "too far")
    CLOCK.now_ns += SHOWN_NS + 1
    sent_ns = CLOCK()
    CLOCK.now_ns += LATER_NS
    axes.runtime.publish(block, CLOCK())
    axes.order(DriverVerb.NODE_RESET, 0, [0], -1, "eva", axes.latch.resets, CLOCK(), sent_ns)
    axes.runtime.heed()
    assert not block.bank.is_stopped(0)


def test_a_reset_by_the_daemon_that_was_sent_before_a_fault_leaves_it(axes: World, tmp_path: Any) -> None:
    sent_ns = CLOCK()
    _fault(axes)
    axes.order(DriverVerb.NODE_RESET, 0, [0, 1], -1, "eva", axes.latch.resets, CLOCK(), sent_ns)
    axes.runtime.heed()
    assert _in_fault(axes)
    _order(axes, DriverVerb.NODE_RESET, [0, 1])
    axes.runtime.heed()
    assert not _in_fault(axes)


def test_a_reset_of_the_workcell_ends_its_stop_and_leaves_faults_that_came_since(axes: World) -> None:
    bank: Any = axes.runtime.blocks[0].bank  # type: ignore[attr-defined]
    axes.latch.stop(CLOCK(), "eva")
    axes.runtime.heed()
    _fault(axes, 1)
    CLOCK.now_ns += LATER_NS
    sent_ns = CLOCK()
    _fault(axes, 0)
    axes.latch.reset(CLOCK(), sent_ns=sent_ns)
    axes.runtime.heed()
    assert _in_fault(axes, 0) and not bank.is_stopped(0)
    assert not bank.is_latched(1)
    CLOCK.now_ns += LATER_NS
    axes.latch.reset(CLOCK())
    axes.runtime.heed()
    assert not bank.is_latched(0)


def test_a_fault_that_a_later_reset_has_cleared_is_in_no_earlier_ones_way(axes: World) -> None:
    owner, eva = (Sender(axes, axes.open(0, [0], exclusive=exclusive)) for exclusive in (True, False))
    owner.reset()
    _fault(axes)
    eva.reset()
    assert eva.served() == [None] and owner.served() == [None]


def test_a_fault_is_not_noted_as_a_stop_when_its_reset_is_refused(axes: World) -> None:
    noted: list[Any] = []
    axes.runtime.stops._journal = SimpleNamespace(append=lambda entry, _: noted.append(entry))  # type: ignore[assignment]
    owner = Sender(axes, axes.open(0, [0], exclusive=True))
    owner.reset()
    heed = axes.runtime.heed

    def fault_meanwhile() -> None:
        heed()
        if noted and not _in_fault(axes):
            _fault(axes)

    axes.runtime.heed = fault_meanwhile  # type: ignore[method-assign]
    assert owner.served() == [errno.EAGAIN] and _in_fault(axes)
    assert [entry["stop"] for entry in noted] == [False]


def test_what_a_client_sends_behind_its_own_reset_is_taken(axes: World) -> None:
    owner, eva = (Sender(axes, axes.open(0, [0], exclusive=exclusive)) for exclusive in (True, False))
    _order(axes, DriverVerb.NODE_STOP, [0])
    owner.reset()
    owner.jog()
    assert owner.served() == [None, None]
    _order(axes, DriverVerb.NODE_STOP, [0])
    owner.jog()
    eva.reset()
    assert eva.served() == [None]
    assert owner.served()[2:] == [errno.ECANCELED]


def test_a_reset_that_was_sent_before_a_stop_leaves_it(axes: World) -> None:
    owner = Sender(axes, axes.open(0, [0, 1], exclusive=True))
    _order(axes, DriverVerb.NODE_STOP, [0])
    axes.runtime.heed()
    owner.reset()
    _order(axes, DriverVerb.NODE_STOP, [0])  # somebody asks for it again, and that is acknowledged
    owner.jog(0)
    assert owner.served() == [errno.EAGAIN, errno.EPERM]
    owner.reset()
    owner.jog(0)
    assert owner.served()[2:] == [None, None]


def test_an_output_that_was_stopped_after_its_reset_had_been_sent_stays_so(port: World) -> None:
    owner = Sender(port, port.open(0, [0], exclusive=True))
    owner.reset()
    _order(port, DriverVerb.NODE_STOP, [0], bit=3)
    owner.set_bits(0b1000, 0b1000)
    assert owner.served() == [errno.EAGAIN, errno.EPERM]


def test_a_reset_leaves_a_stop_that_the_driver_hears_of_while_it_resets(
    axes: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    owner = Sender(axes, axes.open(0, [0], exclusive=True))
    looks, heed = [0], axes.runtime.heed

    def late() -> None:
        looks[0] += 1
        if looks[0] == 3:  # after the look before it is served
            _order(axes, DriverVerb.NODE_STOP, [0])
        heed()

    owner.reset()
    monkeypatch.setattr(axes.runtime, "heed", late)
    assert owner.served() == [errno.EAGAIN]
    assert axes.runtime.blocks[0].bank.is_latched(0)  # type: ignore[attr-defined]


def test_ones_own_stop_hides_none_that_another_has_asked_for_before(axes: World) -> None:
    """Both lay there: the reset was sent before the other's stop, which is served first."""
    eager, other = (Sender(axes, axes.open(0, [0], exclusive=False)) for _ in range(2))
    eager.post(eager.client.node._ioctl(Request.EMERGENCY_STOP, None, None))
    eager.reset()
    other.post(other.client.node._ioctl(Request.EMERGENCY_STOP, None, None))
    assert other.served() == [None]
    assert eager.served() == [None, errno.EAGAIN]
    eager.reset()
    assert eager.served()[2:] == [None]


@pytest.mark.parametrize("bit", [-1, 3])
def test_a_reset_by_the_daemon_undoes_no_stop_that_was_asked_for_on_a_handle_since(port: World, bit: int) -> None:
    sent_ns = CLOCK()
    owner = Sender(port, port.open(0, [0], exclusive=True, bit=bit))
    owner.post(owner.client.node._ioctl(Request.EMERGENCY_STOP, None, None))
    assert owner.served() == [None]
    parts = parts_of(0, bit, 8)
    journal = StopJournal(os.dup(port.journal))
    journal.append(node_entry("io0", "dev", port.runtime.blocks[0].spec.name, parts, "eva", stop=False), 0.0)
    journal.close()  # as the daemon does first
    by_eva = (DriverVerb.NODE_RESET, 0, [0], bit, "eva", port.latch.resets, CLOCK())
    port.order(*by_eva, sent_ns)
    port.runtime.heed()
    owner.set_bits(1, 0)
    assert owner.served() == [None, errno.EPERM]
    noted = replay(os.pread(port.journal, 1 << 16, 0), 0, 0.0)
    assert {part[2:] for part in noted.parts} == {*parts}, "also after the end of its process"
    port.order(*by_eva, CLOCK())
    port.runtime.heed()
    owner.set_bits(1, 0)
    assert owner.served()[2:] == [None]


def test_what_a_driver_starts_with_is_undone_by_a_reset_that_came_while_it_started(port: World) -> None:
    """The daemon has judged that reset: it knows when the stop was asked for."""
    sent_ns = CLOCK()
    CLOCK.now_ns += LATER_NS
    port.runtime.stops.restore([(port.runtime.blocks[0].spec.name, [[0, 0, 0b1000]], "eva", "io0")])
    owner = Sender(port, port.open(0, [0], exclusive=True))
    owner.set_bits(0b1000, 0b1000)
    assert owner.served() == [errno.EPERM]
    port.order(DriverVerb.NODE_RESET, 0, [0], -1, "eva", port.latch.resets, CLOCK(), sent_ns)
    port.runtime.heed()
    owner.set_bits(0b1000, 0b1000)
    assert owner.served()[1:] == [None]


def test_a_reset_of_the_workcell_undoes_no_stop_of_a_node_that_was_asked_for_since(axes: World) -> None:
    axes.latch.stop(CLOCK(), "eva")
    axes.runtime.heed()
    CLOCK.now_ns += LATER_NS
    sent_ns = CLOCK()
    owner = Sender(axes, axes.open(0, [0, 1], exclusive=True))
    beside = Sender(axes, axes.open(0, [1], exclusive=False))
    beside.post(beside.client.node._ioctl(Request.EMERGENCY_STOP, None, None))
    assert beside.served() == [None]
    axes.latch.reset(CLOCK(), sent_ns=sent_ns)
    owner.jog(1)
    owner.jog(0)
    assert owner.served() == [errno.EPERM, None]
    CLOCK.now_ns += LATER_NS
    axes.latch.reset(CLOCK())
    owner.jog(1)
    assert owner.served()[2:] == [None]


def test_two_resets_at_once_are_both_done(axes: World) -> None:
    owner, eva = (Sender(axes, axes.open(0, channels, exclusive=len(channels) > 1)) for channels in ([0, 1], [0]))
    _order(axes, DriverVerb.NODE_STOP, [0, 1])
    owner.reset()
    eva.reset()
    assert eva.served() == [None] and owner.served() == [None]
    assert not any(axes.runtime.blocks[0].bank.is_latched(axis) for axis in (0, 1))  # type: ignore[attr-defined]


def test_own_resets_hide_no_later_ones_of_others(axes: World) -> None:
    owner = Sender(axes, axes.open(0, [0], exclusive=True))
    _order(axes, DriverVerb.NODE_STOP, [0])
    owner.reset()
    assert owner.served() == [None]
    owner.jog()
    _stop_and_reset(axes, [0])
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
    _order(axes, DriverVerb.NODE_STOP, [0])
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
    _order(axes, DriverVerb.NODE_STOP, [0])
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
            _stop_and_reset(axes, [0])
        heed()

    owner.jog()
    monkeypatch.setattr(axes.runtime, "heed", late)
    assert owner.served() == [errno.ECANCELED]


def test_stops_and_questions_of_before_are_served(axes: World) -> None:
    owner = Sender(axes, axes.open(0, [0], exclusive=True))
    for request in (Request.STOP, Request.GET_LIMITS, Request.EMERGENCY_STOP):
        owner.post(owner.client.node._ioctl(request, None, None))
    _stop_and_reset(axes, [0])
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
    _stop_and_reset(axes, [0])
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
    _stop_and_reset(axes, [0])
    sock.send(Write(0, 0.0, records[200:]).packed(number))
    assert owner.served() == [None]


def test_bits_that_were_not_stopped_take_what_was_sent(port: World) -> None:
    owner = Sender(port, port.open(0, [0], exclusive=True))
    owner.set_bits(0b0100, 0b0100)
    owner.set_bits(0b1000, 0b1000)
    owner.set_bits(0b0101, 0)
    _stop_and_reset(port, [0], bit=3)
    assert owner.served() == [None, errno.ECANCELED, errno.ECANCELED]
    port.tick()
    assert int(port.runtime.blocks[0].data[0]) == 0b0100  # type: ignore[attr-defined]


def test_a_node_of_one_bit_is_judged_by_that_bit(port: World) -> None:
    beside = Sender(port, port.open(0, [0], exclusive=True, bit=2))
    same = Sender(port, port.open(0, [0], exclusive=True, bit=3))
    for sender in (beside, same):
        sender.set_bits(1, 0)
    _stop_and_reset(port, [0], bit=3)
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
    _stop_and_reset(axes, [0])
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
    _stop_and_reset(axes, [0])
    axes.runtime.heed()
    axes.tick()
    owner.jog()  # passed on by now, and as old as the last one
    assert owner.served() == [None, errno.ECANCELED]
    said_ns = CLOCK()
    owner.jog()
    assert owner.served() == [None, errno.ECANCELED, None]
    _stop_and_reset(axes, [0])
    axes.runtime.heed()
    axes.runtime.clients.heard(handle, CLOCK())  # its bridge is there, and its client's word is as old as it was
    owner.jog()
    assert owner.served() == [None, errno.ECANCELED, None, errno.ECANCELED]
    with pytest.raises(MalformedMessage, match="twice"):
        axes.runtime.clients._taken(handle, Passed(said_ns, Passed(said_ns, b"").packed()).packed())
