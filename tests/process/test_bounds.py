"""Bounds and latches that one client could else get around."""

from __future__ import annotations

import errno
import os
import resource
import signal
import subprocess
import sys
import threading
import time

import pytest
from daemon_rig import Daemon, raises, wait_for

import sioms


def test_emergency_stop_of_an_output_latches_until_reset(daemon: Daemon, cell: sioms.Workcell) -> None:
    with cell.open("io0", "rw") as outputs:
        outputs.set(0b101)
        cell.emergency_stop("io0.readonly")
        wait_for(lambda: outputs.read().data[0] == 0, "outputs safe")
        with raises(errno.EPERM, "emergency stop", "reset"):
            outputs.set(1)
        cell.reset("io0.readonly")
        wait_for(lambda: _takes(outputs), "writes taken after the reset")


def _takes(node: sioms.BinaryNode) -> bool:
    try:
        node.set(1)
    except OSError:
        return False
    return True


def test_reset_of_a_node_says_so_when_the_workcell_is_stopped(daemon: Daemon, cell: sioms.Workcell) -> None:
    cell.emergency_stop(why="test")
    try:
        with raises(errno.EPERM, "whole workcell is stopped"):
            cell.reset("mod0")
    finally:
        cell.reset()


def test_a_client_for_whom_there_is_no_descriptor_is_told_so_and_others_can_stop(
    daemon: Daemon, cell: sioms.Workcell
) -> None:
    axis = cell.open("mod0", "rw")
    axis.command(velocity=0.01)
    most = resource.prlimit(daemon.pid, resource.RLIMIT_NOFILE)
    now = len(os.listdir(f"/proc/{daemon.pid}/fd"))
    resource.prlimit(daemon.pid, resource.RLIMIT_NOFILE, (now + 6, most[1]))
    cells: list[sioms.Workcell] = []
    try:
        for _ in range(2):  # also when it has been told once
            with raises(errno.EUSERS, "too many open files in the daemon; raise LimitNOFILE"):
                for _ in range(8):
                    cells.append(sioms.Workcell(daemon.socket))
        assert axis.read()[0].in_motion
        cell.emergency_stop(why="no descriptors")
    finally:
        resource.prlimit(daemon.pid, resource.RLIMIT_NOFILE, most)
        for other in cells:
            other.close()
    wait_for(lambda: not axis.read()[0].in_motion, "rest")
    cell.reset()
    sioms.Workcell(daemon.socket).close()
    axis.close()


def test_persisting_markers_are_bounded(daemon: Daemon, cell: sioms.Workcell) -> None:
    markers = cell.reserve_markers(512, persist=True)  # four times as many as the quota, for the daemon's own user
    try:
        with sioms.Workcell(daemon.socket) as other, raises(errno.EBUSY, "has 512 markers"):
            other.reserve_markers(1, persist=True)
    finally:
        for marker in markers:
            marker.free()


def test_replace_overtakes_a_write_that_waits_for_room(daemon: Daemon, cell: sioms.Workcell) -> None:
    gate = cell.reserve_marker()
    with cell.open("mod0.xaxis", "rw") as axis:
        room = axis.room()
        axis.write([sioms.command(position=0.0, wait=gate), *[sioms.command(position=0.0)] * (room - 1)])
        outcome: list[int | None] = []

        def write() -> None:
            try:
                axis.move(0.1, timeout=20.0)
                outcome.append(None)
            except OSError as error:
                outcome.append(error.errno)

        thread = threading.Thread(target=write, daemon=True)
        thread.start()
        wait_for(lambda: _full(axis), "a write that waits")
        axis.move(0.02, replace=True)
        thread.join(5.0)
        assert outcome == [errno.ECANCELED]
        axis.wait_until_idle(5.0)
        assert axis.read().position[0] == pytest.approx(0.02, abs=2e-3)


def _full(axis: sioms.AxisNode) -> bool:
    """Tell whether an earlier write waits for room: one that does not wait is refused behind it."""
    try:
        axis.move(0.0)
    except OSError as error:
        return error.errno == errno.EAGAIN and "earlier write" in str(error)
    return False


def test_an_interrupted_open_does_not_keep_the_node(daemon: Daemon, cell: sioms.Workcell) -> None:
    code = (
        "import sioms, time\n"
        "cell = sioms.Workcell()\n"
        "try:\n"
        "    print('waiting', flush=True)\n"
        "    cell.open('mod0', 'rw', timeout=None)\n"
        "except KeyboardInterrupt:\n"
        "    print('interrupted', flush=True)\n"
        "time.sleep(60)\n"
    )
    with cell.open("mod0", "rw"):
        child = subprocess.Popen(
            [sys.executable, "-c", code], stdout=subprocess.PIPE, text=True,
            env=dict(os.environ, SIOMS_SOCKET=daemon.socket),
        )  # fmt: skip
        assert child.stdout is not None
        try:
            child.stdout.readline()
            wait_for(lambda: any(s[2] for s in cell.status()["sessions"]), "an open that waits")
            child.send_signal(signal.SIGINT)
            assert child.stdout.readline() == "interrupted\n"
            wait_for(lambda: not any(s[2] for s in cell.status()["sessions"]), "the open cancelled")
        except BaseException:
            child.kill()
            raise
    try:
        began = time.monotonic()
        cell.open("mod0", "rw", timeout=3.0).close()
        assert time.monotonic() - began < 2.0
    finally:
        child.kill()
