"""Rig for drivers of own-loop drives under the real daemon: a simulated device as a process, a daemon, a client."""

from __future__ import annotations

import json
import re
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from daemon_rig import wait_for

import sioms
from sioms.protocol.flags import AxisStatus

LATE_S = 2.0
"""How late readings may get on a busy machine before they count as none [s]."""
SLIDE = """
[device.slide0]
driver = "modbus-axis"
map = "leadshine"
line = { serial = "{port}", baud = 115200 }
[[device.slide0.axis]]
name = "x"
unit = "m"
velocity_by = "path"
travel_per_turn = 0.01
velocity_max = 0.1
acceleration_max = 2.0
"""
"""One Leadshine drive that goes on to the end of its path by itself: only a stop that is sent can end it early."""


@dataclass(frozen=True)
class Misfit:
    """A device that a driver must refuse.

    Attributes:
        words: of the sentence that says why.
        options: of the simulator.
        change: a command to it before the daemon starts.
        axis: that is in fault with these words, in a device that is up otherwise.
    """

    words: str
    options: tuple[str, ...] = ()
    change: str = ""
    axis: str = ""


def check_misfits(
    start: Callable[..., Any], folder: Path, name: str, config: str, misfits: Sequence[Misfit], *given: str
) -> None:
    """Give one daemon a device for each misfit, all of one configuration: each is refused with its sentence.

    Args:
        start: starts processes that end with the test.
        folder: a short path.
        name: of the simulator's module.
        config: table of the device, whatever its name; ``{port}`` is the simulator's port.
        misfits: to be tried, in parallel.
        given: options of all simulators.
    """
    commands = [
        (
            sys.executable,
            "-m",
            f"sioms.drivers.{name}",
            "--link",
            str(folder / f"p{i}"),
            *given,
            *misfit.options,
        )
        for i, misfit in enumerate(misfits)
    ]
    devices = [start(command) for command in commands]
    device = re.findall(r"\[device\.(\w+)\]", config)[0]
    text = '[workcell]\nname = "misfits"\n'
    for i, (process, misfit) in enumerate(zip(devices, misfits, strict=True)):
        process.wait_line("^ready ")
        if misfit.change:
            process.process.stdin.write(misfit.change + "\n")
            process.process.stdin.flush()
            process.wait_line("^ok")
        text += config.replace("{port}", str(folder / f"p{i}")).replace(f"device.{device}", f"device.d{i}")
    path, socket = folder / "misfits.toml", str(folder / "m")
    path.write_text(text)
    daemon = start([sys.executable, "-m", "sioms.daemon.main", "--config", str(path), "--socket", socket])
    daemon.wait_line("event=ready", 40.0)
    with sioms.Workcell(socket) as cell:
        for i, misfit in enumerate(misfits):
            _check_misfit(cell, i, misfit)


def _check_misfit(cell: sioms.Workcell, i: int, misfit: Misfit) -> None:
    told = lambda: str(cell.status()["devices"][i])  # noqa: E731
    if not misfit.axis:
        wait_for(lambda: misfit.words in told(), f"the sentence {misfit.words!r}; {told()}")
        with pytest.raises(OSError, match=f"d{i}"), cell.open(f"d{i}.readonly") as opened:
            opened.read()
        return
    wait_for(lambda: "'link': 'good'" in told(), f"d{i} up")
    with cell.open(f"d{i}.{misfit.axis}", "rw") as node:
        wait_for(lambda: node.read().status[0] & AxisStatus.FAULT, "the fault")
        with pytest.raises(OSError, match=misfit.words):
            node.command(position=1.0)


class Wire:
    """A simulator behind a link in a folder, and what a test does with it.

    Args:
        start: starts processes that end with the test.
        folder: a short path.
        name: of the simulator's module.
        options: of the simulator; without ``--tcp`` or ``--port`` it serves the link ``folder/port``.
    """

    def __init__(self, start: Callable[..., Any], folder: Path, name: str, *options: object) -> None:
        self._start, self.folder = start, folder
        port = () if {"--tcp", "--port"}.intersection(options) else ("--link", folder / "port")
        command = [sys.executable, "-m", f"sioms.drivers.{name}", *port, *options]
        self.device = start([str(part) for part in command])
        self.port: str = self.device.wait_line(r"^ready (\S+)$").group(1)
        self.socket = str(folder / "s")

    def tell(self, line: str) -> Any:
        """Send a command to the simulator and return its answer's value."""
        before = len(self.device.lines)
        self.device.process.stdin.write(line + "\n")
        self.device.process.stdin.flush()
        wait_for(lambda: len(self.device.lines) > before, f"an answer to {line}", 5.0)
        answer = self.device.lines[before]
        assert answer.startswith("ok"), answer
        return json.loads(answer[3:]) if answer[3:] else None

    def state(self, key: str, axis: object = "") -> Any:
        """Return one number of what a bystander sees."""
        return self.tell(f"state {axis}".rstrip())[key]

    def serve(self, config: str) -> sioms.Workcell:
        """Start the daemon with the tables of devices; ``{port}`` is the simulator's port."""
        path = self.folder / "cell.toml"
        path.write_text('[workcell]\nname = "wire"\n' + config.replace("{port}", self.port))
        command = [sys.executable, "-m", "sioms.daemon.main", "--config", path, "--socket", self.socket]
        self.daemon = self._start([str(part) for part in command])
        self.daemon.wait_line("event=ready", 40.0)
        self.client = sioms.Workcell(self.socket)
        return self.client

    def reads(self, node: str) -> bool:
        """Tell whether a node can be read; one whose readings are only late is waited for."""
        deadline = time.monotonic() + LATE_S
        while True:
            try:
                with self.client.open(self.reader(node)) as opened:
                    opened.read()
                return True
            except OSError as error:
                if "gone or hung" not in str(error) or time.monotonic() > deadline:
                    return False
            time.sleep(0.01)

    def reader(self, node: str) -> str:
        """Return the name under which a node is read without owning it."""
        return node if self.client.info(node).read_only else f"{node}.readonly"

    def wait_up(self, node: str) -> None:
        """Wait until a node can be read."""
        wait_for(lambda: self.reads(node), f"{node} readable; the daemon said {self.daemon.lines[-5:]}")

    def reason(self, device: str) -> str:
        """Return what the daemon says of a device's link."""
        found = next(each for each in self.client.status()["devices"] if each["name"] == device)
        return str(found)

    def pid(self, device: str) -> int:
        """Return the process of a driver."""
        return int(next(each for each in self.client.status()["devices"] if each["name"] == device)["pid"] or 0)
