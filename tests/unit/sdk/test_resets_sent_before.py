"""A reset undoes no stop and no fault that is younger than itself, however late it is served."""

from __future__ import annotations

import errno
import os
from collections.abc import Iterator
from contextlib import suppress
from types import SimpleNamespace
from typing import Any

import pytest
from own_writes_rig import CLOCK, World
from sender_rig import AXIS, LATER_NS, Sender, fault, in_fault, order, world

from sioms.drivers.sim.axes import SimAxes
from sioms.drivers.sim.io import SimIo
from sioms.protocol.driver_verbs import FROM_DRIVER, DriverVerb, StopsShown
from sioms.protocol.flags import Reaction, Request
from sioms.protocol.page import PageWriter
from sioms.protocol.stopjournal import StopJournal, node_entry, parts_of, replay
from sioms.protocol.verbs import take
from sioms.sdk.handles import Handle
from sioms.sdk.stops import SHOWN_NS


@pytest.fixture
def axes() -> Iterator[World]:
    yield from world(SimAxes, {"axis": [{"name": "x", **AXIS}, {"name": "y", **AXIS}]})


@pytest.fixture
def port() -> Iterator[World]:
    yield from world(SimIo, {"outputs": 8, "safe": 0})


def test_a_reset_on_a_handle_that_was_sent_before_a_fault_leaves_it(axes: World) -> None:
    owner = Sender(axes, axes.open(0, [0, 1], exclusive=True))
    owner.reset()
    fault(axes)
    assert owner.served() == [errno.EAGAIN] and "it jams" in str(owner.answers[0])
    assert in_fault(axes)
    owner.reset()
    assert owner.served()[1:] == [None] and not in_fault(axes)


def test_a_fault_that_nobody_can_have_seen_is_younger_than_any_reset(axes: World) -> None:
    owner = Sender(axes, axes.open(0, [0], exclusive=True))
    axes.runtime.blocks[0].bank.fault([0], "it jams", CLOCK())  # type: ignore[attr-defined]
    owner.reset()  # neither a reading nor an answer has told of it
    assert owner.served() == [errno.EAGAIN] and in_fault(axes)


def test_a_refusal_tells_of_a_fault_as_a_reading_does(axes: World) -> None:
    owner = Sender(axes, axes.open(0, [0], exclusive=True))
    axes.runtime.blocks[0].bank.fault([0], "it jams", CLOCK())  # type: ignore[attr-defined]
    owner.jog()
    assert owner.served() == [errno.EIO]
    owner.reset()
    assert owner.served()[1:] == [None] and not in_fault(axes)


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


def _shown_ns(world: World) -> list[int]:
    """Return what the driver has told of since when its stops can be known."""
    told: list[int] = []
    with suppress(BlockingIOError):
        while True:
            _, message = take(world.control.recv(1 << 16), FROM_DRIVER)
            told += [message.at_ns] if isinstance(message, StopsShown) else []
    return told


def _stop_by_alarm(world: World) -> None:
    rule: Any = SimpleNamespace(node="mod0.x", stops=[0], bit=-1)
    world.runtime.stops.stop_by_alarm(Reaction.STOP_NODE, world.runtime.blocks[0], rule, "too far")


def test_the_daemon_hears_of_a_stop_by_an_alarm_before_a_reading_shows_it(
    axes: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    block, told = axes.runtime.blocks[0], []
    _stop_by_alarm(axes)
    assert not _shown_ns(axes), "nobody can know of it"
    publish = PageWriter.publish
    monkeypatch.setattr(PageWriter, "publish", lambda *of: (told.extend(_shown_ns(axes)), publish(*of))[1])
    CLOCK.now_ns += LATER_NS
    before_ns = CLOCK.now_ns
    axes.runtime.publish(block, CLOCK())
    assert len(told) == 1 and before_ns < told[0] <= CLOCK.now_ns
    axes.runtime.publish(block, CLOCK())
    assert len(told) == 1


@pytest.mark.parametrize("by", ["alarm", "client"])
def test_who_waits_is_not_told_of_a_stop_before_it_is_kept(
    axes: World, monkeypatch: pytest.MonkeyPatch, by: str
) -> None:
    """A reset that he sends through the daemon is noted behind the stop then."""
    owner, other = Sender(axes, axes.open(0, [0], exclusive=True)), Sender(axes, axes.open(0, [0], exclusive=False))
    owner.jog()
    owner.post(owner.client.node._ioctl(Request.WAIT_UNTIL_IDLE, None, None))
    assert owner.served() == [None]
    kept: list[Any] = []
    refuse = Handle.refuse

    def refused(*arguments: Any) -> None:
        state = replay(os.pread(axes.journal, 1 << 16, 0).rstrip(b"\0"), 0, 0.0)
        kept.append((state.nodes(), len(_shown_ns(axes))))
        refuse(*arguments)

    monkeypatch.setattr(Handle, "refuse", refused)
    if by == "alarm":
        _stop_by_alarm(axes)
    else:
        other.post(other.client.node._ioctl(Request.EMERGENCY_STOP, None, None))
        other.served()
    assert owner.served() == [None, errno.ECANCELED]
    assert len(kept) == 1 and len(kept[0][0]) == 1, "the stop is in the journal by then"
    assert kept[0][1] == (by == "alarm"), "and the daemon knows that it can be known"


def test_a_reset_by_the_daemon_that_was_sent_before_a_fault_leaves_it(axes: World, tmp_path: Any) -> None:
    sent_ns = CLOCK()
    fault(axes)
    axes.order(DriverVerb.NODE_RESET, 0, [0, 1], -1, "eva", axes.latch.resets, CLOCK(), sent_ns)
    axes.runtime.heed()
    assert in_fault(axes)
    order(axes, DriverVerb.NODE_RESET, [0, 1])
    axes.runtime.heed()
    assert not in_fault(axes)


def test_a_reset_of_the_workcell_ends_its_stop_and_leaves_faults_that_came_since(axes: World) -> None:
    bank: Any = axes.runtime.blocks[0].bank  # type: ignore[attr-defined]
    axes.latch.stop(CLOCK(), "eva")
    axes.runtime.heed()
    fault(axes, 1)
    CLOCK.now_ns += LATER_NS
    sent_ns = CLOCK()
    fault(axes, 0)
    axes.latch.reset(CLOCK(), sent_ns=sent_ns)
    axes.runtime.heed()
    assert in_fault(axes, 0) and not bank.is_stopped(0)
    assert not bank.is_latched(1)
    CLOCK.now_ns += LATER_NS
    axes.latch.reset(CLOCK())
    axes.runtime.heed()
    assert not bank.is_latched(0)


def test_a_fault_that_a_later_reset_has_cleared_is_in_no_earlier_ones_way(axes: World) -> None:
    owner, eva = (Sender(axes, axes.open(0, [0], exclusive=exclusive)) for exclusive in (True, False))
    owner.reset()
    fault(axes)
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
        if noted and not in_fault(axes):
            fault(axes)

    axes.runtime.heed = fault_meanwhile  # type: ignore[method-assign]
    assert owner.served() == [errno.EAGAIN] and in_fault(axes)
    assert [entry["stop"] for entry in noted] == [False]


def test_a_reset_that_was_sent_before_a_stop_leaves_it(axes: World) -> None:
    owner = Sender(axes, axes.open(0, [0, 1], exclusive=True))
    order(axes, DriverVerb.NODE_STOP, [0])
    axes.runtime.heed()
    owner.reset()
    order(axes, DriverVerb.NODE_STOP, [0])  # somebody asks for it again, and that is acknowledged
    owner.jog(0)
    assert owner.served() == [errno.EAGAIN, errno.EPERM]
    owner.reset()
    owner.jog(0)
    assert owner.served()[2:] == [None, None]


def test_an_output_that_was_stopped_after_its_reset_had_been_sent_stays_so(port: World) -> None:
    owner = Sender(port, port.open(0, [0], exclusive=True))
    owner.reset()
    order(port, DriverVerb.NODE_STOP, [0], bit=3)
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
            order(axes, DriverVerb.NODE_STOP, [0])
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
    order(axes, DriverVerb.NODE_STOP, [0, 1])
    owner.reset()
    eva.reset()
    assert eva.served() == [None] and owner.served() == [None]
    assert not any(axes.runtime.blocks[0].bank.is_latched(axis) for axis in (0, 1))  # type: ignore[attr-defined]
