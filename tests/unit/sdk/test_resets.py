"""A reset that is based on a reading undoes nothing that came after it."""

from __future__ import annotations

import errno
import random
import time
from collections.abc import Iterator
from typing import Any

import pytest
from own_writes_rig import CLOCK, Client, World, own_time

from sioms.drivers.sim.axes import SimAxes
from sioms.protocol.driver_verbs import DriverVerb
from sioms.protocol.flags import AxisStatus, Request

X = {"name": "x", "velocity_max": 0.5, "acceleration_max": 5.0, "motor": {"mass": 1.0}, "force_max": 60.0}
LATCHED = AxisStatus.EMERGENCY_STOP | AxisStatus.FAULT


@pytest.fixture
def world() -> Iterator[World]:
    made: list[World] = []
    with own_time(made):
        made.append(World(SimAxes, {"axis": [X]}, random.Random(1)))
        yield made[0]
        made[0].close()


def _stop(world: World) -> int:
    """Stop the axis by an order of the daemon; return when it was done [ns]."""
    world.order(DriverVerb.NODE_STOP, 0, [0], -1, "eva", world.latch.resets, CLOCK())
    world.runtime.heed()
    return time.monotonic_ns()


def _reset(client: Client, until_ns: Any) -> int | None:
    """Ask for a reset; return the errno of its refusal."""
    answers: list[Any] = []
    client.ioctl(Request.RESET, until_ns, answers.append)
    (answer,) = answers
    return answer.errno if isinstance(answer, OSError) else None


def _is_latched(world: World) -> bool:
    world.tick()
    return bool(int(world.runtime.blocks[0].bank.rows["status"][0]) & LATCHED)  # type: ignore[attr-defined]


def test_a_stop_that_came_after_the_reading_stays(world: World) -> None:
    client = world.open(0, [0], exclusive=True)
    seen_ns = CLOCK()
    stopped_ns = _stop(world)
    assert _reset(client, seen_ns) == errno.EAGAIN
    assert _is_latched(world)
    assert _reset(client, stopped_ns) is None
    assert not _is_latched(world)


def test_a_second_stop_of_what_is_stopped_already_stays_too(world: World) -> None:
    client = world.open(0, [0], exclusive=True)
    seen_ns = _stop(world)
    _stop(world)
    assert _reset(client, seen_ns) == errno.EAGAIN
    assert _reset(client, None) is None


def test_a_fault_that_came_after_the_reading_stays(world: World) -> None:
    client = world.open(0, [0], exclusive=True)
    seen_ns = _stop(world)
    world.runtime.blocks[0].bank.fault([0], "it jams", CLOCK())  # type: ignore[attr-defined]
    assert _reset(client, seen_ns) == errno.EAGAIN
    assert _is_latched(world)


def test_what_has_been_reset_since_is_in_nobodys_way(world: World) -> None:
    client = world.open(0, [0], exclusive=True)
    seen_ns = CLOCK()
    _stop(world)
    assert _reset(client, None) is None
    assert _reset(client, seen_ns) is None


@pytest.mark.parametrize("until_ns", [-1, 1.5, "now", True])
def test_what_is_no_instant_is_refused(world: World, until_ns: Any) -> None:
    client = world.open(0, [0], exclusive=True)
    _stop(world)
    assert _reset(client, until_ns) == errno.EINVAL
    assert _is_latched(world)
