"""The motion watch under the real daemon: what a drive does by itself ends in a stop and a fault, what clients do does
not.
"""

from __future__ import annotations

import errno
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from daemon_rig import raises, wait_for
from wire_rig import SLIDE, Wire

from sioms.protocol.flags import AxisStatus

MODULE = """
[device.mod0]
driver = "tmcl"
line = { serial = "{port}", baud = 115200 }
module = 1140
poll_hz = 50.0
[[device.mod0.axis]]
name = "x"
motor = 0
travel_per_turn = 0.01
microsteps_per_turn = 51200
velocity_max = 0.1
acceleration_max = 1.0
position_min = -0.3
position_max = 0.3
"""
PER_M = 51200 / 0.01
IN_TIME_S = 1.0
"""What a loaded machine takes for what takes 40 ms; the unit tests count polls."""


def faults(axis: Any, *words: str) -> float:
    """Wait for a fault that a write tells with these words; return how long it took [s]."""
    began = time.monotonic()
    wait_for(lambda: axis.read().status[0] & AxisStatus.FAULT, f"the fault: {words}", IN_TIME_S)
    took_s = time.monotonic() - began
    with raises(errno.EIO, *words):
        axis.move(0.0)
    return took_s


def is_lost(axis: Any) -> bool:
    """Tell whether an axis reads that it has lost its place; while its link is lost it reads nothing."""
    try:
        return bool(axis.read().status[0] & AxisStatus.POSITION_LOST)
    except OSError:
        return False


def clear(axis: Any) -> None:
    axis.reset()
    wait_for(lambda: not axis.read().status[0] & AxisStatus.FAULT, "the reset")


def test_motion_that_nobody_commanded_is_stopped_and_told(start: Callable[..., Any], short_folder: Path) -> None:
    wire = Wire(start, short_folder, "tmcl.simulator", "--motors", "1", "--baud", "115200")
    cell = wire.serve(MODULE)
    wire.wait_up("mod0")
    with cell.open("mod0", "rw") as axis:
        # moves, replaced and stopped ones, velocities, a stop of the workcell: none of it is a finding
        for target in (0.02, -0.01, 0.0):
            axis.move(target, timeout=1.0)
            axis.wait_until_idle(5.0)
        axis.move(0.2)
        wait_for(lambda: axis.read().velocity[0] > 0.08, "speed")
        axis.move(-0.05, replace=True)
        axis.wait_until_idle(8.0)
        axis.jog(0.1)
        wait_for(lambda: axis.read().velocity[0] > 0.09, "speed")
        cell.emergency_stop()
        wait_for(lambda: wire.state("velocity") == 0, "rest")
        cell.reset()
        axis.jog(-0.1)
        time.sleep(0.3)
        axis.stop()
        axis.wait_until_idle(3.0)
        time.sleep(0.6)
        assert not axis.read().status[0] & AxisStatus.FAULT
        # another master lets the motor turn
        wire.tell(f"foreign velocity {0.05 * PER_M}")
        print(f"uncommanded: {faults(axis, 'axis x moves though nothing was commanded'):.3f} s")
        wait_for(lambda: wire.state("velocity") == 0, "rest", IN_TIME_S)
        clear(axis)
        # a board that is faster than its limit
        axis.jog(0.1)
        time.sleep(0.3)
        wire.tell(f"shove {0.25 * PER_M}")
        print(f"too fast: {faults(axis, 'axis x moves at', 'velocity_max is 0.1 m/s'):.3f} s")
        wire.tell("shove 0")


def test_a_place_that_is_lost_takes_no_positions_until_it_is_found(
    start: Callable[..., Any], short_folder: Path
) -> None:
    wire = Wire(start, short_folder, "modbus.simulated.leadshine", "--units", "1")
    cell = wire.serve(SLIDE)
    wire.wait_up("slide0")
    with cell.open("slide0", "rw") as axis:
        axis.move(0.05, timeout=1.0)
        axis.wait_until_idle(5.0)
        wire.tell("power_cycle 0.3")
        wait_for(lambda: is_lost(axis), "the lost place", 15.0)
        wait_for(lambda: wire.reads("slide0"), "the link")
        clear(axis)
        with raises(errno.EPERM, "position lost", "CALIBRATE_DEVICE"):
            axis.move(0.04)
        axis.calibrate(0.05)
        axis.move(0.04, timeout=1.0)
        axis.wait_until_idle(5.0)
        assert abs(axis.read().position[0] - 0.04) < 1e-4
