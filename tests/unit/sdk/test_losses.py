"""Whose end is known at once: the owner's of all axes of a device, and the daemon's."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import pytest
from own_writes_rig import Client, World, worlds

from sioms.client.command import command
from sioms.drivers.sim.axes import SimAxes

AXIS = {"velocity_max": 0.5, "acceleration_max": 5.0, "force_max": 40.0, "motor": {"mass": 2.0, "viscous": 4.0}}


@pytest.fixture
def world() -> Iterator[World]:
    with worlds() as make:
        yield make(SimAxes, {"axis": [AXIS | {"name": "a"}, AXIS | {"name": "b"}]}, 1)


def fd_of(world: World, client: Client) -> int:
    return world.runtime.clients.handles[client.node.handle].sock.fileno()


def losses(world: World, *fds: int) -> list[Callable[[], None]]:
    return world.runtime.losses(fds)


def test_the_end_of_the_owner_of_all_axes_stops_them(world: World) -> None:
    owner = world.open(0, [0, 1], exclusive=True)
    owner.write(command(0, velocity=0.1) + command(1, velocity=0.1))
    for _ in range(60):
        world.tick()
    fd, bank = fd_of(world, owner), world.runtime.blocks[0].bank
    assert losses(world, fd) == [] and (bank.rows["commanded_velocity"] > 0.09).all()
    owner.channel._sock.send(b"what it has sent is taken before its end")
    owner.channel.close()
    assert losses(world, fd) == []
    world.runtime.clients.handles[owner.node.handle].sock.recv(100)
    (lose,) = losses(world, fd)
    lose()
    assert owner.node.handle not in world.runtime.clients.handles and losses(world, fd) == []
    for _ in range(200):
        world.tick()
    assert not bank.rows["commanded_velocity"].any()
    world.clients.remove(owner)


@pytest.mark.parametrize(
    ("channels", "exclusive", "halted"), [([0], True, False), ([0, 1], False, False), ([0, 1], True, True)]
)
def test_no_other_end_is_known_at_once(world: World, channels: list[int], exclusive: bool, halted: bool) -> None:
    client = world.open(0, channels, exclusive=exclusive)
    fd = fd_of(world, client)
    world.runtime.clients.handles[client.node.handle].halted = halted
    client.channel.close()
    assert losses(world, fd) == []


def test_the_end_of_the_daemon_is(world: World) -> None:
    control = world.runtime._control
    assert losses(world, control.fileno()) == []
    world.control.close()
    (lose,) = losses(world, control.fileno())
    lose()
    assert world.runtime._ending_ns
