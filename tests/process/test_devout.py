"""devout as a process, against a real daemon with simulated axes and outputs."""

from __future__ import annotations

import os
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from daemon_rig import Daemon, axes, daemons, wait_for
from shell_rig import BIN, CELL, Shell, environment, good, halted, refused

import sioms
from sioms.tools.devout import FROZEN_S


@pytest.fixture(scope="module")
def shared_daemon() -> Iterator[Daemon]:
    with daemons() as start:
        yield start(CELL)


@pytest.fixture
def devout(daemon: Daemon) -> Iterator[Callable[..., subprocess.Popen[bytes]]]:
    running: list[subprocess.Popen[bytes]] = []

    def start(*arguments: str, socket: str = daemon.socket) -> subprocess.Popen[bytes]:
        running.append(
            subprocess.Popen(
                [BIN / "devout", *arguments],
                env=environment(socket),
                stdin=subprocess.PIPE,
                stderr=subprocess.PIPE,
                bufsize=0,
            )
        )
        return running[-1]

    yield start
    for one in running:
        one.kill()
        one.communicate()


def feed(process: subprocess.Popen[bytes], text: bytes) -> None:
    assert process.stdin is not None
    process.stdin.write(text)


def moving(cell: sioms.Workcell, speed: float, axis: int = 0) -> None:
    node = cell.open("mod0.readonly")
    wait_for(lambda: abs(node.read().velocity[axis] - speed) < 0.02, f"{speed} m/s")


def test_each_row_takes_over_from_the_last(
    devout: Callable[..., subprocess.Popen[bytes]], cell: sioms.Workcell
) -> None:
    process = devout("-rv", "-L-1", "mod0.xaxis")
    for speed in (0.1, -0.1):
        feed(process, f"{speed} ".encode())
        moving(cell, speed)
    process.communicate()
    assert process.returncode == 0
    halted(cell)


def test_a_killed_devout_leaves_its_axes_halted(
    devout: Callable[..., subprocess.Popen[bytes]], cell: sioms.Workcell
) -> None:
    process = devout("-rv", "-L-1", "mod0.xaxis")
    feed(process, b"0.1 ")
    moving(cell, 0.1)
    process.kill()
    halted(cell)
    cell.open("mod0.xaxis", "w", timeout=5.0).close()


def test_a_bad_number_halts_and_is_named(devout: Callable[..., subprocess.Popen[bytes]], cell: sioms.Workcell) -> None:
    process = devout("-rv", "-L-1", "mod0.xaxis")
    feed(process, b"0.1\n0.1\n")
    moving(cell, 0.1)
    feed(process, b"0.1 o.1 0.1\n")
    _, said = process.communicate(timeout=10)
    assert process.returncode == 1
    assert said.decode() == "devout: line 3: 'o.1' is not a finite number; stopped after 3 complete iterations\n"
    halted(cell)
    cell.open("mod0.xaxis", "w").close()


def test_bad_lines_are_left_out_when_asked(shell: Shell, cell: sioms.Workcell) -> None:
    result = shell("devout --skip-bad-lines -r -L-1 gripper0", "1\nx\n3\n")
    assert (result.returncode, result.stderr) == (
        0,
        "devout: line 2: 'x' is not a finite number; line skipped\n",
    )


@pytest.mark.parametrize("hung", [False, True])
def test_a_lease_halts_when_the_rows_stay_away(
    devout: Callable[..., subprocess.Popen[bytes]], cell: sioms.Workcell, hung: bool
) -> None:
    process = devout("-rv", "-L-1", "--lease=0.4", "mod0.xaxis")
    feed(process, b"0.1 ")
    moving(cell, 0.1)
    if hung:
        process.send_signal(signal.SIGSTOP)
    halted(cell)
    process.send_signal(signal.SIGCONT)
    assert process.wait(10) == 1
    assert process.stderr is not None
    assert process.stderr.read().count(b"\n") == 1


def test_a_devout_that_is_stopped_halts_its_axes(
    devout: Callable[..., subprocess.Popen[bytes]], cell: sioms.Workcell
) -> None:
    """Ctrl-Z, without any option."""
    process = devout("-rv", "-L-1", "mod0.xaxis")
    feed(process, b"0.1 ")
    moving(cell, 0.1)
    process.send_signal(signal.SIGSTOP)
    halted(cell)
    process.send_signal(signal.SIGCONT)
    assert process.wait(10) == 1
    assert process.stderr is not None
    assert b"its client was stopped, as by Ctrl-Z" in process.stderr.read()


def test_a_frozen_devout_is_borne_no_longer_than_the_documents_say() -> None:
    page = (Path(__file__).parents[2] / "docs/pipe-tools.md").read_text()
    assert f"suspended (Ctrl-Z), frozen or swapped out for {FROZEN_S:g} s" in page.replace("\n", " ").replace("  ", " ")


def test_a_devout_that_lives_keeps_all_its_axes(
    devout: Callable[..., subprocess.Popen[bytes]], cell: sioms.Workcell
) -> None:
    """Also when no rows come for longer than a frozen one would be waited for, and while it waits for one of two."""
    process = devout("-rv", "-L-1", "mod0.xaxis", "-v", "mod0.yaxis")
    feed(process, b"0.01 0.01\n0.0")  # with half a number left over
    deadline = time.monotonic() + 1.3 * FROZEN_S
    with cell.open("mod0.readonly") as seen:
        wait_for(lambda: seen.read().in_motion[:2] == (1, 1), "moving")
        while time.monotonic() < deadline:
            assert all(seen.read().in_motion[:2])
            time.sleep(0.05)
    feed(process, b" 0\n")
    process.communicate(timeout=10)
    assert process.returncode == 0
    timed = devout("-pt", "mod0.xaxis", "-pt", "mod0.yaxis", "0.01", str(1.3 * FROZEN_S), "0.01", str(1.4 * FROZEN_S))
    assert timed.wait(20) == 0


def test_a_frozen_devout_halts_its_axes_also_while_the_daemon_hangs(
    devout: Callable[..., subprocess.Popen[bytes]],
) -> None:
    with daemons() as start:
        daemon = start("[workcell]\ndaemon_lease_s = 60\n" + axes("mod0", "xaxis"))
        with daemon.cell() as cell, cell.open("mod0.readonly") as seen:
            process = devout("-rv", "-L-1", "mod0.xaxis", socket=daemon.socket)
            feed(process, b"0.1 ")
            moving(cell, 0.1)
            with daemon.frozen(daemon.pid), daemon.frozen(process.pid):
                wait_for(lambda: not seen.read().in_motion[0], "its lease", 2 * FROZEN_S)


def test_positions_are_waited_for(shell: Shell, cell: sioms.Workcell) -> None:
    good(shell("devout -n2 mod0 0.1"))
    assert abs(cell.open("mod0.readonly").read().position[2] - 0.1) < 1e-3
    good(shell("devout -rw -L-1 mod0.zaxis", "0.05\n0.02\n0\n"))
    assert abs(cell.open("mod0.readonly").read().position[2]) < 1e-3


def test_pieces_with_times_queue_up_and_none_is_lost(shell: Shell, cell: sioms.Workcell) -> None:
    before = cell.open("mod0.readonly").read().position[1]
    # The first piece stands, so that those of a millisecond wait behind it however late they come.
    ramp = [f"{0.2 * i / 100} 0.001\n" for i in range(100)]
    rows = "".join(["0 2\n", *ramp, *["0.2 0.001\n"] * 400, "0 0.2\n"])
    good(shell("devout -rvt -L-1 mod0.yaxis", rows))
    moved = cell.open("mod0.readonly").read().position[1] - before
    assert abs(moved - (0.01 + 0.08 + 0.2**2 / 2 / 10)) < 0.003  # ramp, run, and the way of braking


def test_input_that_ends_within_an_iteration(shell: Shell) -> None:
    refused(shell("devout -r -L-1 mod0", "0 0 0 0\n0 0\n"), "line 2", "2 of the 4 numbers", "after 1 complete")


def test_one_iteration_without_r_and_as_many_as_said(shell: Shell) -> None:
    assert good(shell("(devout gripper0; cat) | wc -l", "1\n" + "0\n" * 100000)) != "0\n"
    good(shell("devout -r -L2 gripper0", "1 2 this is not read"))


def test_the_daemons_death_ends_devout(
    start_daemon: Callable[..., Daemon], devout: Callable[..., subprocess.Popen[bytes]]
) -> None:
    mine = start_daemon()
    process = devout("-rv", "-L-1", "mod0.xaxis", socket=mine.socket)
    feed(process, b"0.1 ")
    with mine.cell() as cell:
        node = cell.open("mod0.readonly")
        wait_for(lambda: node.read().velocity[0] > 0.05, "motion")
    os.kill(mine.pid, signal.SIGKILL)
    assert process.wait(10) == 1  # while its input is silent
    assert process.stderr is not None
    assert process.stderr.read().count(b"\n") == 1


def test_numbers_that_would_be_lost_are_refused(shell: Shell, cell: sioms.Workcell) -> None:
    refused(shell("devout mod0.xaxis 0.1 0.2"), "2 numbers; an iteration takes 1", status=2)
    refused(shell("devout -L2 mod0.xaxis 0.1 0.2 0.3"), "2 iterations take 2", status=2)
    with cell.open("mod0.readonly") as node:
        assert not any(node.read().in_motion)


def test_outputs_are_held_until_an_interrupt(shell: Shell, cell: sioms.Workcell) -> None:
    with cell.open("gripper0.readonly") as node:
        result = shell("devout gripper0 1")
        assert result.returncode == 0 and "-H holds what was written" in result.stderr
        wait_for(lambda: node.read().data[0] == 0, "safe again")
        holding = subprocess.Popen(
            ["bash", "-c", "exec devout -H gripper0 1"],
            env=environment(shell("echo $SIOMS_SOCKET").stdout.strip()),
        )
        try:
            wait_for(lambda: node.read().data[0] == 1, "closed")
            time.sleep(0.5)
            assert node.read().data[0] == 1 and holding.poll() is None
        finally:
            holding.send_signal(signal.SIGINT)
            assert holding.wait(10.0) == -signal.SIGINT
        wait_for(lambda: node.read().data[0] == 0, "open again")
