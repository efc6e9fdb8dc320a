"""Rig for tests of the tools as processes: the workcell they work in, and lines of bash with them on their path."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

from daemon_rig import FORCE, axes, wait_for

import sioms

BIN = Path(sys.prefix) / "bin"
CELL = (
    '[workcell]\nname = "tools"\n'
    + axes("mod0", "xaxis", "yaxis", "zaxis", "taxis")
    + axes("mod1", "xaxis")
    + FORCE.replace("force0", "lord1")
    + '\n[device.gripper0]\ndriver = "sim-io"\noutputs = 8\nsafe = 0\n'
    + '\n[device.tactile0]\ndriver = "sim-tactile"\n'
    + '\n[node.atod0]\nof = "lord1"\nchannels = ["fx"]\n'
)
Shell = Callable[..., "subprocess.CompletedProcess[str]"]


def environment(socket: str) -> dict[str, str]:
    return {**os.environ, "SIOMS_SOCKET": socket, "PATH": f"{BIN}:{os.environ['PATH']}"}


def run_line(line: str, text: str, socket: str, folder: Path) -> subprocess.CompletedProcess[str]:
    """Run a line of bash with the tools on its path and a text on its standard input."""
    return subprocess.run(
        ["bash", "-c", line], input=text, capture_output=True, text=True, cwd=folder,
        env=environment(socket), timeout=30,
    )  # fmt: skip


def good(result: subprocess.CompletedProcess[str]) -> str:
    assert (result.returncode, result.stderr) == (0, "")
    return result.stdout


def refused(result: subprocess.CompletedProcess[str], *words: str, status: int = 1) -> str:
    """Check that it failed with one line on stderr that says these words, and with nothing on stdout."""
    assert result.returncode == status, result.stderr
    assert result.stderr.count("\n") == 1, result.stderr
    assert "Traceback" not in result.stderr
    for word in words:
        assert word in result.stderr
    return result.stderr


def halted(cell: sioms.Workcell, name: str = "mod0") -> None:
    node = cell.open(f"{name}.readonly")
    wait_for(lambda: not any(node.read().in_motion), f"{name} at rest")
