"""A synch comes after the writes that its handle has sent before it; no instant is taken for a later one."""

from __future__ import annotations

import errno
import random
from collections.abc import Iterator
from typing import Any

import pytest
from own_writes_rig import CLOCK, World, own_time

from sioms.drivers.sim.axes import SimAxes
from sioms.protocol.driver_verbs import DriverVerb
from sioms.protocol.flags import AxisStatus, ControlMode, NodeClass, Request
from sioms.protocol.records import AXIS_WRITE, WRITE

X = {
    "name": "x", "position_min": -1.0, "position_max": 1.0, "velocity_max": 0.5, "acceleration_max": 5.0,
    "motor": {"mass": 1.0}, "force_max": 60.0,
}  # fmt: skip
MODE = int(ControlMode.POSITION)
GATED = MODE | int(ControlMode.WAIT_FOR_EXTERNAL_SYNCH)


def _path(count: int, mode: int = GATED) -> bytes:
    """Return a path whose first command waits for the synch."""
    given: dict[str, Any] = {"velocity": 0.5, "acceleration": 5.0}
    records = []
    for i in range(count):
        fields = given | {"control_mode": MODE if i else mode, "position": 0.01 * (i % 2 + 1)}
        records.append(AXIS_WRITE.pack(*(fields.get(name, 0) for name in WRITE[NodeClass.AXIS])))
    return b"".join(records)


@pytest.fixture
def world() -> Iterator[World]:
    made: list[World] = []
    with own_time(made):
        made.append(World(SimAxes, {"axis": [X], "capacity": 64}, random.Random(1)))
        yield made[0]
        made[0].close()


class Owner:
    """A client, and the answers that it has got in their order."""

    def __init__(self, world: World) -> None:
        self.world, self.client = world, world.open(0, [0], exclusive=True)
        self.answers: list[tuple[str, Any]] = []

    def send(self, what: str, call: Any) -> None:
        self.client.send(call, lambda value: self.answers.append((what, value)))

    def write(self, what: str, records: bytes, *, patience_s: float = 0.0, replace: bool = False) -> None:
        """Write late in a period, where no time is left to judge more than a few records."""
        CLOCK.now_ns = max(CLOCK.now_ns, self.world.runtime._spare_until_ns + 1)
        self.send(what, self.client.node._write(records, patience_s, replace))

    def ask(self, request: Request, argument: Any = None) -> None:
        self.send(request.name, self.client.node._ioctl(request, argument, None))

    def tick(self, count: int = 20) -> None:
        for _ in range(count):
            self.world.tick()
            self.client.take()

    @property
    def said(self) -> list[str]:
        return [what for what, value in self.answers if not isinstance(value, OSError)]

    @property
    def refused(self) -> dict[str, int | None]:
        return {what: value.errno for what, value in self.answers if isinstance(value, OSError)}

    @property
    def waits_for_synch(self) -> bool:
        status = int(self.world.runtime.blocks[0].bank.rows["status"][0])  # type: ignore[attr-defined]
        return bool(status & AxisStatus.WAITING_SYNCH)


def test_a_synch_starts_the_long_write_that_was_sent_before_it(world: World) -> None:
    owner = Owner(world)
    owner.write("path", _path(40))
    owner.ask(Request.SEND_EXTERNAL_SYNCH)
    assert owner.said == [], "judged between ticks"
    owner.tick()
    assert owner.said == ["path", "SEND_EXTERNAL_SYNCH"]
    assert not owner.waits_for_synch


def test_a_synch_does_not_start_the_write_that_was_sent_after_it(world: World) -> None:
    owner = Owner(world)
    owner.write("first", _path(40, MODE))
    owner.ask(Request.SEND_EXTERNAL_SYNCH)
    owner.write("second", _path(1))
    owner.tick()
    assert owner.said == ["first", "SEND_EXTERNAL_SYNCH", "second"]
    owner.tick(4000)
    assert owner.waits_for_synch


def test_a_write_that_waits_for_the_room_which_the_synch_makes_is_not_waited_for(world: World) -> None:
    owner = Owner(world)
    owner.write("first", _path(40))
    owner.tick()
    assert owner.waits_for_synch
    owner.write("second", _path(40, MODE), patience_s=60.0)
    owner.tick()
    owner.ask(Request.SEND_EXTERNAL_SYNCH)
    assert owner.said == ["first", "SEND_EXTERNAL_SYNCH"], "at once"
    owner.tick(4000)
    assert owner.said == ["first", "SEND_EXTERNAL_SYNCH", "second"]


@pytest.mark.parametrize("end", ["stop", "emergency", "flush", "replace"])
def test_what_ends_the_write_ends_the_synch_behind_it(world: World, end: str) -> None:
    owner = Owner(world)
    owner.write("path", _path(40))
    owner.ask(Request.SEND_EXTERNAL_SYNCH)
    if end == "stop":
        owner.ask(Request.STOP)
    elif end == "emergency":
        world.order(DriverVerb.NODE_STOP, 0, [0], -1, "eva", world.latch.resets, CLOCK())
    elif end == "flush":
        owner.ask(Request.FLUSH)
    else:
        owner.write("other", _path(1), replace=True)
    owner.tick()
    assert owner.refused == dict.fromkeys(["path", "SEND_EXTERNAL_SYNCH"], errno.ECANCELED)
    assert owner.waits_for_synch == (end == "replace"), "what replaces the path waits for a synch of its own"


def test_a_start_that_passes_while_the_write_is_judged_is_refused(world: World) -> None:
    owner = Owner(world)
    owner.write("path", _path(40))
    owner.ask(Request.SEND_EXTERNAL_SYNCH, CLOCK() + 1000)
    CLOCK.now_ns += 50_000_000
    owner.tick()
    assert owner.refused == {"SEND_EXTERNAL_SYNCH": errno.ETIME}
    assert owner.waits_for_synch


def test_no_instant_is_told_as_seen_at_which_a_stop_had_been_ordered(world: World) -> None:
    runtime, ordered = world.runtime, []

    def order() -> None:
        CLOCK.intrude = None
        world.order(DriverVerb.NODE_STOP, 0, [0], -1, "eva", world.latch.resets, CLOCK())
        ordered.append(CLOCK())

    world.tick()
    CLOCK.now_ns += 100_000
    CLOCK.intrude = order
    assert runtime.as_of_ns() < ordered[0], "it came while the instant was found out"
