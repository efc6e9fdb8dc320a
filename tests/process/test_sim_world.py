"""The simulated plane among real processes: what leans on a killed world stops, and goes on with the next one."""

from __future__ import annotations

import errno
import os
import signal
from collections.abc import Callable

from daemon_rig import Daemon, reads, wait_for

import sioms
from sioms.client.snapshot import AxisSnapshot
from sioms.protocol.flags import AxisStatus

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


def test_a_killed_world_stops_the_axes_that_lean_on_it(start_daemon: Callable[..., Daemon]) -> None:
    daemon = start_daemon(CELL)
    with daemon.cell() as cell:
        axis = cell.open("mod0.x", "rw")
        wait_for(lambda: reads(axis), "the axes have found their world")
        wait_for(lambda: _goes_to(axis, 0.003), "the finger to press")
        with cell.open("world.left.normal") as normal:
            assert 0.5 < float(normal.read().data[0]) < 12.0
        axis.command(position=-0.1, time=5.0)
        before = daemon.device("world")
        os.kill(before["pid"], signal.SIGKILL)
        try:
            axis.wait_until_idle(5.0)
        except OSError as error:  # none where it is in fault before the request comes
            assert error.errno == errno.EIO and "mod0" in str(error) and "world.left" in str(error)
        wait_for(lambda: _rests(axis.read()), "the axis to rest")
        daemon.running.wait_line('device=mod0 text="fault of x, y, th: world.left')
        daemon.wait_up("world", before["generation"] + 1)
        assert _rests(axis.read())
        wait_for(lambda: _goes_to(axis, 0.0), "the axis to go on in the next world")


def _rests(shot: AxisSnapshot) -> bool:
    """Tell whether an axis is in fault and nothing of it moves."""
    return bool(shot.status[0] & AxisStatus.FAULT) and not (shot.commanded_velocity[0] or shot.velocity[0])


def _goes_to(axis: sioms.AxisNode, position: float) -> bool:
    try:
        axis.reset()  # the loss left a fault
        axis.move(position)
        axis.wait_until_idle(10.0)
    except OSError:  # the world does not know all its axes yet
        return False
    return not axis.read().status[0] & AxisStatus.FAULT
