"""What a program starts ends with it: told to end, or killed."""

from __future__ import annotations

import ast
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from daemon_rig import wait_for

from sioms.children import KEPT, Process
from sioms.descriptors import is_readable

TREE = Path(__file__).resolve().parents[2]
PARENT = """
import subprocess, sys, time
from sioms.children import ends_with_us
child = subprocess.Popen([sys.executable, "-IS", "-c", "import time; time.sleep(60)"], preexec_fn=ends_with_us())
print(child.pid, flush=True)
time.sleep(60)
"""
COMMAND = """
import sys, time
from sioms.tools import front
front._begin()
try:
    print("ready", flush=True)
    time.sleep(60)
finally:
    print("in order", flush=True)
"""


@pytest.mark.parametrize("state", ["runs", "is stopped", "does not listen"])
def test_a_child_ends_with_a_parent_that_is_killed(state: str) -> None:
    ignores = "import signal; signal.signal(signal.SIGTERM, signal.SIG_IGN); " if state == "does not listen" else ""
    program = PARENT.replace('"import time', f'"{ignores}import time')
    with subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout is not None
        pid = int(parent.stdout.readline())
        child = os.pidfd_open(pid)
        if state == "is stopped":
            os.kill(pid, signal.SIGSTOP)
        parent.kill()
        parent.wait()
        assert is_readable(child, 30.0), "the child lives on"
    os.close(child)


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_a_command_that_is_told_to_end_puts_things_in_order(number: signal.Signals) -> None:
    kept = signal.signal(number, signal.SIG_DFL)  # what nohup ignores, its commands go on ignoring
    try:
        command = subprocess.Popen([sys.executable, "-c", COMMAND], stdout=subprocess.PIPE, text=True)
    finally:
        signal.signal(number, kept)
    with command:
        assert command.stdout is not None and command.stdout.readline() == "ready\n"
        command.send_signal(number)
        assert (command.stdout.read(), command.wait(30.0)) == ("in order\n", 128 + number)


SIMULATED = """
import sys, time
from sioms.check.station import Peer
device = Peer(sys.argv[1:], "a simulated device")
print(device.pid, flush=True)
time.sleep(60)
"""


@pytest.mark.parametrize("stopped", [False, True])
def test_a_simulated_device_ends_with_a_check_that_is_killed(stopped: bool) -> None:
    """A check stops the processes of some trials; one that is stopped takes no SIGTERM and sees no end of file."""
    device = [sys.executable, "-P", "-m", "sioms.drivers.modbus.simulated.leadshine"]
    with subprocess.Popen(
        [sys.executable, "-P", "-c", SIMULATED, *device], stdout=subprocess.PIPE, text=True
    ) as parent:
        assert parent.stdout is not None
        pid = int(parent.stdout.readline())
        child = os.pidfd_open(pid)
        if stopped:
            os.kill(pid, signal.SIGSTOP)
        parent.kill()
        parent.wait()
        assert is_readable(child, 30.0), "the device lives on"
    os.close(child)


def test_everything_that_a_tool_starts_ends_with_it() -> None:
    loose = []
    for path in (path for folder in ("sioms", "tools") for path in (TREE / folder).rglob("*.py")):
        text = path.read_text()
        for node in ast.walk(ast.parse(text if "subprocess.Popen" in text else "")):
            starts = isinstance(node, ast.Call) and ast.unparse(node.func) == "subprocess.Popen"
            if starts and "preexec_fn" not in [keyword.arg for keyword in node.keywords]:
                loose.append(f"{path.name}:{node.lineno}")
    assert not loose, "started without ends_with_us()"


def test_of_what_a_child_says_the_last_lines_are_kept() -> None:
    """A gateway that logs each session would be a leak of who started it."""
    child = Process(["timeit", "-n1", "-r1", f"for i in range({3 * KEPT}): print('ready', i)"], "ready")
    child._process.wait(30.0)
    wait_for(lambda: child.ready_line.startswith("1 loop"), "its last line")
    assert len(child.said) == KEPT and child._heard.qsize() <= 2
