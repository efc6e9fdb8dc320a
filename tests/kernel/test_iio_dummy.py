"""Linux IIO on the kernel's dummy device under the real daemon, compared with what libiio's programs say of it.

The dummy's single readings are 73, 33, -34, 34, those of its buffer 7, -33, -2, 344 (iio_simple_dummy.c,
iio_simple_dummy_buffer.c).
"""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from daemon_rig import Daemon, daemons, wait_for

from sioms.drivers.iio.codec import Element, Layout, parse_type
from sioms.drivers.iio.device import IioDevice, find_device
from sioms.drivers.iio.kernel_dummy import CONFIGFS, NAME, TRIGGER, DummyDevice
from sioms.protocol.flags import AnalogStatus

if not CONFIGFS.is_dir() or os.geteuid() != 0:
    pytest.skip("needs root and iio_dummy; tests/kernel/run.py starts a kernel that has it", allow_module_level=True)

SYSFS = Path("/sys/bus/iio/devices")
CHANNELS = ["voltage1-voltage2", "voltage0", "accel_x", "voltage3-voltage4"]
MILLI = 1e-3
SINGLE = [33 * 1.344e-6 * MILLI, (73 + 7) * 1.333e-3 * MILLI, 34.0, -34 * 1.344e-6 * MILLI]
SCAN = [-33 * 1.344e-6 * MILLI, (7 + 7) * 1.333e-3 * MILLI, 344.0, -2 * 1.344e-6 * MILLI]
BUFFER = f"""
[workcell]
name = "iio"
[device.adc0]
driver = "iio"
device = "{NAME}"
channels = {CHANNELS}
mode = "buffer"
rate_hz = 50.0
trigger = "{TRIGGER}"
buffer_length = 16
"""
RAW = BUFFER.replace('"buffer"', '"raw"').replace(f'trigger = "{TRIGGER}"\n', "")
libiio = pytest.mark.skipif(
    shutil.which("iio_readdev") is None, reason="no libiio-utils here; apt-get install libiio-utils"
)


@pytest.fixture
def dummy() -> Iterator[DummyDevice]:
    made = DummyDevice()
    try:
        yield made
    finally:
        made.remove()


@contextlib.contextmanager
def serving(config: str) -> Iterator[Daemon]:
    with daemons() as start:
        daemon = start(config)
        daemon.wait_up("adc0")
        yield daemon


def said(*command: str) -> str:
    return subprocess.run(command, capture_output=True, text=True, timeout=20, check=True).stdout


def setting(name: str) -> str:
    return (find_device(str(SYSFS), NAME) / name).read_text().strip("\n\0")


def lost(daemon: Daemon, words: str) -> None:
    wait_for(lambda: words in daemon.device("adc0")["link_reason"], f"{words!r} in {daemon.device('adc0')}")


def test_single_readings(dummy: DummyDevice) -> None:
    with serving(RAW) as daemon, daemon.cell() as cell, cell.open("adc0") as node:
        assert node.read().data == pytest.approx(SINGLE)
        dummy.unplug()
        lost(daemon, "there is no IIO device at all")
        dummy.plug()
        daemon.wait_up("adc0")
        assert node.read().data == pytest.approx(SINGLE)


def test_scans_of_a_buffer(dummy: DummyDevice) -> None:
    with serving(BUFFER) as daemon, daemon.cell() as cell, cell.open("adc0") as node:
        wait_for(lambda: node.read().number > 100, "a hundred scans")
        assert node.read().data == pytest.approx(SCAN)
        assert setting("current_timestamp_clock") == "monotonic", "the kernel grants it"
        stamps = np.array([old.stamp_ns for old in node.history(node.read().number - 100)])
        assert np.all(np.diff(stamps) > 0)
        assert np.median(np.diff(stamps)) == pytest.approx(20e6, rel=0.02), "the trigger's period"
        assert 0 <= time.monotonic_ns() - node.read().stamp_ns < 0.5e9
        pid, before = daemon.device("adc0")["pid"], node.statistics()["stream"]["lost_scans"]
        with daemon.frozen(pid):  # 16 scans have room; of the rest the kernel keeps none
            time.sleep(0.8)
        wait_for(lambda: node.statistics()["stream"]["lost_scans"] >= before + 10, "the losses counted")
        wait_for(lambda: not node.read().flags[0] & AnalogStatus.OVERRUN, "scans without a gap")
    assert setting("buffer/enable") == "0", "switched off when the driver ends"


def test_a_driver_that_is_killed_leaves_no_old_scans(dummy: DummyDevice) -> None:
    with serving(BUFFER) as daemon:
        pid, killed_ns = daemon.device("adc0")["pid"], time.monotonic_ns()
        os.kill(pid, signal.SIGKILL)
        daemon.wait_up("adc0", 2)
        with daemon.cell() as cell, cell.open("adc0") as node:
            wait_for(lambda: node.read().stamp_ns > killed_ns, "new scans")
            assert all(old.stamp_ns > killed_ns for old in node.history(0))
            assert node.read().data == pytest.approx(SCAN)


def test_a_device_that_vanishes_while_it_is_read(dummy: DummyDevice) -> None:
    with serving(BUFFER) as daemon, daemon.cell() as cell, cell.open("adc0") as node:
        dummy.unplug()
        lost(daemon, "there is no IIO device at all")
        dummy.plug()
        daemon.wait_up("adc0")
        wait_for(lambda: node.read().data == pytest.approx(SCAN), "scans again")
        assert daemon.device("adc0")["generation"] == 1, "the same process"


@libiio
def test_another_reader(dummy: DummyDevice) -> None:
    other = subprocess.Popen(
        ["iio_readdev", "-t", TRIGGER, "-b", "4", NAME], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    try:
        wait_for(lambda: setting("buffer/enable") == "1", "its buffer")
        with daemons() as start:
            daemon = start(BUFFER)
            lost(daemon, "in use by another process")
            assert setting("buffer/enable") == "1", "what it had set up goes on"
            other.kill()
            other.wait()
            daemon.wait_up("adc0")
    finally:
        other.kill()
        other.wait()


def test_what_cannot_be(dummy: DummyDevice) -> None:
    for change, words in (
        ((f'device = "{NAME}"', 'device = "ads1115"'), f"there is iio:device0 ({NAME})"),
        (("'accel_x'", "'accel_z'"), "switch on channel accel_z of iio:device0: it has accel_x, voltage0"),
        (
            (f'trigger = "{TRIGGER}"', 'trigger = "nobody"'),
            f"set trigger 'nobody' of iio:device0: there is {TRIGGER}",
        ),
        ((f'trigger = "{TRIGGER}"', ""), "rate_hz = 50, but iio:device0 samples at 3 Hz; want that"),
        ((f'50.0\ntrigger = "{TRIGGER}"', "3.0"), "no trigger is set, and its buffer may need one"),
    ):
        with daemons() as start:
            lost(start(BUFFER.replace(*change)), words)


@libiio
def test_libiio_reads_the_same(dummy: DummyDevice) -> None:
    """Formats, order, scale and offset by iio_info and iio_attr; the bytes of iio_readdev by our decoder."""
    told = dict(re.findall(r"(\S+):\s+\(input, index: \d+, format: (\S+)\)", said("iio_info")))
    order = dict(re.findall(r"(\S+):\s+\(input, index: (\d+), format", said("iio_info")))
    device = IioDevice(find_device(str(SYSFS), NAME))
    layout = device.switch_on([*CHANNELS], timestamp=True)
    for element in layout.elements:  # libiio writes a capital where all bits of the word count
        assert element.type == parse_type(told[element.name].replace("S", "s").replace("U", "u"))
        assert element.index == int(order[element.name])
    for channel in CHANNELS:
        attributes = dict(
            re.findall(r"\(input\), attr '(\w+)', value '([^']*)'", said("iio_attr", "-c", NAME, channel))
        )
        assert device.scaling(channel) == (
            float(attributes.get("offset", 0)),
            float(attributes.get("scale", 1)),
        )
    for chosen in (CHANNELS, ["voltage0"], ["accel_x", "voltage1-voltage2"]):
        command = ["timeout", "20", "iio_readdev", "-t", TRIGGER, "-b", "4", "-s", "8", NAME, *chosen]
        data = subprocess.run(command, capture_output=True, timeout=30, check=True).stdout
        elements = [Element(e.name, e.index, e.type) for e in layout.elements if e.name in chosen]
        raw = Layout(elements).decode(data)
        known = {"voltage0": 7, "voltage1-voltage2": -33, "voltage3-voltage4": -2, "accel_x": 344}
        assert {name: list(values) for name, values in raw.items()} == {name: [known[name]] * 8 for name in chosen}


def test_the_driver_check() -> None:
    command = [sys.executable, "-m", "sioms.tools.front", "driver", "check", "iio-dummy"]
    done: Any = subprocess.run(command, capture_output=True, text=True, timeout=100)
    assert done.returncode == 0, done.stdout + done.stderr
    for trial in ("golden", "unplugged", "kill driver", "kill daemon"):
        assert f"passed  {trial}" in done.stdout
