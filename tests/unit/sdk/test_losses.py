"""Whose end is known at once: the owner's of all axes of a device, and the daemon's."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from own_writes_rig import Client, World, worlds

from sioms.client.command import command
from sioms.descriptors import is_exiting, process_of
from sioms.drivers.sim.axes import SimAxes

EXIT = {"x86_64": 60, "aarch64": 93}
"""Number of the system call that ends one thread."""
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


def test_the_owner_of_all_axes_is_known_by_his_process(world: World) -> None:
    owner = world.open(0, [0, 1], exclusive=True)
    handle = world.runtime.clients.handles[owner.node.handle]
    handle.pid = 7
    assert world.runtime.losses_of(8) == [] and len(world.runtime.losses_of(7)) == 1
    owner.channel._sock.send(b"a stop, for all that is known")
    assert world.runtime.losses_of(7) == [], "what it has sent is taken before its end"
    handle.sock.recv(100)
    (lose,) = world.runtime.losses_of(7)
    assert not world.runtime.exiting([handle.sock.fileno()]), "it has not gone"
    lose()
    assert owner.node.handle not in world.runtime.clients.handles
    world.clients.remove(owner)


def test_a_process_that_is_about_to_end_is_known(world: World) -> None:
    owner, process = world.open(0, [0, 1], exclusive=True), subprocess.Popen(["sleep", "60"])
    bystander = process.pid
    pidfd = os.pidfd_open(bystander)
    assert process_of(pidfd) == bystander and process_of(-1) == process_of(0) == 0
    handle = world.runtime.clients.handles[owner.node.handle]
    handle.pid = bystander
    owner.channel.close()
    world.clients.remove(owner)
    assert losses(world, handle.sock.fileno()) and not world.runtime.exiting([handle.sock.fileno()]), "it has closed"
    process.kill()
    os.waitid(os.P_PIDFD, pidfd, os.WEXITED | os.WNOWAIT)
    assert is_exiting(bystander) and world.runtime.exiting([handle.sock.fileno()]) == bystander
    process.wait()
    assert not is_exiting(bystander) and process_of(pidfd) == 0
    os.close(pidfd)


def test_a_process_whose_first_thread_has_ended_alone_is_not_about_to_end() -> None:
    code = (
        "import ctypes, threading, time; threading.Thread(target=lambda: time.sleep(30)).start(); print(flush=True); "
        f"ctypes.CDLL(None).syscall({EXIT[os.uname().machine]}, 0)"
    )
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        process.stdout.readline()
        status, until_s = Path(f"/proc/{process.pid}/stat"), time.monotonic() + 10.0
        while status.read_text().rpartition(")")[2].split()[0] != "Z" and time.monotonic() < until_s:
            time.sleep(0.01)
        assert status.read_text().rpartition(")")[2].split()[0] == "Z" and not is_exiting(process.pid)
        process.kill()


def test_the_end_of_the_daemon_is(world: World) -> None:
    control = world.runtime._control
    assert losses(world, control.fileno()) == []
    world.control.close()
    (lose,) = losses(world, control.fileno())
    lose()
    assert world.runtime._ending_ns
