"""The drivers that "Write a driver in an afternoon" tells of: files outside of the product, under the real daemon."""

from __future__ import annotations

import errno
import shutil
import sys
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from daemon_rig import raises, wait_for
from wire_rig import Wire

from sioms.protocol.flags import AxisStatus
from sioms.sdk import finding

FOLDER = Path(__file__).parents[2] / "examples" / "drivers"
SUPPLY = """
[device.supply0]
driver = "./bench_supply.py"
line = { serial = "{port}", baud = 9600 }
poll_hz = 20.0
"""
STAGE = """
[device.stage0]
driver = "./linear_stage.py"
line = { serial = "{port}", baud = 115200 }
steps_per_m = 1e6
[[device.stage0.axis]]
name = "x"
velocity_max = 0.1
acceleration_max = 1.0
"""
OVEN = """
[device.oven0]
driver = "modbus-io"
map = "{folder}/oven.toml"
line = { serial = "{port}", baud = 19200, parity = "E" }
poll_hz = 10.0
channels = { temperature = 2, target = 2, on = 2 }
safe = { target = 0, on = 0 }
watchdog_s = 1.0
"""


class OwnWire(Wire):
    """A simulator out of a file."""

    def __init__(self, start: Callable[..., Any], folder: Path, name: str, *options: str) -> None:
        for path in FOLDER.iterdir():
            if path.is_file():
                shutil.copy(path, folder)
        self._start, self.folder, self.socket = start, folder, str(folder / "s")
        self.device = start([sys.executable, str(folder / name), "--link", str(folder / "port"), *options])
        self.port = self.device.wait_line(r"^ready (\S+)$").group(1)


def test_the_power_supply(start: Callable[..., Any], short_folder: Path) -> None:
    wire = OwnWire(start, short_folder, "bench_supply_device.py")
    cell = wire.serve(SUPPLY)
    wire.wait_up("supply0.meas")
    assert wire.state("watchdog_s") == 1.0
    wire.tell("load 1 10")
    with cell.open("supply0.meas") as meas, cell.open("supply0.cc") as limiting:
        with cell.open("supply0", "rw") as volts:
            volts.set(12.0, 5.0)
            wait_for(lambda: meas.read().data == pytest.approx([12.0, 1.2, 5.0, 0.0], abs=0.01), "the voltages")
            wire.tell("load 1 2")
            wait_for(
                lambda: limiting.read().data[0] == 1 and meas.read().data[1] == pytest.approx(2.0, abs=0.01),
                "2 A",
            )
            with raises(34, "out1", "31 V; want 0 to 30 V"):
                volts.set(31.0, 0.0)
            wire.tell("cut 1")
            wait_for(lambda: meas.statistics()["link"]["repeats"] >= 1, "the cut reply asked for again")
        # the writer has gone: 0 V
        wait_for(lambda: wire.state("wanted") == [0.0, 0.0], "the safe values", 3.0)
        with cell.open("supply0", "rw") as volts:
            wait_for(lambda: volts.set(8.0, 0.0), "set")
            wire.tell("deaf")
            wait_for(lambda: wire.state("wanted") == [0.0, 0.0], "0 V by the supply's own watchdog", 4.0)
            wait_for(lambda: not wire.reads("supply0.meas"), "the loss")
            wire.tell("clear")
            wire.wait_up("supply0.meas")
            assert wire.state("wanted") == [0.0, 0.0], "a supply that comes back starts from 0 V"


def test_another_supply_is_refused(start: Callable[..., Any], short_folder: Path) -> None:
    wire = OwnWire(start, short_folder, "bench_supply_device.py", "--model", "PS-303")
    wire.serve(SUPPLY)
    wait_for(
        lambda: "PS-303" in wire.reason("supply0") and "want a PS-202" in wire.reason("supply0"),
        "the sentence",
    )


def test_the_oven_by_a_register_map(start: Callable[..., Any], short_folder: Path) -> None:
    wire = OwnWire(start, short_folder, "oven_device.py")
    cell = wire.serve(OVEN.replace("{folder}", str(short_folder)))
    wire.wait_up("oven0")
    assert wire.state("watchdog_s") == 1.0
    with cell.open("oven0") as temperature:
        assert temperature.read().data == pytest.approx([20.0, 20.0])
        with cell.open("oven0.target", "rw") as target, cell.open("oven0.on", "rw") as on:
            target.set(45.0, 0.0)
            on.set(0b01)
            wait_for(lambda: temperature.read().data[0] > 40, "warmth")
            assert temperature.read().data[1] == pytest.approx(20.0)
            with raises(34, "target1", "want 0 to 300 degC"):
                target.set(45.0, 301.0)
            wire.tell("deaf")
            wait_for(lambda: wire.state("on") == [0, 0], "the heaters off by the oven's own watchdog", 3.0)
            wire.tell("clear")
            wire.wait_up("oven0")
        wait_for(lambda: wire.state("targets") == [0, 0], "the safe values", 3.0)


def test_the_linear_stage(start: Callable[..., Any], short_folder: Path) -> None:
    wire = OwnWire(start, short_folder, "linear_stage_device.py")
    cell = wire.serve(STAGE)
    wire.wait_up("stage0")
    assert wire.state("watchdog_s") == 0.2
    with cell.open("stage0", "rw") as node:
        node.move(0.01, timeout=1.0)
        node.wait_until_idle(5.0)
        assert wire.state("position") == pytest.approx(10_000)
        node.command(velocity=-0.05)
        wait_for(lambda: wire.state("velocity") < -40_000, "speed")
        wire.tell("deaf")
        wait_for(lambda: wire.state("velocity") == 0, "rest by the stage's own watchdog", 2.0)
        wait_for(lambda: not wire.reads("stage0"), "the loss")
        wire.tell("clear")
        wire.wait_up("stage0")
        assert wire.state("velocity") == 0, "nothing resumes"
        node.reset()
        wait_for(lambda: not node.read().status[0] & AxisStatus.FAULT, "the reset of the loss")
        wire.tell("place -0.299")  # as a stage does whose counter has begun anew
        wait_for(lambda: node.read().status[0] & AxisStatus.POSITION_LOST, "the lost place")
        node.reset()
        wait_for(lambda: not node.read().status[0] & AxisStatus.FAULT, "the reset")
        with raises(errno.EPERM, "position lost", "CALIBRATE_DEVICE"):
            node.move(0.0)
        node.calibrate(-0.299)
        node.command(velocity=-0.05)
        wait_for(lambda: node.read().status[0] & AxisStatus.FAULT, "the limit switch")
        with raises(5, "limit switch"):
            node.move(0.0, timeout=1.0)
            node.wait_until_idle(2.0)
        node.reset()
        wait_for(lambda: not node.read().status[0] & AxisStatus.FAULT, "the reset")
        node.move(-0.29, timeout=1.0)
        node.wait_until_idle(5.0)
        assert wire.state("position") == pytest.approx(-290_000)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (("steps_per_m = 1e6", "steps_per_m = -1e6"), "steps_per_m = -1e+06"),
        (
            ("steps_per_m = 1e6", "steps_per_m = 1e6\nwatchdog_s = 0.01"),
            "watchdog_s = 0.01; want three polls, 0.06, to 10",
        ),
    ],
)
def test_a_stage_that_cannot_be(change: tuple[str, str], words: str) -> None:
    driver = finding.find_driver("./linear_stage.py", str(FOLDER))
    table = tomllib.loads(STAGE.replace(*change))["device"]["stage0"]
    del table["driver"]
    settings, errors = finding.read_settings(driver, table, str(FOLDER))
    assert not errors
    _, errors = finding.describe(driver, "stage0", settings)
    assert any(words in str(error) for error in errors)
