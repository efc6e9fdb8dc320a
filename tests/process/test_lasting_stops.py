"""A stop outlives everything: drivers, the daemon, a reload, a restart of the machine; and it is there at once."""

from __future__ import annotations

import contextlib
import errno
import os
import re
import shutil
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from daemon_rig import IO, Daemon, axes, has_ended, raises, wait_for

import sioms
from sioms.protocol.flags import AxisStatus
from sioms.protocol.stopfile import open_stop_request
from sioms.tools.cell import troubles

CELL = '[workcell]\nname = "test"\n' + axes("mod0", "xaxis", "yaxis") + IO


STOPPED = AxisStatus.EMERGENCY_STOP | AxisStatus.STOPPING


def kill(daemon: Daemon) -> None:
    """SIGKILL to the daemon and, at the same time, to all its drivers and its fork server."""
    pids = [device["pid"] for device in status(daemon)["devices"]] + [daemon.fork_server(), daemon.pid]
    for pid in pids:
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
    daemon.running.wait_exit(10.0)


def status(daemon: Daemon) -> dict[str, Any]:
    with daemon.cell() as cell:
        found: dict[str, Any] = cell.status()
        return found


def is_refused(daemon: Daemon, node: str, **move: float) -> None:
    """See that a node takes nothing, and who is told to have stopped it."""
    with (
        daemon.cell() as cell,
        cell.open(node, "rw", timeout=5.0) as opened,
        raises(errno.EPERM, "emergency stop"),
    ):
        if isinstance(opened, sioms.AxisNode):
            opened.move(0.01)
        else:
            opened.set(1)  # type: ignore[attr-defined]


def works(daemon: Daemon) -> None:
    with (
        daemon.cell() as cell,
        cell.open("mod0.xaxis", "rw", timeout=5.0) as axis,
        cell.open("io0", "rw") as io,
    ):
        axis.move(axis.read().position[0] + 0.002)
        axis.wait_until_idle(10.0)
        io.set(3)


@pytest.mark.parametrize("through", ["daemon", "handle"])
def test_the_stop_of_a_node_outlives_its_driver(start_daemon: Callable[..., Daemon], through: str) -> None:
    daemon = start_daemon(CELL)
    with daemon.cell("loader") as cell:
        for node in ("mod0.xaxis", "io0.bit1"):
            if through == "daemon":
                cell.emergency_stop(node, why="hand in there")
            else:
                with cell.open(node, "rw") as opened:
                    opened.emergency_stop()
    wait_for(lambda: len(status(daemon)["node_stops"]) == 2, "both are told")
    for name in ("mod0", "io0"):
        before = daemon.device(name)
        os.kill(before["pid"], signal.SIGKILL)
        daemon.wait_up(name, before["generation"] + 1)
    is_refused(daemon, "mod0.xaxis")
    is_refused(daemon, "io0.bit1")
    with (
        daemon.cell() as cell,
        cell.open("mod0.yaxis", "rw") as other,
        cell.open("io0.bit0", "rw") as bit,
    ):
        other.move(0.002)  # nobody has stopped these
        bit.set(1)
        other.wait_until_idle(5.0)
    assert any("mod0.xaxis: emergency stop by" in line for line in troubles(status(daemon)))
    with daemon.cell() as cell:
        cell.reset("mod0.xaxis")
        cell.reset("io0.bit1")
    assert status(daemon)["node_stops"] == []
    works(daemon)


def test_all_stops_outlive_the_daemon_and_its_drivers(start_daemon: Callable[..., Daemon]) -> None:
    daemon = start_daemon(CELL)
    with daemon.cell("loader") as cell:
        cell.emergency_stop("mod0.yaxis")
        cell.emergency_stop(why="smoke")
    kill(daemon)
    again = start_daemon(CELL, at=daemon.folder)
    found = status(again)
    assert found["stopped_ns"] and re.search(r"loader: smoke \(since 20\d\d-", found["stop_source"])
    assert [node for node, _ in found["node_stops"]] == ["mod0.yaxis"]
    is_refused(again, "mod0.xaxis")
    is_refused(again, "io0")
    with again.cell() as cell:
        cell.reset()
    works(again)
    kill(again)
    third = start_daemon(CELL, at=daemon.folder)
    assert not status(third)["stopped_ns"] and not status(third)["node_stops"]
    works(third)
    kill(third)
    stops = Path(daemon.socket + ".stops")
    stops.write_text(stops.read_text() + '{"node":"mod0","device":"mod0","block":"","parts":[[0,1e9,1]],"stop":true}\n')
    Path(f"{stops}.alarms").write_text("[" * 100_000)
    fourth = start_daemon(CELL, at=daemon.folder)  # what is damaged keeps nobody from starting, stopped
    assert "journal of stops, which is damaged" in status(fourth)["stop_source"]
    is_refused(fourth, "mod0.xaxis")
    with fourth.cell() as cell:
        assert not cell.alarms()
        cell.reset()
    works(fourth)


def test_an_orderly_end_keeps_the_stop_too(start_daemon: Callable[..., Daemon]) -> None:
    daemon = start_daemon(CELL)
    with daemon.cell() as cell:
        cell.emergency_stop("mod0")
    assert daemon.terminate() == 0
    again = start_daemon(CELL, at=daemon.folder)
    is_refused(again, "mod0")
    with again.cell() as cell:
        cell.reset("mod0")
    works(again)
    assert again.terminate() == 0
    assert not list(again.folder.glob("d.sock*")), "nothing is left where nothing is stopped"


def test_a_stop_survives_a_boot_where_there_is_a_state_folder(
    start_daemon: Callable[..., Daemon], tmp_path: Path
) -> None:
    text = CELL.replace('name = "test"', f'name = "test"\nstate_folder = "{tmp_path / "state"}"')
    daemon = start_daemon(text)
    with daemon.cell() as cell:
        cell.emergency_stop(why="before the boot")
    kill(daemon)
    for left in daemon.folder.glob("d.sock*"):  # /run is empty after a boot
        left.unlink()
    again = start_daemon(text, at=daemon.folder)
    assert "before the boot" in status(again)["stop_source"]
    shutil.rmtree(tmp_path / "state")


def test_a_stopped_node_is_stopped_after_a_reload_of_its_device(start_daemon: Callable[..., Daemon]) -> None:
    daemon = start_daemon(CELL)
    with daemon.cell() as cell:
        cell.emergency_stop("mod0.xaxis")
        daemon.configure(CELL.replace("capacity = 16384", "capacity = 8192"))
        cell.reload()
    daemon.wait_up("mod0")
    is_refused(daemon, "mod0.xaxis")


def test_a_node_whose_driver_is_away_is_stopped_when_it_comes(start_daemon: Callable[..., Daemon]) -> None:
    daemon = start_daemon(CELL)
    with daemon.cell() as cell:
        before = daemon.device("mod0")
        with daemon.frozen(daemon.fork_server()):
            os.kill(before["pid"], signal.SIGKILL)
            wait_for(lambda: daemon.device("mod0")["state"] != "up", "noticed")
            cell.emergency_stop("mod0.xaxis")
        daemon.wait_up("mod0", before["generation"] + 1)
        is_refused(daemon, "mod0.xaxis")
        cell.reset("mod0.xaxis")


def test_a_request_that_nobody_lived_to_hear_stops_the_next_daemon(
    start_daemon: Callable[..., Daemon],
) -> None:
    daemon = start_daemon(CELL)
    request = open_stop_request(daemon.socket)
    assert request is not None
    kill(daemon)
    word = request.request(time.monotonic_ns(), os.getpid(), "too late for anybody")
    assert not request.taken(word)
    again = start_daemon(CELL, at=daemon.folder)
    assert "too late for anybody" in status(again)["stop_source"]
    is_refused(again, "mod0.xaxis")


def test_a_reset_does_not_swallow_a_stop_that_nobody_has_heard_yet(
    start_daemon: Callable[..., Daemon],
) -> None:
    daemon = start_daemon(CELL)
    request = open_stop_request(daemon.socket)
    assert request is not None
    pids = [device["pid"] for device in status(daemon)["devices"]]
    with daemon.cell() as cell, contextlib.ExitStack() as frozen:
        cell.emergency_stop(why="first")
        for pid in pids:
            frozen.enter_context(daemon.frozen(pid))
        for turn in range(50):  # the daemon looks every 20 ms, and may have heard it
            request.request(time.monotonic_ns(), os.getpid(), f"second {turn}")
            try:
                cell.reset()
            except OSError as error:
                assert error.errno == errno.EAGAIN and f"second {turn}" in str(error)
                assert cell.status()["stopped_ns"]
                return
            cell.emergency_stop(why="first")
    raise AssertionError("no reset was refused")


@pytest.mark.parametrize(("tick_hz", "by"), [(100.0, "file"), (20.0, "daemon"), (20.0, "file"), (20.0, "death")])
def test_a_stop_does_not_wait_for_the_tick(start_daemon: Callable[..., Daemon], tick_hz: float, by: str) -> None:
    slow = axes("mod0", "xaxis", extra=f"tick_hz = {tick_hz}").replace(
        "position_min", "bandwidth_hz = 1.0\nposition_min"
    )
    daemon = start_daemon('[workcell]\nname = "test"\n' + slow)
    delays = []
    with daemon.cell() as cell, cell.open("mod0.xaxis.readonly") as seen:
        request = open_stop_request(daemon.socket)
        assert request is not None
        axis = cell.open("mod0.xaxis", "rw")
        for turn in range(12):
            axis.command(velocity=0.2 if turn % 2 else -0.2, replace=True)
            wait_for(lambda a=axis: abs(a.read().velocity[0]) > 0.15, "moving")
            time.sleep(0.013 * turn % 0.05)  # anywhere between two ticks
            before, asked_ns = seen.read().number, time.monotonic_ns()
            match by:
                case "daemon":
                    cell.emergency_stop()
                case "file":
                    request.request(asked_ns, os.getpid())
                case "death":
                    axis.close()
            stopped = wait_for(lambda n=before: braking(seen, n), "stopped")
            delays.append((stopped - asked_ns) * 1e-9 * tick_hz)
            cell.reset()
            if by == "death":
                axis = cell.open("mod0.xaxis", "rw", timeout=2.0)
    delays.sort()
    assert delays[len(delays) // 2] < 0.3, f"in ticks, of which a stop takes a quarter at most: {delays}"


def braking(seen: Any, after: int) -> int:
    """Return the stamp of the first snapshot after one in which the axis is being stopped, 0 before it came."""
    for reading in seen.history(after):
        status = reading.status[0]
        if status & STOPPED or not status & AxisStatus.MOVING:
            return int(reading.stamp_ns)
    return 0


def test_a_reset_answers_every_request_before_the_one_that_is_there(daemon: Daemon) -> None:
    """Who asks for a stop may be held up between looking at the clock and writing: somebody else's word is later."""
    request = open_stop_request(daemon.socket)
    assert request is not None
    with contextlib.closing(request), daemon.cell() as cell:
        later, _ = request.request(time.monotonic_ns(), os.getpid(), "the first that is written")
        wait_for(lambda: cell.status()["stopped_ns"], "the first is heard")
        cell.emergency_stop(why="stopped in any case")
        first = request.request(time.monotonic_ns(), os.getpid(), "smoke")
        wait_for(lambda: request.taken(first), "it is heard")
        time.sleep(0.1)
        request.request(later - 1, os.getpid(), "held up")
        time.sleep(0.1)
        cell.reset()
        time.sleep(0.1)
        assert not cell.status()["stopped_ns"], "a reset that has been acknowledged"


def test_a_driver_of_the_daemon_before_notes_no_stop_that_has_been_reset(start_daemon: Callable[..., Daemon]) -> None:
    """It was frozen while its daemon died, with a request that others had heard, and goes on behind the next reset."""
    daemon = start_daemon(CELL + axes("mod1", "xaxis"))
    late = daemon.device("mod1")["pid"]
    request = open_stop_request(daemon.socket)
    assert request is not None
    with contextlib.closing(request), daemon.frozen(late):
        os.kill(daemon.pid, signal.SIGSTOP)
        word = request.request(time.monotonic_ns(), os.getpid(), "smoke")
        wait_for(lambda: request.taken(word), "another driver has heard")
        os.kill(daemon.pid, signal.SIGKILL)
        daemon.running.wait_exit(10.0)
        again = start_daemon(daemon.config.read_text(), at=daemon.folder)
        assert "smoke" in status(again)["stop_source"]
        with again.cell() as cell:
            cell.reset()
    wait_for(lambda: has_ended(late), "it finds its daemon gone")
    time.sleep(0.1)
    assert not status(again)["stopped_ns"]
    works(again)
