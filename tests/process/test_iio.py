"""Linux IIO: the driver under the real daemon on files that behave like the kernel's dummy device as far as files
can.
"""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from daemon_rig import wait_for
from wire_rig import Wire

from sioms.protocol.flags import AnalogStatus

BUFFER = """
[device.adc0]
driver = "iio"
device = "iio_dummy_part_no"
channels = ["voltage1-voltage2", "voltage0", "accel_x"]
mode = "buffer"
rate_hz = 250.0
trigger = "instance1"
buffer_length = 128
watermark = 2
sysfs = "{port}/sysfs"
dev = "{port}/dev"
"""
RAW = BUFFER.replace('"buffer"', '"raw"').replace("250.0", "100.0").replace('trigger = "instance1"\n', "")


def test_scans_of_a_buffer(start: Callable[..., Any], short_folder: Path) -> None:
    wire = Wire(start, short_folder, "iio.simulator")
    cell = wire.serve(BUFFER)
    wire.wait_up("adc0")
    set_up = wire.tell("state")
    assert set_up["on"] == ["voltage0", "voltage1-voltage2", "accel_x", "timestamp"]
    assert (set_up["buffer/enable"], set_up["buffer/length"], set_up["buffer/watermark"]) == ("1", "128", "2")
    assert set_up["current_timestamp_clock"] == "monotonic"
    with cell.open("adc0") as node:
        # 33 counts of 0.0025 mV, (73 + 7) of 1.3333 mV, 34 of 0.01 m/s^2
        assert node.read().data == pytest.approx([33 * 2.5e-6, 80 * 1.3333e-3, 0.34])
        wire.tell("volt voltage1-voltage2 -0.003")
        wait_for(lambda: node.read().data[0] == pytest.approx(-0.003), "the voltage")
        wire.tell("bytes 5")  # the reads cut the scans anywhere
        number = node.read().number
        node.wait_new(number + 100, 5.0)
        stamps = np.array([old.stamp_ns for old in node.history(number)])
        assert np.diff(stamps) == pytest.approx(4e6, abs=2), "the device's own times, not those of the reads"
        assert 0 <= time.monotonic_ns() - node.read().stamp_ns < 500e6
        assert node.statistics()["stream"]["lost_scans"] == 0
        wire.tell("lose 7")
        wait_for(lambda: node.statistics()["stream"]["lost_scans"] == 7, "the losses counted")
        assert sum(bool(old.flags[0] & AnalogStatus.OVERRUN) for old in node.history(number)) == 1
        wire.tell("volt accel_x 1000")
        wait_for(lambda: node.read().flags == (0, 0, AnalogStatus.SATURATED), "the converter's end")
        # a driver killed with the buffer on: the new one takes no old scans for new ones
        wire.tell("bytes 65536")  # a pipe keeps half a scan for the next reader, the kernel does not
        time.sleep(0.05)
        killed, before_ns = wire.pid("adc0"), time.monotonic_ns()
        os.kill(killed, signal.SIGKILL)
        wait_for(lambda: wire.pid("adc0") not in (0, killed), "a new driver")
        wire.wait_up("adc0")
        with cell.open("adc0") as again:
            assert all(old.stamp_ns > before_ns for old in again.history(0))
        # another program switches the buffer off, and sets a scale: both are seen, and set right
        for fault, words in (
            ("enable 0", "no good frame for"),
            ("scale 2.6666", "another program has set it"),
        ):
            before = len(wire.daemon.lines)
            wire.tell(f"foreign {fault}")
            wait_for(lambda b=before, w=words: any(w in line for line in wire.daemon.lines[b:]), words)
            wire.wait_up("adc0")
        with cell.open("adc0") as again:
            assert again.read().data[1] == pytest.approx(80 * 2.6666e-3)
        # the cable pulled and put back
        wire.tell("unplug")
        wait_for(lambda: not wire.reads("adc0"), "the loss")
        wait_for(lambda: "there is no IIO device at all" in wire.reason("adc0"), "the sentence")
        wire.tell("plug")
        wire.wait_up("adc0")
    wire.daemon.process.terminate()
    wire.daemon.wait_exit()
    assert wire.state("buffer/enable") == "0", "switched off when the driver ends"


def test_single_readings(start: Callable[..., Any], short_folder: Path) -> None:
    wire = Wire(start, short_folder, "iio.simulator", "--number", "3")
    cell = wire.serve(RAW)
    wire.wait_up("adc0")
    with cell.open("adc0") as node:
        assert node.read().data == pytest.approx([33 * 2.5e-6, 80 * 1.3333e-3, 0.34])
        wire.tell("volt voltage0 1.5")
        wait_for(lambda: node.read().data[1] == pytest.approx(1.5, abs=1e-3), "the voltage")
        raw = short_folder / "port/sysfs/iio:device3/in_voltage0_raw"
        raw.write_text("?\n")
        wait_for(lambda: node.read().flags == (0, AnalogStatus.INVALID, 0), "the reading that failed")
        assert node.statistics()["stream"]["failed_readings"] >= 1
        raw.write_text("68\n")
        wait_for(lambda: node.read().flags == (0, 0, 0), "the reading again")
        wire.tell("unplug")
        wait_for(lambda: not wire.reads("adc0"), "the loss")
        wire.tell("plug")
        wire.wait_up("adc0")
        assert cell.status()["devices"][0]["generation"] == 1, "found again by the same process"


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (('"iio_dummy_part_no"', '"ads1115"'), "there is iio:device0 (iio_dummy_part_no)"),
        (('"accel_x"', '"accel_z"'), "switch on channel accel_z of iio:device0: it has accel_x, voltage0"),
        (("{port}/dev", "{port}/nowhere"), "nowhere/iio:device0: no such device; is it plugged in"),
    ],
)
def test_devices_that_do_not_fit(
    start: Callable[..., Any], short_folder: Path, change: tuple[str, str], words: str
) -> None:
    wire = Wire(start, short_folder, "iio.simulator")
    wire.serve(BUFFER.replace(*change))
    wait_for(lambda: words in wire.reason("adc0"), f"the sentence; {wire.reason('adc0')}")
    assert not wire.reads("adc0")
