"""Couplers and drives that restart, lose their supply or their cable, under the real daemon."""

from __future__ import annotations

import errno
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from daemon_rig import raises, wait_for
from wire_rig import Wire

from sioms.protocol.flags import AxisStatus

WAGO = """
[device.io0]
driver = "modbus-io"
map = "wago_750"
line = { tcp = "{port}" }
channels = { di = 8, do = 8 }
watchdog_s = 0.5
safe = { do = 0 }
main = "do"
"""
LEADSHINE = """
[device.slide0]
driver = "modbus-axis"
map = "leadshine"
line = { serial = "{port}", baud = 115200 }
poll_hz = 40.0
[[device.slide0.axis]]
name = "x"
homing = true
travel_per_turn = 0.01
position_min = -0.3
position_max = 0.3
velocity_max = 0.4
acceleration_max = 4.0
"""


def status(axis: Any) -> int:
    """Return the axis' status, 0 while its device is lost."""
    try:
        return int(axis.read().status[0])
    except OSError:
        return 0


def test_a_cut_cable_drops_the_outputs_behind_each_opening(start: Callable[..., Any], short_folder: Path) -> None:
    """The coupler's watchdog starts when its trigger is modified: the first opening of its life proves nothing for the
    others.
    """
    wire = Wire(start, short_folder, "modbus.simulated.wago", "--port", "0")
    cell = wire.serve(WAGO)
    for opening in range(4):
        wire.wait_up("io0")
        with cell.open("io0", "rw", timeout=5.0) as outputs:
            outputs.set(0xA5)
            assert wire.state("outputs") == 0xA5
            time.sleep(0.7)  # longer than the watchdog: the polls keep it alive
            assert wire.state("outputs") == 0xA5 and wire.state("armed")
            began = time.monotonic()
            wire.tell("unplug")
            wait_for(lambda: not wire.state("outputs"), f"outputs off in opening {opening}", 1.0)
            print(f"opening {opening}: outputs off {time.monotonic() - began:.2f} s after the cable was cut")
            wire.tell("plug")
            wait_for(lambda: wire.state("armed"), "the watchdog armed again")
            assert wire.state("outputs") == 0


def test_a_coupler_that_restarts_is_armed_again_and_a_silent_one_is_lost(
    start: Callable[..., Any], short_folder: Path
) -> None:
    wire = Wire(start, short_folder, "modbus.simulated.wago", "--port", "0")
    cell = wire.serve(WAGO)
    wire.wait_up("io0")
    for off_s in (0.02, 1.0):
        wire.tell(f"power_cycle {off_s}")
        wait_for(lambda: wire.state("armed") and wire.reads("io0"), f"armed after {off_s} s without supply")
    with cell.open("io0.readonly") as inputs:
        inputs.read()
        began = time.monotonic()
        wire.tell("mute")
        with raises(errno.EIO, "io0"):
            while time.monotonic() - began < 3.0:
                inputs.read()
                time.sleep(0.005)
        took_s = time.monotonic() - began
        print(f"a silent coupler is lost after {took_s:.2f} s")
        wire.tell("clear")
    assert took_s < 1.5, "0.4 s on a machine with nothing else to do"


@pytest.mark.parametrize("off_s", [0.05, 0.3, 4.0])
def test_a_drive_that_was_off_goes_nowhere_until_it_knows_where_it_is(
    start: Callable[..., Any], short_folder: Path, off_s: float
) -> None:
    """Position 0 of the drive is 0.05 m of the machine then: 0.29 m would end at 0.34 m, beyond the limit."""
    wire = Wire(start, short_folder, "modbus.simulated.leadshine", "--units", "1")
    cell = wire.serve(LEADSHINE)
    wire.wait_up("slide0")
    with cell.open("slide0", "rw", timeout=5.0) as axis:
        axis.move(0.05)
        axis.wait_until_idle(5.0)
        wire.tell(f"power_cycle {off_s}")
        time.sleep(off_s)
        wait_for(lambda: status(axis) & AxisStatus.POSITION_LOST, "the lost place told")
        wait_for(
            lambda: wire.reads("slide0") and "'link': 'good'" in wire.reason("slide0"),
            "the drive opened again",
        )
        time.sleep(0.3)
        assert status(axis) & AxisStatus.FAULT
        axis.reset()
        wait_for(lambda: not status(axis) & AxisStatus.FAULT, "the fault reset")
        with raises(errno.EPERM, "position lost"):
            axis.move(0.29)
        time.sleep(0.2)
        assert wire.state("place") == 50000
        axis.home()
        axis.wait_until_idle(10.0)
        axis.move(0.02)
        axis.wait_until_idle(5.0)
        assert wire.state("place") == pytest.approx(20000, abs=1)
