"""A mistake of ours in a request that waits costs its handle, which halts what it owns, and nobody else's."""

from __future__ import annotations

import random
from collections.abc import Iterator
from typing import Any

import pytest
from own_writes_rig import World, own_time

from sioms.drivers.sim.axes import SimAxes
from sioms.protocol.flags import ControlMode, NodeClass
from sioms.protocol.records import AXIS_WRITE, WRITE
from sioms.sdk.writing import AxesWrite

AXIS = {"velocity_max": 0.5, "acceleration_max": 5.0, "motor": {"mass": 1.0}, "force_max": 60.0}


@pytest.fixture
def world() -> Iterator[World]:
    made: list[World] = []
    with own_time(made):
        axes = [{"name": name, **AXIS} for name in "xy"]
        made.append(World(SimAxes, {"axis": axes}, random.Random(1)))
        yield made[0]
        made[0].close()


def _jog(count: int = 1) -> bytes:
    fields = {"control_mode": int(ControlMode.VELOCITY), "velocity": 0.1}
    return AXIS_WRITE.pack(*(fields.get(name, 0) for name in WRITE[NodeClass.AXIS])) * count


def test_a_write_that_fails_while_it_waits_ends_its_handle_alone(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    one, other = world.open(0, [0], exclusive=True), world.open(0, [1], exclusive=True)
    answers: list[Any] = []
    for client in (one, other):
        client.write(_jog(), answers.append)
    for _ in range(300):
        world.tick()
    assert one.node.read().velocity[0] > 0.09

    def fail(_: AxesWrite) -> bool:
        raise ValueError("a plan that cannot be")

    world.runtime._spare_until_ns = 0  # no time is left in this period: what is long waits
    one.write(_jog(40), answers.append)
    monkeypatch.setattr(AxesWrite, "step", fail)
    world.tick()
    one.take()
    assert "a plan that cannot be" in answers[-1].strerror
    monkeypatch.undo()
    world.serve(one)  # the end of its file
    assert [*world.runtime.clients.handles] == [other.node.handle] and world.runtime.running
    world.clients.remove(one)
    one.node.release()
    for _ in range(500):
        world.tick()
    rows = world.runtime.blocks[0].bank.rows  # type: ignore[attr-defined]
    assert rows["commanded_velocity"].tolist() == [0.0, pytest.approx(0.1)]
