"""The ASCII line stream: the driver under the real daemon against a simulated board on a pty."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from daemon_rig import wait_for
from wire_rig import Wire

from sioms.protocol.flags import AnalogStatus
from sioms.tactile.cylinder import FINGER_B
from sioms.tactile.emap import e_map
from sioms.tactile.quality import Quality
from sioms.tactile.sensing import CHANNELS
from sioms.tactile.series import line_load

CONFIG = """
[device.scale0]
driver = "ascii-stream"
line = { serial = "{port}", baud = 115200 }
columns = ["left", "right"]
unit = "N"
offset = 200.0
scale = 0.01
rate_hz = 200.0
time = "us"
checksum = true
greeting = "load cells"
start = "RUN\\n"
stop = "x\\n"
low = 0.0
high = 4095.0
"""
OPTIONS = ("--rate", "200", "--time", "us", "--checksum", "--wait-for", "RUN", "--noise", "0")


def test_samples_losses_and_unplugging(start: Callable[..., Any], short_folder: Path) -> None:
    wire = Wire(start, short_folder, "ascii_stream.simulator", *OPTIONS)
    cell = wire.serve(CONFIG)
    wire.wait_up("scale0")
    with cell.open("scale0") as node:
        wire.tell("load 0 5")
        wire.tell("load 1 -1")
        wait_for(lambda: node.read().data == pytest.approx([5.0, -1.0], abs=0.02), "the loads")
        number = node.read().number
        node.wait_new(number + 150, 5.0)
        stamps = np.array([old.stamp_ns for old in node.history(number)])
        assert np.diff(stamps).mean() == pytest.approx(5e6, rel=0.02) and np.diff(stamps).min() > 0
        assert 0 <= time.monotonic_ns() - node.read().stamp_ns < 500e6
        # damaged, foreign and cut lines are counted and dropped; the next good one says that some are missing
        for words in ("say 1,2,3", "say # remark", "say 1,2,x*00"):
            wire.tell(words)
        wait_for(lambda: node.statistics()["stream"]["bad_checksum"] == 2, "the foreign lines counted")
        wire.tell("noise 2")
        wait_for(lambda: node.statistics()["stream"]["bad_checksum"] >= 3, "the damaged lines counted")
        assert any(old.flags[0] & AnalogStatus.OVERRUN for old in node.history(number))
        assert node.read().data == pytest.approx([5.0, -1.0], abs=0.02)
        wire.tell("load 1 60")
        wait_for(lambda: node.read().flags == (0, AnalogStatus.SATURATED), "the end of the converter")
        # a cable pulled and put back, and a board that has lost its power: both are started again
        for fault in ("unplug 0.2", "restart"):
            wire.tell(fault)
            wait_for(lambda: not wire.reads("scale0"), "the loss")
            wire.wait_up("scale0")
        assert node.read().data[0] == pytest.approx(5.0, abs=0.02)
    wire.daemon.process.terminate()
    wire.daemon.wait_exit()
    wait_for(lambda: wire.state("runs") is False, "told to be silent when the driver ends", 3.0)


def test_another_device_is_refused(start: Callable[..., Any], short_folder: Path) -> None:
    wire = Wire(start, short_folder, "ascii_stream.simulator", "--columns", "3", "--rate", "100")
    wire.serve(
        '[device.scale0]\ndriver = "ascii-stream"\nline = { serial = "{port}" }\ncolumns = ["a"]\nrate_hz = 100.0\n'
    )
    wait_for(lambda: "the configuration says 1 number a line" in wire.reason("scale0"), "the sentence")
    assert not wire.reads("scale0")


def test_a_finger_that_prints_its_elements_is_felt(start: Callable[..., Any], short_folder: Path) -> None:
    """An edge of 150 N/m at 60 degrees comes on as the outputs it gives, 3 % of strain for 1 %, and goes again."""
    wire = Wire(
        start,
        short_folder,
        "ascii_stream.simulator",
        "--columns",
        "16",
        "--rate",
        "80",
        "--noise",
        "2",
        "--lag-s",
        "0.01",
    )
    columns, finger = [f"e{i}" for i in range(16)], Path(__file__).parents[2] / "etc" / "finger.toml"
    cell = wire.serve(
        f'[device.finger0]\ndriver = "ascii-stream"\nline = {{ serial = "{{port}}" }}\ncolumns = {columns}\nunit = '
        '"%"\n'
        f'offset = 200.0\nscale = 0.01\nrate_hz = 80.0\nshape = {{ finger_file = "{finger}" }}\n'
    )
    wire.wait_up("finger0")
    angles = np.radians(143.0 - 9.22 * np.arange(16))
    edge = e_map(FINGER_B, angles, 10.3e-3, 60)[:, :121] @ line_load(FINGER_B, -150.0, np.radians(60.0), 60)
    with cell.open("finger0.shape") as shape, cell.open("finger0.strain") as strain:

        def felt(name: str) -> float:
            return float(shape.read().data[[channel for channel, _, _ in CHANNELS].index(name)])

        wait_for(lambda: felt("quality") == Quality.NO_CONTACT.value, "the baseline")
        for index, output in enumerate(-100.0 * edge / 3.0):
            wire.tell(f"load {index} {output:.4f}")
        wait_for(lambda: felt("touched") == 1.0 and abs(felt("load") - 150.0) < 10.0, "the touch")
        # the board follows what it is told with a lag
        wait_for(lambda: np.allclose(strain.read().data, edge, rtol=0.05, atol=3e-3), "the strains of the touch")
        assert np.degrees(felt("angle")) == pytest.approx(60.0, abs=0.5)
        for index in range(16):
            wire.tell(f"load {index} 0")
        wait_for(lambda: felt("touched") == 0.0 and felt("load") == 0.0, "the release")
