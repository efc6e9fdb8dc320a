"""Positions over the death of a driver and of the daemon, and how moves arrive on a drive of its own loop."""

from __future__ import annotations

import errno
import os
import signal
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from conftest import Running
from daemon_rig import FORCE, Daemon, raises, wait_for

import sioms
from sioms.protocol.flags import AxisStatus
from sioms.sdk.persistence import AT_REST, decode

SIM = """
[workcell]
name = "kept"
state_folder = "{folder}"
[device.mod0]
driver = "sim-axes"
late_max_s = 0.5
[[device.mod0.axis]]
name = "x"
position_min = -0.5
position_max = 1.0
velocity_max = 1.0
acceleration_max = 10.0
force_max = 100.0
homing = {{ velocity = 0.2, slow_velocity = 0.02, offset = 0.1, required = true }}
restore = {{ when = "always" }}
motor = {{ mass = 1.0, viscous = 2.0, encoder_step = 1e-6, home = -0.01 }}
"""
DRIVE = """
[device.slide0]
driver = "modbus-axis"
map = "leadshine"
line = {{ serial = "{port}", baud = 115200 }}
[[device.slide0.axis]]
name = "x"
travel_per_turn = 0.01
position_min = -1.0
position_max = 1.0
velocity_max = 0.2
acceleration_max = 2.0
backlash = {{ distance = 0.004, velocity = 0.05 }}
arrival = {{ settle_s = 0.1, tolerance = 1e-5, retries = 2 }}
restore = {{ when = "matching" }}
"""


ALARM = """
[[alarm]]
node = "force0.fx"
high = 0.5
hihi = 2.0
[[alarm]]
node = "force0.fy"
high = 5.0
"""


@pytest.fixture
def port(tmp_path: Path) -> Iterator[str]:
    """A drive that lives on when its driver dies."""
    link = ["--link", str(tmp_path / "port")]
    drive = Running([sys.executable, "-m", "sioms.drivers.modbus.simulated.leadshine", *link, "--units", "1"], {}, None)
    try:
        yield drive.wait_line(r"^ready (\S+)$").group(1)
    finally:
        drive.end()


def kept_at_rest(folder: Path, device: str) -> None:
    """Wait until the file of a device says that it is at rest."""
    path = folder / f"{device}.positions"
    wait_for(lambda: all(e.state & AT_REST for e in decode(path.read_bytes()).entries.values()), "noted at rest")


def kill(daemon: Daemon, device: str) -> None:
    """Kill a driver and wait for its successor."""
    was = daemon.device(device)
    os.kill(was["pid"], signal.SIGKILL)
    daemon.wait_up(device, was["generation"] + 1)


def look(daemon: Daemon, node: str = "mod0.x") -> tuple[float, bool]:
    """Return position and whether homed, of an axis that may just have come up."""
    with daemon.cell() as cell, cell.open(f"{node}.readonly") as axis:
        reading = wait_for(lambda: axis.read() if axis.read().number else None, "a reading")
        return reading.position[0], bool(reading.status[0] & AxisStatus.HOMED)


def test_positions_survive_driver_and_daemon_unless_the_axis_moved(
    start_daemon: Callable[..., Daemon], tmp_path: Path
) -> None:
    text = SIM.format(folder=tmp_path / "state")
    daemon = start_daemon(text)
    daemon.wait_up("mod0")
    with daemon.cell() as cell, cell.open("mod0.x", "rw") as axis:
        with raises(errno.EPERM, "home required"):
            axis.move(0.2)
        axis.home()
        axis.wait_until_idle(10.0)
        axis.move(0.35)
        axis.wait_until_idle(5.0)
    kept_at_rest(tmp_path / "state", "mod0")
    kill(daemon, "mod0")
    assert look(daemon) == (pytest.approx(0.35, abs=1e-4), True)
    assert daemon.said("x: position 0.3[0-9]* m restored, homed")
    kept_at_rest(tmp_path / "state", "mod0")
    daemon.running.signal(signal.SIGKILL)
    daemon.running.wait_exit(5.0)
    daemon = start_daemon(text)
    daemon.wait_up("mod0")
    assert look(daemon) == (pytest.approx(0.35, abs=1e-4), True)
    with daemon.cell() as cell, cell.open("mod0.x", "rw") as axis:
        axis.move(0.4)  # homed is homed
        axis.wait_until_idle(5.0)
        axis.jog(0.05)
        wait_for(lambda: axis.read().velocity[0] > 0.04, "running")
        kill(daemon, "mod0")
    assert look(daemon)[1] is False
    assert "not known to be at rest" in daemon.said("x: position not restored, not homed")
    assert daemon.terminate() == 0
    daemon = start_daemon(text)
    daemon.wait_up("mod0")
    assert look(daemon)[1] is False


def test_a_drive_that_counts_on_keeps_its_coordinates_and_takes_up_its_play(
    start_daemon: Callable[..., Daemon], tmp_path: Path, port: str
) -> None:
    head = f'[workcell]\nname = "kept"\nstate_folder = "{tmp_path / "state"}"\n'
    daemon = start_daemon(head + DRIVE.format(port=port))
    daemon.wait_up("slide0")
    with daemon.cell() as cell, cell.open("slide0", "rw") as axis:
        axis.calibrate(0.5)
        axis.move(0.49)
        lowest, most = 1.0, 0
        while axis.read().in_motion[0] or axis.read().buffered[0] or not most:
            snapshot = axis.wait_new(axis.read().number, 5.0)
            lowest, most = min(lowest, snapshot.position[0]), most + 1
        assert axis.read().position[0] == pytest.approx(0.49, abs=1e-5)
        assert lowest == pytest.approx(0.486, abs=2e-4), "comes from below"
        assert axis.diagnostics()["offset"] == [pytest.approx(0.5)]
        assert axis.diagnostics()["retries"] == [0]
        before = axis.read().position[0]
    kept_at_rest(tmp_path / "state", "slide0")
    kill(daemon, "slide0")
    assert look(daemon, "slide0")[0] == pytest.approx(before, abs=1e-9)


def test_alarms_show_and_a_wrong_one_is_told(start_daemon: Callable[..., Daemon]) -> None:
    text = FORCE + ALARM
    daemon = start_daemon(text)
    daemon.wait_up("force0")
    with daemon.cell() as cell, cell.open("force0") as force:
        reading = wait_for(lambda: force.read() if force.read().number else None, "a reading")
        flags = [sioms.AnalogStatus(f) for f in reading.flags]
        assert reading.data[:2] == (pytest.approx(1.0), pytest.approx(2.0))
        assert (flags[0], flags[1], flags[0].severity) == (sioms.AnalogStatus.HIGH, 0, 1)
    daemon.configure(text.replace("hihi = 2.0", "hihi = 1.0").replace('node = "force0.fy"', 'node = "io0"'))
    with daemon.cell() as cell, raises(errno.EINVAL, "[[alarm]] number 2: node = io0"):
        cell.reload()
