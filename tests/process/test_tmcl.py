"""Trinamic TMCL: the driver under the real daemon against a simulated module, and the vendor's client against both."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from daemon_rig import at_rest, raises, wait_for
from wire_rig import Misfit, Wire, check_misfits

from sioms.protocol.flags import AxisStatus

CONFIG = """
[device.mod0]
driver = "tmcl"
line = { serial = "{port}", baud = 115200 }
module = 1140
heartbeat_s = 0.5
poll_hz = 50.0
[[device.mod0.axis]]
name = "x"
motor = 0
travel_per_turn = 0.01
microsteps_per_turn = 51200
velocity_max = 0.1
acceleration_max = 1.0
homing = true
[[device.mod0.axis]]
name = "y"
motor = 1
travel_per_turn = -0.01
microsteps_per_turn = 51200
position_max = 0.02
velocity_max = 0.1
acceleration_max = 1.0
"""
PER_M = 51200 / 0.01


def test_moves_homes_and_faults(start: Callable[..., Any], short_folder: Path) -> None:
    wire = Wire(start, short_folder, "tmcl.simulator", "--motors", "2", "--baud", "115200")
    cell = wire.serve(CONFIG)
    wire.wait_up("mod0.x")
    assert wire.state("heartbeat_ms") == 500
    with cell.open("mod0", "rw") as both:
        # two motors at once, the second reversed
        both.command(position=0.02, axis=0)
        both.command(position=0.01, axis=1)
        both.wait_until_idle(5.0)
        assert both.read().position == pytest.approx([0.02, 0.01], abs=1e-6)
        assert wire.state("position", 0) == pytest.approx(0.02 * PER_M, abs=1)
        assert wire.state("position", 1) == pytest.approx(-0.01 * PER_M, abs=1)
    with cell.open("mod0.y", "rw") as y:
        # a velocity ends before the soft limit
        y.command(velocity=0.05)
        wait_for(lambda: y.read().position[0] > 0.012, "motion")
        at_rest(y)
        assert 0.014 < y.read().position[0] <= 0.02
        with raises(22, "cannot do FORCE"):
            y.command(force=1.0)
    with cell.open("mod0.x", "rw") as x:
        # the module's own homing, to the left switch
        wire.tell("ends 80000 2000000")  # 4.4 mm away, searched for at 3.9 mm/s
        x.home()
        x.wait_until_idle(10.0)
        status = x.read().status[0]
        assert status & AxisStatus.HOMED and x.read().position[0] == 0
        # emergency stop in motion
        x.command(velocity=0.05)
        wait_for(lambda: wire.state("velocity") > 0.04 * PER_M, "motion")
        x.stop_all()
        wait_for(lambda: wire.state("velocity") == 0, "rest", 1.0)
        with raises(1, "RESET"):
            x.move(0.0)
        x.reset()
        # a fault of the motor's driver: named, latched, reset only when it is gone
        wire.tell("flags 2")
        wait_for(lambda: x.read().status[0] & AxisStatus.FAULT, "the fault")
        with raises(5, "overtemperature"):
            x.move(0.0)
        wire.tell("flags 0")
        x.reset()
        wait_for(lambda: not x.read().status[0] & AxisStatus.FAULT, "the reset")
        # a move that a limit switch cuts short is no success
        wire.tell("ends 60000 120000")
        with raises(5, "before its target"):
            x.move(0.05)
            x.wait_until_idle(8.0)
        assert wire.tell("store") == [68]


def test_wrong_devices(start: Callable[..., Any], short_folder: Path) -> None:
    misfits = (
        Misfit("module 1276", ("--module", "1276")),
        Misfit("heartbeat_s = 0 accepts", ("--no-heartbeat",)),
        Misfit(
            "no reply within its time-out; check power, wiring, address and speed (115200 baud, 8N1)",
            ("--address", "3"),
        ),
        Misfit(
            "check wiring and speed (115200 baud, 8N1), and whether two devices have one",
            change="noise 1000",
        ),
    )
    check_misfits(start, short_folder, "tmcl.simulator", CONFIG, misfits, "--motors", "2")


def test_the_vendors_client_agrees_with_the_simulator(start: Callable[..., Any], short_folder: Path) -> None:
    pytrinamic = pytest.importorskip("pytrinamic.connections")
    wire = Wire(start, short_folder, "tmcl.simulator", "--motors", "2")
    manager = pytrinamic.ConnectionManager(f"--interface serial_tmcl --port {wire.port} --data-rate 115200")
    with manager.connect() as master:
        master.move_to(0, 20000, 1)
        wait_for(lambda: master.get_axis_parameter(8, 0, 1), "the position reached")
        assert master.get_axis_parameter(1, 0, 1, signed=True) == 20000
        master.rotate(1, -30000, 1)
        wait_for(lambda: master.get_axis_parameter(3, 1, 1, signed=True) == -30000, "the velocity")
        master.stop(1, 1)
        wait_for(lambda: master.get_axis_parameter(3, 1, 1, signed=True) == 0, "rest")
        assert master.get_global_parameter(68, 0, 1) == 0
