"""Stops of held axes: none that comes after a reset is undone by it, and a device that takes no orders is stopped."""

from __future__ import annotations

import errno
import time
from collections.abc import Callable

from daemon_rig import Daemon, axes, raises, reads, wait_for

import sioms
from sioms.protocol.flags import AxisStatus

CELL = """
[workcell]
name = "slits"
{blades}
[device.slits]
driver = "slits"
axes = ["blades"]
lease_s = 0.5
late_max_s = 0.5
history = 4096
[[device.slits.axis]]
name = "centre"
velocity_max = 0.2
acceleration_max = 4.0
[[device.slits.axis]]
name = "gap"
velocity_max = 0.2
acceleration_max = 4.0
"""
STOPPED = int(AxisStatus.EMERGENCY_STOP)


DEAF = """
from pathlib import Path
from sioms.drivers.sim.axes import SimAxes

class Deaf(SimAxes):
    def tick(self, now_ns):
        if (Path(__file__).parent / "deaf").exists():
            self.kit.turns.serve = lambda: None
            self.kit.clients.check_leases = lambda now_ns: None
        super().tick(now_ns)

DRIVER = Deaf
"""
"""Axes that go on ticking and publishing but serve no handle any more, nor look at a lease."""


def _latched(node: sioms.Node) -> int:
    status = node.read().status
    return int(status[0] & status[1]) & STOPPED


def _is_barred(node: sioms.Node) -> bool:
    return bool(int(node.read().status[0]) & (AxisStatus.FAULT | STOPPED))


def _stands(node: sioms.Node) -> bool:
    return bool(max(map(abs, node.read().velocity)) < 1e-3)


def test_a_stop_after_a_reset_stays_however_soon_it_comes(start_daemon: Callable[..., Daemon]) -> None:
    daemon = start_daemon(CELL.format(blades=axes("blades", "minus", "plus")))
    with daemon.cell() as cell, daemon.cell() as other:
        daemon.wait_up("slits")
        slits, blades = cell.open("slits", "rw"), cell.open("blades.readonly", "r")
        wait_for(lambda: reads(slits), "the slits have found their blades", 5.0)
        lost = []
        for trial in range(12):
            stop_first = (cell.emergency_stop_workcell, lambda: cell.emergency_stop("blades"))[trial % 2]
            reset = (cell.reset, slits.reset)[trial % 2]
            stop_first()
            wait_for(lambda: _latched(blades) and _is_barred(slits), "stop", 5.0)
            reset()
            time.sleep((0.0, 0.001, 0.005, 0.02, 0.05, 0.1)[trial // 2 % 6])
            other.emergency_stop("blades", f"trial {trial}")
            time.sleep(0.15)
            if not _latched(blades):
                lost.append(trial)
            slits.reset()
            wait_for(lambda: not _latched(blades), "reset", 5.0)
            wait_for(lambda: not _is_barred(slits), "reset", 5.0)
            time.sleep(0.02)
        assert not lost
        assert _stands(blades)


def test_a_held_device_that_ticks_but_takes_no_orders_is_stopped_and_said_to_be_so(
    start_daemon: Callable[..., Daemon],
) -> None:
    blades = axes("blades", "minus", "plus").replace('"sim-axes"', '"./deaf.py"\nrealtime_priority = 50')
    daemon = start_daemon(CELL.format(blades=blades), files={"deaf.py": DEAF})
    with daemon.cell() as cell:
        daemon.wait_up("slits")
        slits, blades = cell.open("slits", "rw"), cell.open("blades.readonly", "r")
        wait_for(lambda: reads(slits), "the slits have found their blades", 5.0)
        slits.write([sioms.command(0, velocity=0.1)])
        wait_for(lambda: blades.read().velocity[1] > 0.09, "motion", 5.0)
        (daemon.folder / "deaf").touch()
        wait_for(lambda: _stands(blades), "stopped motion", 3.0)
        daemon.said("emergency stop.*blades.*unanswered|emergency stop.*blades.*does not take")
        with raises(errno.EIO, "slits"):
            slits.write([sioms.command(0, velocity=0.1)])
        assert _latched(blades)
