"""What is asked of one axis of a node leaves alone the writes to its others that are on their way."""

from __future__ import annotations

import errno
import random
from collections.abc import Iterator
from typing import Any

import pytest
from own_writes_rig import World, own_time

from sioms.drivers.sim.axes import SimAxes
from sioms.protocol.flags import ControlMode, NodeClass, Request
from sioms.protocol.records import AXIS_WRITE, WRITE

AXIS = {"velocity_max": 0.5, "acceleration_max": 5.0, "motor": {"mass": 1.0}, "force_max": 60.0}
CAPACITY = 8


@pytest.fixture
def world() -> Iterator[World]:
    made: list[World] = []
    with own_time(made):
        axes = [{"name": name, **AXIS} for name in "xy"]
        made.append(World(SimAxes, {"axis": axes, "capacity": CAPACITY}, random.Random(1)))
        yield made[0]
        made[0].close()


def _record(axis: int, flags: int = 0) -> bytes:
    fields = {"axis": axis, "control_mode": int(ControlMode.VELOCITY | flags), "time": 1.0}
    return AXIS_WRITE.pack(*(fields.get(name, 0) for name in WRITE[NodeClass.AXIS]))


class Owner:
    """A client of both axes, and the answers that it has got."""

    def __init__(self, world: World) -> None:
        self.world, self.client = world, world.open(0, [0, 1], exclusive=True)
        self.answers: dict[str, Any] = {}

    def send(self, what: str, call: Any) -> None:
        self.client.send(call, lambda value: self.answers.update({what: value}))

    def fill(self, what: str, axis: int) -> None:
        """Write more than has room, to an axis that waits for the synch, and wait for room."""
        records = _record(axis, ControlMode.SPECIFIED_TIME | ControlMode.WAIT_FOR_EXTERNAL_SYNCH) * (CAPACITY - 2)
        self.send(f"{what}, first", self.client.node._write(records, 0.0, False))
        self.send(what, self.client.node._write(records, 60.0, False))

    def replace(self, what: str, axis: int) -> None:
        """Replace the buffer of an axis."""
        self.send(what, self.client.node._write(_record(axis), 0.0, True))

    def ask(self, request: Request, argument: Any = None) -> None:
        self.send(request.name, self.client.node._ioctl(request, argument, None))

    def tick(self) -> None:
        for _ in range(50):
            self.world.tick()
            self.client.take()


def test_a_stop_of_one_axis_ends_no_write_to_another(world: World) -> None:
    owner = Owner(world)
    owner.fill("y", 1)
    owner.tick()
    owner.ask(Request.STOP, 0)
    owner.tick()
    assert "y" not in owner.answers, "it waits for room"
    owner.ask(Request.STOP, 1)
    owner.tick()
    assert owner.answers["y"].errno == errno.ECANCELED


def test_what_replaces_the_buffer_of_one_axis_ends_no_write_to_another(world: World) -> None:
    owner = Owner(world)
    owner.fill("y", 1)
    owner.tick()
    owner.replace("x", 0)
    owner.tick()
    assert type(owner.answers["x"]) is int and "y" not in owner.answers
    owner.replace("y anew", 1)
    owner.tick()
    assert owner.answers["y"].errno == errno.ECANCELED


def test_one_axis_is_idle_whatever_is_on_its_way_to_another(world: World) -> None:
    owner = Owner(world)
    owner.fill("y", 1)
    owner.tick()
    owner.ask(Request.WAIT_UNTIL_IDLE, 0)
    owner.tick()
    assert owner.answers["WAIT_UNTIL_IDLE"] is None
    del owner.answers["WAIT_UNTIL_IDLE"]
    owner.ask(Request.WAIT_UNTIL_IDLE, 1)
    owner.tick()
    assert "WAIT_UNTIL_IDLE" not in owner.answers


@pytest.mark.parametrize("argument", [None, [0.0], [0.0, 0.0, 0.0]])
def test_a_calibration_gives_every_axis_a_position_or_none(world: World, argument: Any) -> None:
    owner = Owner(world)
    owner.ask(Request.CALIBRATE_DEVICE, argument)
    assert owner.answers["CALIBRATE_DEVICE"].errno == errno.EINVAL
    owner.ask(Request.CALIBRATE_DEVICE, [None, 0.25])
    owner.tick()
    assert owner.answers["CALIBRATE_DEVICE"] is None
    assert owner.client.node.read().position == (0.0, 0.25)
