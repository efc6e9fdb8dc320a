"""GPIO lines of a chip that the kernel simulates, under the real daemon: what holds of the character device itself.

gpio-sim tells of a changed level by an interrupt that may come as late as the next tick of the kernel (10 ms); changes
that follow each other sooner are one edge. So they are paced here.
"""

from __future__ import annotations

import errno
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gpiod
import pytest
from daemon_rig import Daemon, daemons, raises, wait_for
from gpiod.line import Direction, Drive

from sioms.drivers.gpio.simulator import CONFIGFS, SimulatedChip

if not CONFIGFS.is_dir() or os.geteuid() != 0:
    pytest.skip("needs root and gpio-sim; tests/kernel/run.py starts a kernel that has it", allow_module_level=True)

NAMES = ["", "", "", "", "key", "", "door", ""]
PACE_S = 0.03
CONFIG = """
[workcell]
name = "gpio"
[device.io0]
driver = "gpio"
chip = "{chip}"
event_buffer = 4
[[device.io0.output]]
line = 0
safe = 1
[[device.io0.output]]
line = 1
[[device.io0.output]]
line = 2
safe = 0
active_low = true
[[device.io0.output]]
line = 3
drive = "open_drain"
[[device.io0.input]]
line = "key"
[[device.io0.input]]
line = 5
active_low = true
[[device.io0.input]]
line = "door"
bias = "pull_up"
[[device.io0.input]]
line = 7
debounce_s = 0.15
"""
ONLY_OUTPUT = (
    '[workcell]\nname = "gpio"\n[device.io0]\ndriver = "gpio"\nchip = "{chip}"\n[[device.io0.output]]\nline = 0\n'
)


@pytest.fixture
def chip() -> Iterator[SimulatedChip]:
    made = SimulatedChip(NAMES)
    try:
        yield made
    finally:
        made.remove()


@pytest.fixture
def daemon(chip: SimulatedChip) -> Iterator[Daemon]:
    with daemons() as start:
        started = start(CONFIG.format(chip=chip.path))
        started.wait_up("io0")
        yield started


def outputs(chip: SimulatedChip) -> list[int]:
    return [chip.level(line) for line in range(4)]


def test_outputs_and_their_safe_levels(chip: SimulatedChip, daemon: Daemon) -> None:
    assert outputs(chip) == [1, 0, 1, 0], "safe levels from the first moment; line 2 is active at 0 V"
    with gpiod.Chip(str(chip.path)) as seen:
        info = seen.get_line_info(3)
        assert (info.consumer, info.drive) == ("sioms io0", Drive.OPEN_DRAIN)
    with daemon.cell() as cell:
        with cell.open("io0", "rw") as node:
            for value in (0b0110, 0b1001, 0b1111, 0b0000):
                node.set(value)
                assert outputs(chip)[:3] == [value & 1, value >> 1 & 1, 1 - (value >> 2 & 1)]
        wait_for(lambda: outputs(chip) == [1, 0, 1, 0], "safe levels after the writer")
        before = daemon.device("io0")["pid"]
        os.kill(before, signal.SIGKILL)
        daemon.wait_up("io0", 2)
        assert outputs(chip) == [1, 0, 1, 0]
    assert daemon.terminate() == 0


def test_edges_and_when_they_came(chip: SimulatedChip, daemon: Daemon) -> None:
    with daemon.cell() as cell, cell.open("io0.in") as node:
        assert node.read().data[0] == 0b0110, "active-low at 0 V, and the chip's own pull-up"
        assert chip.pulled(6) == 1
        number, before, times = node.read().number, node.read().edges[0], []
        for level in (1, 0, 1):
            time.sleep(PACE_S)
            began_ns = time.monotonic_ns()
            chip.pull(4, level)
            times.append((began_ns, time.monotonic_ns()))
        wait_for(lambda: node.read().edges[0] == before + 3, "three edges")
        changes = [s for s in node.history(number) if s.changed_ns[0] >= times[0][0]]
        stamps = sorted({s.changed_ns[0] for s in changes})
        assert len(stamps) == 3
        for stamp_ns, (began_ns, ended_ns) in zip(stamps, times, strict=True):
            assert began_ns <= stamp_ns <= ended_ns + 20e6, "stamped by the kernel's interrupt, at its next tick"
        chip.pull(5, 1)
        chip.pull(6, 0)
        wait_for(lambda: node.read().data[0] == 0b0001, "active-low, and a button against the pull-up")


def test_bounces_are_swallowed_by_the_kernel(chip: SimulatedChip, daemon: Daemon) -> None:
    with daemon.cell() as cell, cell.open("io0.in") as node:
        edges = node.statistics()["stream"]["edges"]
        for level in (1, 0, 1, 0):
            chip.pull(7, level)
            time.sleep(PACE_S)
        time.sleep(0.3)
        assert node.statistics()["stream"]["edges"] == edges
        chip.pull(7, 1)
        wait_for(lambda: node.read().data[0] & 0b1000, "the level that has stood")
        assert node.statistics()["stream"]["edges"] == edges + 1


def test_lost_edges_are_counted_and_the_level_is_right(chip: SimulatedChip, daemon: Daemon) -> None:
    with daemon.cell() as cell, cell.open("io0.in") as node:
        with daemon.frozen(daemon.device("io0")["pid"]):
            for i in range(11):
                chip.pull(5, i % 2 == 0)
                time.sleep(PACE_S)
        wait_for(lambda: node.statistics()["stream"]["lost_edges"] == 7, "the losses: 11 edges, 4 kept")
        assert not node.read().data[0] & 0b10, "line 5 is high, and active-low"


def holder(path: str, line: int) -> Any:
    return gpiod.request_lines(
        path, consumer="other program", config={line: gpiod.LineSettings(direction=Direction.INPUT)}
    )


def test_a_line_that_another_program_holds(chip: SimulatedChip) -> None:
    with daemons() as start, holder(str(chip.path), 4) as held:
        daemon = start(CONFIG.format(chip=chip.path))
        wait_for(
            lambda: "line 4 (key) is held by other program" in daemon.device("io0")["link_reason"],
            "who holds it",
        )
        held.release()
        daemon.wait_up("io0")
        with pytest.raises(OSError) as refused:
            holder(str(chip.path), 4)
        assert refused.value.errno == errno.EBUSY, "now it is ours"


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('"key"', '"kye"', "no line is named 'kye'; gpioinfo lists the names"),
        ("line = 7", "line = 8", "line 8; it has 8, want 0 to 7"),
        ("line = 7", "line = 4", "line 4 is configured by name and by offset"),
    ],
)
def test_lines_that_are_not_there(chip: SimulatedChip, old: str, new: str, words: str) -> None:
    with daemons() as start:
        daemon = start(CONFIG.format(chip=chip.path).replace(old, new))
        wait_for(lambda: words in daemon.device("io0")["link_reason"], words)


@pytest.mark.parametrize("config", [CONFIG, ONLY_OUTPUT], ids=["inputs and outputs", "outputs alone"])
def test_a_chip_that_is_unplugged_while_it_is_held(chip: SimulatedChip, short_folder: Path, config: str) -> None:
    link = short_folder / "chip"  # as a rule of udev makes one: the number of a chip may change
    link.symlink_to(chip.path)
    with daemons() as start:
        daemon = start(config.format(chip=link))
        daemon.wait_up("io0")
        with daemon.cell() as cell, cell.open("io0", "rw") as node:
            node.set(1)
            chip.unplug()
            wait_for(lambda: daemon.device("io0")["link"] == "link_lost", "the loss")
            with raises(errno.EIO):
                node.set(0)
            chip.plug()
            link.unlink()
            link.symlink_to(chip.path)
            daemon.wait_up("io0")
            assert daemon.device("io0")["generation"] == 1, "the same process"
            node.set(0)
            assert chip.level(0) == 0


def test_the_driver_check() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "sioms.tools.front", "driver", "check", "gpio"],
        capture_output=True,
        text=True,
        timeout=100,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    for trial in ("unplugged", "outputs", "kill driver", "kill daemon"):
        assert f"passed  {trial}" in done.stdout
