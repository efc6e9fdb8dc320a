"""The simulated plane among real processes: what leans on a killed world stops, and goes on with the next one."""

from __future__ import annotations

import errno
import os
import signal
import time
from collections.abc import Callable

from daemon_rig import Daemon, raises, wait_for

import sioms

AXIS = """
[[device.mod0.axis]]
name = "{0}"
unit = "{1}"
velocity_max = 0.2
acceleration_max = 2.0
force_max = 50.0
bandwidth_hz = 15.0
motor = {{ mass = {2} }}
load_node = "world.left.{0}_load"
"""
CELL = (
    """
[workcell]
name = "plane"
[device.world]
driver = "sim-world"
object = { shape = "disk", radius_m = 0.02, pose = [0.035, 0.0, 0.0], mass = 5.0, platen_friction = 1.0 }
[[device.world.finger]]
name = "left"
axes = ["mod0.plant.x_position", "mod0.plant.y_position", "mod0.plant.th_position"]
mount = { link_m = 0.0, stiffness = 1e5, turn_stiffness = 5.0, mass = 0.3, inertia = 2e-4 }
[device.mod0]
driver = "sim-axes"
"""
    + AXIS.format("x", "m", 2.0)
    + AXIS.format("y", "m", 2.0)
    + AXIS.format("th", "rad", 0.01)
)


def _reads(node: sioms.Node) -> bool:
    try:
        node.read()
    except OSError:
        return False
    return True


def test_a_killed_world_stops_the_axes_that_lean_on_it(start_daemon: Callable[..., Daemon]) -> None:
    daemon = start_daemon(CELL)
    with daemon.cell() as cell:
        axis = cell.open("mod0.x", "rw")
        wait_for(lambda: _reads(axis), "the axes have found their world")
        axis.move(0.003)
        axis.wait_until_idle(10.0)
        with cell.open("world.left.normal") as normal:
            assert 0.5 < float(normal.read().data[0]) < 12.0
        axis.command(position=-0.1, time=5.0)
        before = daemon.device("world")
        os.kill(before["pid"], signal.SIGKILL)
        with raises(errno.EIO, "mod0.x", "world.left"):
            for _ in range(500):
                axis.read()
                time.sleep(0.01)
        daemon.wait_up("world", before["generation"] + 1)
        axis.close()
        with cell.open("mod0.x", "rw", timeout=5.0) as again:
            wait_for(lambda: _reads(again), "the axes have found the next world")
            assert not again.read().in_motion[0]
            again.reset()  # the loss left a fault
            again.move(0.0)
            again.wait_until_idle(10.0)
