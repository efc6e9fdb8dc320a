"""The compiled devout does and says what the tool in Python does and says."""

from __future__ import annotations

import os
import re
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from daemon_rig import FORCE, Daemon, axes, daemons, wait_for

import sioms
from sioms.native.language import LIBRARY

TOOL = Path(sys.prefix) / "bin" / "devout"
PROGRAM = LIBRARY.with_name("_devout")
CELL = (
    '[workcell]\nname = "tools"\n'
    + axes("mod0", "xaxis", "yaxis", "zaxis")
    + FORCE.replace("force0", "lord1")
    + '\n[device.gripper0]\ndriver = "sim-io"\noutputs = 8\nsafe = 0xa5\n'
)
LINES = """
mod0.xaxis 0.001|mod0.xaxis -W 1e-3|-tp mod0.xaxis +.001 5E-2|-n1 mod0 0.001|-l1h2 mod0 0 0.001|-vW mod0.xaxis 0.1
-vt mod0.yaxis -0.1 0.02|-vt mod0.yaxis 0.1 -1|-jW mod0.xaxis 0.5|-fW mod0.xaxis 0.5|-poW mod0.xaxis 0 0.1
0 mod0.xaxis|gripper0 7|gripper0.bit0 1|gripper0 1.5|gripper0 300|gripper0 1e17|-p gripper0 1
mod0.xaxis 9|-pm mod0.xaxis 0.1 3.5|-pm mod0.xaxis 0.1 1023|-ps mod0.xaxis 0.1 77777|lord1 1
mod0.readonly 0.1|nothing 0.1|mod0.xaxis 0.1 0.2|mod0 0.1
-n9 mod0 1|-n1h2 mod0 1|mod0.xaxis 1_0|mod0.xaxis 1e999|mod0.xaxis nan|mod0.xaxis 1e|mod0.xaxis 0 -p|-rL2 mod0.xaxis 0 0
--lease=1 mod0.xaxis 0|mod0.xaxis mod0.yaxis 0 0|\u00e9 1
"""


@pytest.fixture(scope="module")
def shared_daemon() -> Iterator[Daemon]:
    if not PROGRAM.exists():
        pytest.skip("nothing is compiled here: ./dev setup says why")
    with daemons() as start:
        yield start(CELL)


@pytest.fixture
def cell(daemon: Daemon) -> Iterator[sioms.Workcell]:
    with sioms.Workcell(daemon.socket) as connected:
        yield connected
        if connected.status()["stopped_ns"]:
            connected.reset()


def environment(daemon: Daemon, compiled: bool) -> dict[str, str]:
    return {**os.environ, "SIOMS_SOCKET": daemon.socket, "SIOMS_UNCOMPILED": "" if compiled else "1"}


def outcome(daemon: Daemon, node: sioms.AxisNode, words: list[str], compiled: bool) -> tuple[object, list[float]]:
    """Run a line; return status and what it said, and where the axes are then."""
    env = environment(daemon, compiled)
    done = subprocess.run([TOOL, *words], env=env, stdin=subprocess.DEVNULL, capture_output=True, timeout=30)
    wait_for(lambda: not any(node.read().in_motion), "the axes at rest")
    return (done.returncode, done.stdout, done.stderr), list(node.read().position)


@pytest.mark.parametrize("line", LINES.strip().replace("\n", "|").split("|"))
def test_a_line_does_the_same_either_way(daemon: Daemon, cell: sioms.Workcell, line: str) -> None:
    words = line.split()
    with cell.open("mod0.readonly") as node:
        found = [outcome(daemon, node, words, compiled) for compiled in (True, False)]
    assert found[0][0] == found[1][0]
    if found[0][0] == (0, b"", b"") and not re.search("W|v|-1", line):
        assert found[0][1] == pytest.approx(found[1][1], abs=3e-4)


def start(daemon: Daemon, compiled: bool, axis: str = "mod0.xaxis") -> subprocess.Popen[bytes]:
    """Start a devout that moves an axis for as long as a busy machine may need to start another."""
    process = subprocess.Popen(
        [TOOL, "-vt", axis, "0.005", "60"], env=environment(daemon, compiled), stderr=-1, stdin=-3
    )
    with sioms.Workcell(daemon.socket) as cell, cell.open(axis + ".readonly") as node:
        wait_for(lambda: node.read().in_motion[0], "the axis in motion")
    assert (os.path.realpath(f"/proc/{process.pid}/exe") == str(PROGRAM)) == compiled
    assert Path(f"/proc/{process.pid}/comm").read_text() == ("devout\n" if compiled else "python3\n")
    return process


def both(daemon: Daemon) -> list[subprocess.Popen[bytes]]:
    return [start(daemon, True), start(daemon, False, "mod0.yaxis")]


def said_alike(running: list[subprocess.Popen[bytes]]) -> str:
    """Return what both say when they end, the axis left out."""
    said = [re.sub(r"[xy]axis|axis [01]", "AXIS", p.communicate(timeout=10)[1].decode()) for p in running]
    assert [p.returncode for p in running] == [1, 1], said
    assert said[0] == said[1] and said[0].count("\n") == 1
    return said[0]


def test_a_stop_ends_both_with_one_sentence(daemon: Daemon, cell: sioms.Workcell) -> None:
    running = both(daemon)
    cell.emergency_stop()
    assert "emergency stop" in said_alike(running)
    refused = []
    for compiled in (True, False):
        words = [TOOL, "mod0.xaxis", "0.1"]
        refused.append(subprocess.run(words, env=environment(daemon, compiled), capture_output=True, timeout=30))
    assert refused[0].stderr == refused[1].stderr and b"reset first" in refused[0].stderr


def test_a_signal_ends_it_without_a_word_and_its_axis_halts(daemon: Daemon, cell: sioms.Workcell) -> None:
    process = start(daemon, True)
    process.send_signal(signal.SIGTERM)
    assert process.communicate(timeout=5)[1] == b"" and process.returncode == -signal.SIGTERM
    with cell.open("mod0.readonly") as node:
        wait_for(lambda: not node.read().in_motion[0], "the axis at rest")


def test_one_that_is_stopped_loses_its_axis_and_says_so(daemon: Daemon, cell: sioms.Workcell) -> None:
    running = both(daemon)
    for process in running:
        process.send_signal(signal.SIGSTOP)
    with cell.open("mod0.readonly") as node:
        wait_for(lambda: not any(node.read().in_motion), "the axes at rest")
    for process in running:
        process.send_signal(signal.SIGCONT)
    assert "its client was stopped, as by Ctrl-Z" in said_alike(running)


def test_one_that_waits_keeps_its_lease_until_its_driver_dies(daemon: Daemon, cell: sioms.Workcell) -> None:
    running = both(daemon)
    time.sleep(2.1)  # longer than the lease
    with cell.open("mod0.readonly") as node:
        assert node.read().in_motion[:2] == (1, 1)
    pid = daemon.device("mod0")["pid"]
    os.kill(pid, signal.SIGKILL)
    assert said_alike(running).startswith("devout: ")
    wait_for(lambda: daemon.device("mod0")["pid"] not in (0, pid), "mod0 again")
    daemon.wait_up("mod0")


def test_a_daemon_that_hangs_is_told_before_and_after_the_motion(daemon: Daemon) -> None:
    running, asked = both(daemon), []
    with daemon.frozen(daemon.pid):
        for compiled in (True, False):
            words = [TOOL, "mod0.zaxis", "0.001"]
            asked.append(subprocess.Popen(words, env=environment(daemon, compiled), stderr=-1, stdin=-3))
        told = said_alike(running)
        said = [p.communicate(timeout=15)[1] for p in asked]
    assert told == "devout: close: the daemon does not answer; is its process hung?\n"
    assert said[0] == said[1] and b"hung" in said[0]


NATIVE = (
    "-W mod0.xaxis 0",
    "-pt mod0.xaxis 0 0.01",
    "-vW mod0.yaxis 0.01",
    "-n1 mod0 0",
    "gripper0 165",
    "mod0.xaxis 9",
)
LEFT = (
    "mod0.xaxis",
    "-r mod0.xaxis 0",
    "mod0.xaxis 0 0",
    "mod0.xaxis mod0.yaxis 0 0",
    "--wait mod0.xaxis 0",
    "nothing 0",
)


def test_the_usual_lines_need_no_interpreter_and_others_are_given_to_it_whole(daemon: Daemon) -> None:
    for line in (*NATIVE, *LEFT):
        words = ["/bin/echo", "-", "-", "-", "program", "devout", "self", *line.split()]
        done = subprocess.run(
            [PROGRAM, *words], env=environment(daemon, True), capture_output=True, text=True, timeout=30
        )
        assert (done.stdout == "") == (line in NATIVE), done
        assert line in NATIVE or done.stdout == f"- - - program devout self {line}\n"


@pytest.mark.parametrize("closed", ["<&-", "2>&-", "<&- >&- 2>&-", "2>/dev/full"])
def test_closed_descriptors_change_nothing_but_what_is_said(daemon: Daemon, closed: str) -> None:
    found = []
    for compiled in (True, False):
        tool = shlex.quote(str(TOOL))
        line = f"{tool} mod0.xaxis 9 {closed}; echo $? >&3; {tool} -W mod0.xaxis 0 {closed}; echo $? >&3"
        done = subprocess.run(
            ["sh", "-c", f"exec 3>&1; {line}"], env=environment(daemon, compiled), stdout=-1, stderr=-1
        )
        found.append((done.stdout, done.stderr))
    assert found[0] == found[1] and found[0][0] == b"1\n0\n"
