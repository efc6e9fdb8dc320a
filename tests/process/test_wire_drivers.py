"""Drivers of real protocols under the real daemon, against simulated devices on ptys and TCP.

The second drive of the bus is configured and not there, in all tests: a dead unit must not disturb the others. Starting
a cell takes seconds on a busy machine, so each test tells a whole story in one.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from daemon_rig import has_ended, wait_for
from wire_rig import SLIDE, Wire

import sioms
from sioms.protocol.flags import AnalogStatus, AxisStatus

CONFIG = """
[workcell]
name = "wire"
[device.bus0]
driver = "modbus-axis"
map = "leadshine"
line = {{ serial = "{folder}/drives", baud = 115200 }}
poll_hz = 30.0
[[device.bus0.axis]]
name = "x"
address = 1
travel_per_turn = 0.01
velocity_max = 0.2
acceleration_max = 2.0
[[device.bus0.axis]]
name = "y"
address = 2
velocity_by = "path"
travel_per_turn = 0.01
velocity_max = 0.2
acceleration_max = 2.0
[device.finger0]
driver = "framed-adc"
line = {{ serial = "{folder}/finger", baud = 921600 }}
channels = 16
rate_hz = 500
scale = 0.0005
unit = "N"
[device.io0]
driver = "modbus-io"
map = "moxa_e1200"
model = "E1212"
line = {{ tcp = "{io}" }}
safe = {{ do = 0 }}
"""


class Cell:
    """Simulators, a daemon, and a client."""

    def __init__(self, start: Callable[..., Any], folder: Path) -> None:
        self._start = start
        self.drives = self._simulator("modbus.simulated.leadshine", "--link", folder / "drives", "--units", "1")
        self.finger = self._simulator("framed_adc.simulator", "--link", folder / "finger")
        self.io = self._simulator("modbus.simulated.moxa", "--model", "E1212")
        for process in (self.drives, self.finger):
            process.wait_line("^ready ")
        config = folder / "wire.toml"
        port = self.io.wait_line(r"^ready (\S+)$").group(1)
        config.write_text(CONFIG.format(folder=folder, io=port))
        self.socket = str(folder / "s")
        command = [sys.executable, "-m", "sioms.daemon.main", "--config", config, "--socket", self.socket]
        self.daemon = start(command)
        self.daemon.wait_line("event=ready")
        self.client = sioms.Workcell(self.socket)

    def _simulator(self, name: str, *options: object) -> Any:
        return self._start([sys.executable, "-m", f"sioms.drivers.{name}", *map(str, options)])

    def tell(self, process: Any, line: str) -> Any:
        """Send a command to a simulator and return its answer's value."""
        before = len(process.lines)
        process.process.stdin.write(line + "\n")
        process.process.stdin.flush()
        deadline = time.monotonic() + 5
        while len(process.lines) == before:
            assert time.monotonic() < deadline, f"no answer to {line}"
            time.sleep(0.001)
        answer = process.lines[before]
        assert answer.startswith("ok"), answer
        return json.loads(answer[3:]) if answer[3:] else None

    def device(self, name: str) -> dict[str, Any]:
        """Return what the daemon says of a device."""
        return next(device for device in self.client.status()["devices"] if device["name"] == name)

    def velocity(self) -> float:
        return float(self.tell(self.drives, "state")["velocity"])

    def reads(self, name: str) -> bool:
        """Tell whether a node can be read."""
        try:
            with self.client.open(f"{name}.readonly" if name == "bus0.x" else name) as node:
                node.read()
        except OSError:
            return False
        return True


@pytest.fixture
def cell(start: Callable[..., Any], short_folder: Path, wait_until: Callable[..., None]) -> Iterator[Cell]:
    made = Cell(start, short_folder)
    for name in ("bus0.x", "finger0", "io0"):
        wait_until(lambda name=name: made.reads(name), what=f"{name} readable")
    yield made
    made.client.close()


def test_a_dead_drive_beside_and_an_alarm(cell: Cell, wait_until: Callable[..., None]) -> None:
    with cell.client.open("bus0.x", "rw") as x:
        # the dead drive beside it takes little of the line
        first, began = x.read().number, time.monotonic()
        x.move(0.05)
        x.wait_until_idle(5.0)
        time.sleep(1.0)
        assert x.read().position[0] == pytest.approx(0.05)
        rate = (x.read().number - first) / (time.monotonic() - began)
        assert rate > 12, f"{rate:.1f} polls a second"
        assert not cell.reads("bus0.y")
        # an alarm in motion: named, latched, reset
        x.move(-0.2)
        wait_until(lambda: cell.velocity() != 0, what="motion")
        cell.tell(cell.drives, "alarm 0x40")
        wait_until(lambda: x.read().status[0] & AxisStatus.FAULT, what="the fault")
        with pytest.raises(OSError, match="current sensing"):
            x.move(0.0)
        x.reset()
        wait_until(lambda: not x.read().status[0] & AxisStatus.FAULT, what="the reset")


def test_the_stream_and_the_outputs(cell: Cell, start: Callable[..., Any], wait_until: Callable[..., None]) -> None:
    with cell.client.open("finger0") as finger:
        cell.tell(cell.finger, "touch 2 1 1")
        wait_until(lambda: sum(finger.read().data) == pytest.approx(2.0, abs=0.1), what="the touch")
        assert 0 <= time.monotonic_ns() - finger.read().stamp_ns < 500e6
        cell.tell(cell.finger, "lose 4")
        wait_until(lambda: finger.statistics()["stream"]["lost_blocks"] >= 4, what="the losses counted")
        flags = {flag for old in finger.history(0) for flag in old.flags}
        assert AnalogStatus.OVERRUN in flags
    program = """
import sys, time, sioms
node = sioms.Workcell(sys.argv[1]).open("io0.do", "rw")
node.set(0x55)
print("set", flush=True)
time.sleep(60)
"""
    cell.tell(cell.io, "loop on")
    client = start([sys.executable, "-c", program, cell.socket])
    client.wait_line("set")
    assert cell.tell(cell.io, "state")["do"] == [1, 0, 1, 0, 1, 0, 1, 0]
    with cell.client.open("io0") as inputs:
        wait_until(lambda: inputs.read().data[0] == 0x55, what="the loop")
        client.process.kill()
        wait_until(lambda: inputs.read().data[0] == 0, 2.0, "the safe value")


def test_polls_back_to_back_do_not_keep_a_driver_from_stopping_and_ending_with_its_daemon(
    start: Callable[..., Any], short_folder: Path
) -> None:
    """A position move of a Leadshine drive goes on to its target by itself."""
    wire = Wire(start, short_folder, "modbus.simulated.leadshine", "--units", "1")
    wire.serve(SLIDE.replace("[[", "poll_hz = 1000.0\n[["))
    wire.wait_up("slide0")
    with wire.client.open("slide0", "rw") as slide:
        slide.move(5.0)
        wait_for(lambda: abs(wire.state("velocity")) > 40000, "motion")
        driver = wire.pid("slide0")
        wire.daemon.process.kill()
        wait_for(lambda: wire.state("velocity") == 0, "rest", 2.0)
        wait_for(lambda: has_ended(driver), "the driver gone with its daemon", 1.5)
