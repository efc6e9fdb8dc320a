"""Grbl: the driver under the real daemon against a simulated controller, on a serial line and on TCP."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from daemon_rig import at_rest, raises, wait_for
from wire_rig import Misfit, Wire, check_misfits

from sioms.protocol.flags import AxisStatus

CONFIG = """
[device.mod0]
driver = "grbl"
line = { serial = "{port}" }
version = "1.1"
poll_hz = 25.0
quick_stop = "reset"
homing = true
[[device.mod0.axis]]
name = "x"
letter = "X"
position_min = -0.2
position_max = 0.2
velocity_max = 0.1
acceleration_max = 0.5
[[device.mod0.axis]]
name = "z"
letter = "Z"
velocity_max = 0.1
acceleration_max = 0.5
"""


def unlock(node: Any) -> None:
    """Reset until the controller's alarm is gone."""

    def good() -> bool:
        try:
            node.reset()
        except BlockingIOError:  # the alarm has come behind it
            return False
        time.sleep(0.1)
        return not any(s & (AxisStatus.FAULT | AxisStatus.EMERGENCY_STOP) for s in node.read().status)

    wait_for(good, "unlocked")


def test_moves_stops_homes_and_alarms(start: Callable[..., Any], short_folder: Path) -> None:
    wire = Wire(start, short_folder, "grbl.simulator")
    cell = wire.serve(CONFIG)
    wire.wait_up("mod0.x")
    with cell.open("mod0", "rw") as both:
        # locked after power-up: homing is the way out, of all axes, and the line stays served meanwhile
        both.home()
        wait_for(lambda: wire.state("state") == "Home", "homing")
        number = both.read().number
        both.wait_until_idle(20.0)
        assert both.read().number > number + 3
        assert all(s & AxisStatus.HOMED for s in both.read().status)
        assert both.read().position == pytest.approx([-0.001, -0.001])
        # two axes released together go on one straight line
        both.command(position=0.02, synch=True)
        both.command(1, position=-0.04, synch=True)
        both.synch()
        wait_for(lambda: wire.state("velocity") > 0, "motion")
        x, _, z = wire.state("position")
        assert (z + 1) / (x + 1) == pytest.approx(-39 / 21, rel=0.01)
        both.wait_until_idle(10.0)
        assert both.read().position == pytest.approx([0.02, -0.04], abs=2e-6)
        with raises(22, "cannot do FORCE"):
            both.command(force=1.0)
        with raises(22, "cannot do"):
            both.command(position=0.0, max_velocity=0.01, max_acceleration=0.1)
    with cell.open("mod0.x", "rw") as x, cell.open("mod0.z", "rw") as z:
        # what is stopped is one axis: the other brakes with it, and goes on to its target by itself
        x.move(-0.05)
        z.move(-0.03)
        wait_for(lambda: wire.state("velocity") > 50, "motion")
        x.stop()
        z.wait_until_idle(8.0)
        assert z.read().position[0] == pytest.approx(-0.03, abs=2e-6)
        assert -0.04 < x.read().position[0] < 0.03
        # and so does a velocity
        x.command(velocity=-0.03)
        wait_for(lambda: wire.state("velocity") > 28, "motion")
        z.command(velocity=-0.04)
        wait_for(lambda: wire.state("velocity") > 45, "both")
        z.stop()
        at_rest(z)
        place = z.read().position[0]
        wait_for(lambda: x.read().velocity[0] < -0.028, "going on", 2.0)
        x.stop()
        at_rest(x)
        assert z.read().position[0] == pytest.approx(place, abs=1e-5)
        assert not any(node.read().status[0] & AxisStatus.FAULT for node in (x, z))
    with cell.open("mod0.x", "rw") as x:
        # a velocity is a chain of jogs without gaps, and ends at the soft limit by itself
        x.move(-0.04)
        x.wait_until_idle(10.0)
        x.command(velocity=0.08)
        wait_for(lambda: x.read().position[0] > -0.01, "motion")
        speeds = []
        while x.read().position[0] < 0.06:
            speeds.append(wire.state("velocity"))
        assert min(speeds) > 79 and max(speeds) < 81, (min(speeds), max(speeds))
        began = wire.state("position")[0]
        x.stop()
        rested = at_rest(x)
        assert wire.state("state") == "Idle" and rested < 1.0
        assert 0 < wire.state("position")[0] - began < 25
        x.command(velocity=0.1)
        wait_for(lambda: x.read().position[0] > 0.12, "motion")
        at_rest(x)
        # Never beyond 0.2. The guard brakes two polls and the line's way early: 10 mm here, and 10 more for late polls.
        assert 0.18 < x.read().position[0] <= 0.2
        # a command replaces the one that runs
        x.move(0.0)
        wait_for(lambda: x.read().position[0] < 0.175, "motion")
        x.move(0.19, replace=True)
        x.wait_until_idle(10.0)
        assert x.read().position[0] == pytest.approx(0.19, abs=2e-6)
        # emergency stop: at once, and the position is lost, which is said
        x.command(velocity=-0.1)
        wait_for(lambda: wire.state("velocity") > 90, "motion")
        x.stop_all()
        wait_for(lambda: wire.state("velocity") == 0, "rest", 1.0)
        wait_for(lambda: x.read().status[0] & AxisStatus.FAULT, "the alarm")
        assert wire.state("position") != wire.state("real")
        assert not x.read().status[0] & AxisStatus.HOMED
        with raises(1, "RESET"):
            x.move(0.0)
        unlock(x)
        # an alarm that comes unasked is named
        x.command(velocity=-0.05)
        wait_for(lambda: wire.state("velocity") > 40, "motion")
        wire.tell("alarm 1")
        wait_for(lambda: x.read().status[0] & AxisStatus.FAULT, "the alarm")
        with raises(5, "hard limit switch; the position is lost"):
            x.move(0.0)
        unlock(x)
        with cell.open("mod0.z", "rw") as z:
            unlock(z)
        # a homing that is stopped
        x.home()
        wait_for(lambda: wire.state("state") == "Home", "homing")
        x.stop_all()
        wait_for(lambda: wire.state("state") == "Alarm", "the end of homing", 1.0)
        unlock(x)
        # a door
        wire.tell("door")
        wait_for(lambda: x.read().status[0] & AxisStatus.FAULT, "the door")
        with raises(5, "safety door"):
            x.move(0.0)


def test_what_a_controller_does_while_nobody_looks_is_told(start: Callable[..., Any], short_folder: Path) -> None:
    wire = Wire(start, short_folder, "grbl.simulator", "--tcp", "0", "--no-homing", "--hal")
    cell = wire.serve(CONFIG.replace('serial = "{port}"', 'tcp = "{port}"').replace("homing = true", ""))
    wire.wait_up("mod0.x")
    with cell.open("mod0.x", "rw") as x:
        # unplugged and back; somebody else's program is ended with its position kept
        wire.tell("unplug")
        wait_for(lambda: not wire.reads("mod0.x"), "the loss")
        wire.tell("program 100 600")
        wire.tell("set 13 1")  # and it tells inches and work positions from now on
        wire.tell("set 10 0")
        wire.tell("plug")
        wire.wait_up("mod0.x")
        wait_for(lambda: wire.state("state") == "Idle", "the program's end")
        assert wire.state("position") == wire.state("real")
        # it moved while nobody looked: somebody must say that its place is right
        x.reset()
        with raises(1, "position lost"):
            x.move(0.0254)
        x.calibrate(wire.state("position")[0] / 1000)
        x.move(0.0254)
        x.wait_until_idle(10.0)
        assert wire.state("position")[0] == pytest.approx(25.4, abs=0.003)
        assert x.read().position[0] == pytest.approx(0.0254, abs=3e-5)
        # the supply fails in motion, for less than the link takes to be lost: told, and nothing goes on
        x.command(velocity=0.05)
        wait_for(lambda: wire.state("velocity") > 40, "motion")
        wire.tell("power_cycle 0.05")

        def place_is_lost() -> bool:
            try:
                return bool(x.read().status[0] & AxisStatus.POSITION_LOST)
            except OSError:  # between the loss and the reopening
                return False

        wait_for(place_is_lost, "the loss", 5.0)
        wait_for(lambda: wire.state("velocity") == 0, "rest")
        assert abs(wire.state("position")[0]) < 5.0  # a jog that had left before the greeting came is cancelled
        x.reset()
        with raises(1, "HOME it"):
            x.move(0.01)
        wait_for(lambda: not x.read().in_motion[0], "the end of the stop")
        x.calibrate(0.0)


def test_limits_that_differ(start: Callable[..., Any], short_folder: Path) -> None:
    misfits = (
        Misfit("velocity_max = 0.1, but $110 of the controller is 0.05", change="set 110 3000"),
        Misfit("acceleration_max = 0.5, but $122 of the controller is 0.1", change="set 122 100"),
    )
    check_misfits(start, short_folder, "grbl.simulator", CONFIG, misfits)
