"""What a driver does for its clients is bounded per tick, and nobody waits for another's turn."""

import random
from collections.abc import Iterator

import pytest
from own_writes_rig import CLOCK, World, own_time

from sioms.drivers.sim_axes import SimAxes
from sioms.protocol.flags import ControlMode
from sioms.protocol.records import AXIS_WRITE, AXIS_WRITE_FIELDS


@pytest.fixture
def world() -> Iterator[World]:
    made: list[World] = []
    with own_time(made):
        axis = {"position_min": -1.0, "position_max": 1.0, "velocity_max": 0.5, "acceleration_max": 5.0}
        axes = [{"name": f"a{i}", **axis, "motor": {"mass": 1.0}, "force_max": 60.0} for i in range(8)]
        made.append(World(SimAxes, {"axis": axes}, random.Random(1)))
        yield made[0]
        made[0].clients = [c for c in made[0].clients if c.node.handle in made[0].runtime.clients.handles]
        made[0].close()


def jog() -> bytes:
    """Return the record of a velocity."""
    given = {"control_mode": int(ControlMode.VELOCITY), "velocity": 0.1}
    return AXIS_WRITE.pack(*(given.get(name, 0) for name, _ in AXIS_WRITE_FIELDS))


def test_all_leases_that_have_run_out_end_in_one_tick(world: World) -> None:
    clients = [world.open(0, [i], exclusive=True) for i in range(8)]
    for client in clients:
        client.write(jog(), replace=True)
        handle = world.runtime.clients.handles[client.node.handle]
        handle.lease_ns = 50_000_000
        world.runtime.clients._leased.append(handle)
    world.tick()
    assert len(world.runtime.clients.handles) == 8
    CLOCK.now_ns += 100_000_000
    world.tick()
    assert not world.runtime.clients.handles
