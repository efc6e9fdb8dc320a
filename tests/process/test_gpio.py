"""GPIO lines under the real daemon: without a chip, and on the kernel's simulated chip where there is one (gpio-sim, root)."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from daemon_rig import Daemon, wait_for

CONFIGFS = Path("/sys/kernel/config/gpio-sim")
CONFIG = """
[workcell]
name = "gpio"
[device.io0]
driver = "gpio"
chip = "{chip}"
event_buffer = 16
[[device.io0.output]]
line = 0
safe = 1
[[device.io0.output]]
line = 1
[[device.io0.input]]
line = "key"
[[device.io0.input]]
line = 5
active_low = true
"""


def test_a_missing_chip_is_said_and_waited_for(start_daemon: Callable[..., Daemon]) -> None:
    daemon = start_daemon(CONFIG.format(chip="/dev/gpiochip-none"))
    daemon.said("open /dev/gpiochip-none: no such chip; gpiodetect lists those there are")
    wait_for(lambda: daemon.device("io0")["link"] == "link_lost", "the link's state")
    assert daemon.device("io0")["state"] == "up", "its process lives and tries again"


class SimulatedChip:
    """A chip of gpio-sim with eight lines; ``pull`` is what is outside of an input, ``level`` what an output shows."""

    def __init__(self, folder: Path) -> None:
        bank = folder / "bank0"
        (bank / "line4").mkdir(parents=True)
        (bank / "num_lines").write_text("8")
        (bank / "line4" / "name").write_text("key")
        (folder / "live").write_text("1")
        chip = (bank / "chip_name").read_text().strip()
        self.path = f"/dev/{chip}"
        self._lines = Path("/sys/devices/platform") / (folder / "dev_name").read_text().strip() / chip

    def pull(self, line: int, up: bool) -> None:
        (self._lines / f"sim_gpio{line}" / "pull").write_text("pull-up" if up else "pull-down")

    def level(self, line: int) -> int:
        return int((self._lines / f"sim_gpio{line}" / "value").read_text())


@pytest.fixture
def chip() -> Iterator[SimulatedChip]:
    if os.geteuid() != 0:
        pytest.skip("gpio-sim needs the rights of root")
    with contextlib.suppress(OSError):
        subprocess.run(["modprobe", "gpio-sim"], capture_output=True, check=False)
    if not CONFIGFS.is_dir():
        pytest.skip("this kernel has no gpio-sim (CONFIG_GPIO_SIM, configfs)")
    folder = CONFIGFS / f"sioms{os.getpid()}"
    try:
        yield SimulatedChip(folder)
    finally:
        (folder / "live").write_text("0")
        for inner in (folder / "bank0" / "line4", folder / "bank0", folder):
            inner.rmdir()


def test_lines_of_the_simulated_chip(start_daemon: Callable[..., Daemon], chip: SimulatedChip) -> None:
    daemon = start_daemon(CONFIG.format(chip=chip.path))
    daemon.wait_up("io0")
    assert (chip.level(0), chip.level(1)) == (1, 0), "safe levels from the first moment"
    with daemon.cell() as cell, cell.open("io0.in") as inputs:
        assert inputs.read().data[0] == 0b10
        before = inputs.read().edges[0]
        for up in (True, False, True):
            chip.pull(4, up)
        wait_for(lambda: inputs.read().edges[0] == before + 3, "three edges")
        assert inputs.read().data[0] == 0b11
        assert 0 <= time.monotonic_ns() - inputs.read().changed_ns[0] < 2e9
        with daemon.frozen(daemon.device("io0")["pid"]):
            for i in range(40):
                chip.pull(5, i % 2 == 0)
        wait_for(lambda: inputs.statistics()["stream"]["lost_edges"] == 24, "the losses counted")
        with cell.open("io0", "rw") as outputs:
            outputs.set(0b10)
            assert (chip.level(0), chip.level(1)) == (0, 1)
        wait_for(lambda: (chip.level(0), chip.level(1)) == (1, 0), "safe levels after the writer")
        before_pid = daemon.device("io0")["pid"]
        os.kill(before_pid, signal.SIGKILL)
        daemon.wait_up("io0", 2)
        assert (chip.level(0), chip.level(1)) == (1, 0)
