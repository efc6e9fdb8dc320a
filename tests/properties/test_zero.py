"""A zero is the mean of what was measured after it was asked for, answered when it is in force, or refused with all as
it was.
"""

from __future__ import annotations

import errno
import math
import random
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from own_writes_devices import Device, LineTable, Pushing
from own_writes_rig import DEVICE, Client, World, worlds

from sioms.drivers.sim.tactile import SimTactile
from sioms.protocol.flags import AnalogStatus, Request
from sioms.sdk.blocks import AnyBlock, Description
from sioms.sdk.driver import Kit, TickDriver
from sioms.sdk.force_torque import ForceBlock, force_spec

FINGER = str(Path(__file__).parents[2] / "etc" / "finger.toml")
INVALID, SATURATED = int(AnalogStatus.INVALID), int(AnalogStatus.SATURATED)


@pytest.fixture
def make_world() -> Iterator[Callable[..., World]]:
    with worlds() as make:
        yield make


class Scripted(TickDriver):
    """A force sensor that reads what the test says: a value and its flags each tick, the last for ever."""

    Settings = LineTable
    realtime_priority = 0

    @classmethod
    def describe(cls, name: str, settings: LineTable) -> Description:
        return Description((force_spec((10.0,) * 6, 4, ""),), 1000.0, lease_s=1e6)

    def __init__(self, name: str, settings: LineTable, kit: Kit) -> None:
        super().__init__(name, settings, kit)
        self.block = ForceBlock(self.describe(name, settings).blocks[0], name, kit)
        self.script: list[tuple[float, int]] = [(2.0, 0)]

    @property
    def blocks(self) -> Sequence[AnyBlock]:
        return (self.block,)

    def tick(self, now_ns: int) -> None:
        value, flags = self.script.pop(0) if len(self.script) > 1 else self.script[0]
        self.block.fill([value] * 6, now_ns, flags)


def asked(world: World, client: Client, argument: Any, turns: int = 40) -> Any:
    """Return what a zero is answered."""
    answers: list[Any] = []
    client.ioctl(Request.ZERO_DEVICE, argument, answers.append)
    for _ in range(turns):
        if answers:
            break
        world.turn(calm=True)
    return answers[0] if answers else None


def scripted(make_world: Callable[..., World]) -> tuple[World, Scripted, Client]:
    world = make_world(Scripted, {}, 1)
    driver: Any = world.runtime.driver
    return world, driver, world.open(0, range(6), exclusive=False)


def test_readings_that_are_no_measurement_are_left_out(make_world: Callable[..., World]) -> None:
    world, driver, client = scripted(make_world)
    driver.script = [(3.0, 0), (900.0, 0), (777.0, INVALID), (math.nan, 0), (5.0, 0), (4.0, 0)]
    assert asked(world, client, 4) == pytest.approx([4.0] * 6)
    assert client.node.read().data[0] == 0.0


@pytest.mark.parametrize("flags, value", [(INVALID, 1.0), (SATURATED, 1.0), (0, 10.0), (0, math.nan)])
def test_a_blind_sensor_refuses(make_world: Callable[..., World], flags: int, value: float) -> None:
    world, driver, client = scripted(make_world)
    assert asked(world, client, 3) == [2.0] * 6
    driver.script = [(value, flags)]
    for samples, said in ((1, "1 readings of 1"), (4, "4 readings of 4")):
        answer = asked(world, client, samples)
        assert isinstance(answer, OSError) and answer.errno == errno.EIO
        assert said in str(answer) and "fx, fy" in str(answer) and "offset stays as it was" in str(answer)
    driver.script = [(2.0, 0)]
    world.turn(calm=True)
    assert client.node.read().data[0] == 0.0


def test_a_lost_zero_is_found_again_channel_by_channel(make_world: Callable[..., World]) -> None:
    """The readings are INVALID only for want of a zero; the new one may be the old one."""
    world, driver, client = scripted(make_world)
    one = world.open(0, [0], exclusive=False)
    assert asked(world, client, 2) == [2.0] * 6
    driver.block.lose_zero("the power was off")
    world.turn(calm=True)
    assert list(client.node.read().flags) == [INVALID] * 6
    driver.script = [(2.0, INVALID)]
    assert isinstance(asked(world, client, 2), OSError)  # this is no measurement at all
    driver.script = [(2.0, 0)]
    assert asked(world, one, 2) == [2.0]
    assert list(client.node.read().flags) == [0, *[INVALID] * 5] and "zero lost" in driver.block.status
    assert asked(world, client, 2) == [2.0] * 6
    assert not any(client.node.read().flags) and driver.block.status == "ok"


def test_samples_that_were_on_their_way_do_not_count(make_world: Callable[..., World]) -> None:
    """A device is tared; samples from before lie in the line when a zero is asked for, and come after it."""
    world = make_world(Pushing, {}, 3, Device(random.Random(2), pushes=True))
    device = DEVICE[-1]
    client = world.open(0, [0], exclusive=False)
    for value in range(1, 30):
        before = device._heard = b""
        while before.count(b"\n") < 3:
            device.work()
            before = device._heard
        device.tare = value  # what is measured from now on
        assert asked(world, client, 2, 400) == [float(value)]
        assert client.node.read().data[0] == 0.0


def test_a_fingers_zero_is_answered_when_it_is_in_force(make_world: Callable[..., World]) -> None:
    """What is read after the answer counts from the new baseline; who touches is refused."""
    table = {
        "force_node": "hand.force", "angle_rad": 1.4, "noise": 0.023, "finger": {"gain": 3.0},
        "shape": {"finger_file": FINGER}, "tick_hz": 1000.0,
    }  # fmt: skip
    world = make_world(SimTactile, table, 1)
    force = [0.0]

    class Hand:
        stamp_ns = 0

        def read(self, now_ns: int) -> Any:
            return {"value": np.array([force[0]])}

    world.runtime.inputs["hand.force"] = Hand()  # type: ignore[index]
    client = world.open(2, range(16), exclusive=False)
    strain = world.open(1, range(16), exclusive=False)
    for _ in range(30):
        world.turn(calm=True)
    ticks = world.ticks
    assert asked(world, client, 20, 100) == [0.0] * 16
    assert world.ticks - ticks >= 20
    force[0] = 1.0
    for _ in range(5):
        world.turn(calm=True)
    assert client.node.read().data[0] == 1.0
    answer = asked(world, client, 20)
    assert isinstance(answer, OSError) and answer.errno == errno.EBUSY and "it is touched (" in str(answer)
    driver: Any = world.runtime.driver
    driver._array.offset += 1.5  # all have a new offset: a step of all, and an answer is what shows it
    force[0] = 0.0
    for _ in range(5):
        world.turn(calm=True)
    driver._array.offset[:8] += 0.02
    assert asked(world, strain, 200, 400) == [0.0] * 16
    assert abs(client.node.read().data[2]) < 1e-9 and abs(sum(strain.node.read().data)) < 16e-3
