"""ODrive: the driver under the real daemon against a simulated board."""

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
driver = "odrive"
line = { serial = "{port}" }
watchdog_s = 1.0
[[device.mod0.axis]]
name = "x"
number = 0
travel_per_turn = 0.01
position_max = 0.1
velocity_max = 0.1
acceleration_max = 0.5
force_max = 400.0
homing = true
[[device.mod0.axis]]
name = "j"
number = 1
unit = "rad"
travel_per_turn = -6.283185307179586
velocity_max = 60.0
acceleration_max = 200.0
force_max = 2.0
"""


def test_moves_torques_homes_and_faults(start: Callable[..., Any], short_folder: Path) -> None:
    wire = Wire(start, short_folder, "odrive.simulator", "--baud", "115200")
    cell = wire.serve(CONFIG)
    wire.wait_up("mod0.x")
    wait_for(lambda: wire.state("state", 0) == 8, "closed loop")
    with cell.open("mod0", "rw") as both:
        both.command(position=0.03)
        both.command(1, position=6.283)
        both.wait_until_idle(8.0)
        assert both.read().position == pytest.approx([0.03, 6.283], abs=0.02)
        assert wire.state("position", 0) == pytest.approx(3.0, abs=0.01)
        assert wire.state("position", 1) == pytest.approx(-1.0, abs=0.01)
    with cell.open("mod0.j", "rw") as j:
        # a torque of 0.2 Nm turns the reversed axis; friction settles it near 1.5 turns/s
        j.command(force=0.2)
        wait_for(lambda: j.read().velocity[0] > 5.0, "the torque to act")
        assert wire.state("torque", 1) == pytest.approx(-0.2)
        j.stop()
        at_rest(j)
        with raises(34, "force"):
            j.command(force=5.0)
    with cell.open("mod0.x", "rw") as x:
        # a velocity ends before the soft limit, along the ramp
        x.command(velocity=0.08)
        wait_for(lambda: x.read().position[0] > 0.07, "motion")
        at_rest(x)
        assert 0.08 < x.read().position[0] <= 0.1
        x.move(0.02)  # homing is slow
        x.wait_until_idle(8.0)
        # the board's own homing, and its loop is closed afterwards
        wire.tell("switch -1")
        x.home()
        x.wait_until_idle(20.0)
        assert x.read().status[0] & AxisStatus.HOMED
        # the board lets go in motion when its homing ends: told is where it has come to rest, its loop closed again
        told, there = x.read(), wire.state("position", 0)
        assert abs(wire.state("velocity", 0)) < 0.02 and wire.state("state", 0) == 8 and not told.in_motion[0]
        assert told.position[0] == pytest.approx(there * 0.01, abs=1e-4)
        assert 1e-3 < abs(told.position[0]) < 8e-3, "it runs on, by less than a turn"
        time.sleep(0.3)
        assert x.read().position[0] == pytest.approx(told.position[0], abs=1e-4)
        x.move(0.02)
        x.wait_until_idle(8.0)
        # emergency stop lets go; after a reset it moves again
        x.command(velocity=0.01)
        wait_for(lambda: wire.state("velocity") > 0.7, "motion")
        x.stop_all()
        wait_for(lambda: wire.state("state") == 1, "idle", 1.0)
        with raises(1, "RESET"):
            x.move(0.0)
        at_rest(x, 12.0)  # it coasts
        x.reset()
        x.move(0.0)
        x.wait_until_idle(8.0)
        assert wire.state("state") == 8
        # an error of the board: named with its details, latched, cleared by reset
        wire.tell("error 0x40")
        wait_for(lambda: x.read().status[0] & AxisStatus.FAULT, "the fault")
        with raises(5, "motor failed; motor.error 0x10"):
            x.move(0.01)
        x.reset()
        wait_for(lambda: not x.read().status[0] & AxisStatus.FAULT, "the reset")
        wait_for(lambda: wire.state("state") == 8, "closed loop")
        x.move(0.01)
        x.wait_until_idle(8.0)


def test_boards_that_do_not_fit(start: Callable[..., Any], short_folder: Path) -> None:
    misfits = (
        Misfit("counts positions in encoder counts", ("--version", "0.4.12")),
        Misfit("vel_limit is 2", change="set axis1.controller.config.vel_limit 2"),
        Misfit("encoder failed", change="error 0x100 1", axis="j"),
    )
    check_misfits(start, short_folder, "odrive.simulator", CONFIG, misfits)


def test_nothing_left_in_the_board_moves_it_and_a_restart_is_told(
    start: Callable[..., Any], short_folder: Path
) -> None:
    wire = Wire(start, short_folder, "odrive.simulator", "--baud", "115200", "--friction", "0.5")
    cell = wire.serve(CONFIG)
    wire.wait_up("mod0.x")

    def stands(seconds: float, after: str) -> None:
        place, until = wire.state("place", 0), time.monotonic() + seconds
        while time.monotonic() < until:
            assert abs(wire.state("velocity", 0)) < 0.05, after
        assert wire.state("place", 0) == pytest.approx(place, abs=0.02), after

    with cell.open("mod0.x", "rw") as x:
        x.command(velocity=0.05)
        wait_for(lambda: wire.state("velocity", 0) > 4, "motion")
        wire.tell("unplug")
        wait_for(lambda: wire.state("state", 0) == 1, "idle by the watchdog", 3.0)
        wait_for(lambda: abs(wire.state("velocity", 0)) < 0.01, "rest", 5.0)
        wire.tell("plug")
        wire.wait_up("mod0.x")
        stands(0.5, "replugged")
        assert wire.state("state", 0) == 1, "a fault is latched"
        x.reset()
        wait_for(lambda: wire.state("state", 0) == 8, "closed loop")
        stands(0.5, "reset")
        # the move begins where the axis is, not where the velocity run began
        place = wire.state("place", 0)
        x.move(x.read().position[0] + 0.01)
        lowest = place
        until = time.monotonic() + 5.0
        while (here := wire.state("place", 0)) < place + 0.98 and time.monotonic() < until:
            lowest = min(lowest, here)
        assert lowest > place - 0.01 and here == pytest.approx(place + 1, abs=0.03)
        x.wait_until_idle(8.0)
        # a restart that no link notices: told, the dead-man is set again, positions are refused
        wire.tell("power_cycle 0.03")
        wait_for(lambda: not wire.state("armed"), "the restart", 1.0)
        wait_for(lambda: wire.state("armed"), "the dead-man", 3.0)
        wire.wait_up("mod0.x")
        stands(0.3, "restarted")
        assert x.read().status[0] & AxisStatus.POSITION_LOST
        x.reset()
        with raises(1, "place is lost"):
            x.move(0.01)
        x.calibrate(0.05)
        x.move(0.06)
        x.wait_until_idle(8.0)


def test_a_workcell_that_starts_stopped_closes_no_loop(start: Callable[..., Any], short_folder: Path) -> None:
    wire = Wire(start, short_folder, "odrive.simulator")
    cell = wire.serve("start_stopped = true\n" + CONFIG)
    wire.wait_up("mod0.x")
    until = time.monotonic() + 1.0
    while time.monotonic() < until:
        assert wire.state("state", 0) == wire.state("state", 1) == 1
    cell.reset()
    with cell.open("mod0.x", "rw") as x:
        x.move(0.01)
        x.wait_until_idle(8.0)
