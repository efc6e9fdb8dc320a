"""Processes that get no memory or no descriptors any more: what moves halts or goes on as told, and what is stopped
stays so.
"""

from __future__ import annotations

import contextlib
import os
import resource
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from daemon_rig import Daemon, axes, wait_for

import sioms
from sioms.client.command import command

CELL = '[workcell]\nname = "test"\n' + axes("mod0", "xaxis", "yaxis") + axes("mod1", "zaxis")


@contextlib.contextmanager
def no_more(kind: int, pid: int, now: int) -> Iterator[None]:
    """Let a process have no more of something than now."""
    before = resource.prlimit(pid, kind)
    resource.prlimit(pid, kind, (now, before[1]))
    try:
        yield
    finally:
        with contextlib.suppress(ProcessLookupError):
            resource.prlimit(pid, kind, before)


def memory(pid: int) -> int:
    """Return the bytes of address space of a process."""
    return int(Path(f"/proc/{pid}/statm").read_text().split()[0]) * resource.getpagesize()


def works(daemon: Daemon, node: str) -> None:
    """See that a node can be opened and moved, at once or when its device is back."""
    with daemon.cell() as cell, cell.open(node, "rw", timeout=15.0) as axis:
        axis.move(axis.read().position[0] + 0.001)
        axis.wait_until_idle(5.0)


def test_a_driver_without_memory_takes_writes_whole_or_not_at_all_and_harms_no_other(
    start_daemon: Callable[..., Daemon],
) -> None:
    daemon = start_daemon(CELL)
    pid, other = daemon.device("mod0")["pid"], daemon.device("mod1")["pid"]
    with daemon.cell() as cell, cell.open("mod1", "rw") as beside, cell.open("mod0.xaxis", "rw") as axis:
        beside.write(command(0, velocity=0.001))
        long = command(0, position=0.0) * 8000
        with no_more(resource.RLIMIT_AS, pid, memory(pid)):
            for _ in range(20):
                with contextlib.suppress(OSError):
                    axis.write(long, replace=True, timeout=0.0)
                    assert axis.read().status is not None
        assert beside.read().in_motion[0] and daemon.device("mod1")["pid"] == other
    works(daemon, "mod0.xaxis")


def test_a_daemon_without_memory_serves_on(start_daemon: Callable[..., Daemon]) -> None:
    daemon = start_daemon(CELL)
    cells: list[sioms.Workcell] = []
    try:
        with contextlib.suppress(OSError), no_more(resource.RLIMIT_AS, daemon.pid, memory(daemon.pid)):
            for number in range(60):
                cells.append(daemon.cell(f"{number}" * 200))
                cells[-1].open("mod0.readonly")
                cells[-1].status()
    finally:
        for cell in cells:
            with contextlib.suppress(OSError):
                cell.close()
    works(daemon, "mod1.zaxis")


def test_a_fork_server_without_descriptors_harms_no_driver_and_says_why_none_starts(
    start_daemon: Callable[..., Daemon],
) -> None:
    daemon = start_daemon(CELL)
    server, pid = daemon.fork_server(), daemon.device("mod1")["pid"]
    with daemon.cell() as cell, cell.open("mod1", "rw") as axis:
        axis.write(command(0, velocity=0.001))
        with no_more(resource.RLIMIT_NOFILE, server, len(os.listdir(f"/proc/{server}/fd"))):
            os.kill(daemon.device("mod0")["pid"], 9)
            wait_for(lambda: "could not be started" in daemon.device("mod0")["reason"], "the cause to be told")
        assert axis.read().in_motion[0] and daemon.device("mod1")["pid"] == pid
    works(daemon, "mod0.xaxis")


def test_a_client_without_descriptors_keeps_what_it_has(start_daemon: Callable[..., Daemon]) -> None:
    daemon = start_daemon(CELL)
    with daemon.cell() as cell, cell.open("mod0", "rw") as axis:
        axis.write(command(0, velocity=0.001))
        before = resource.getrlimit(resource.RLIMIT_NOFILE)
        resource.setrlimit(resource.RLIMIT_NOFILE, (max(map(int, os.listdir("/proc/self/fd"))) + 1, before[1]))
        taken: list[int] = []
        try:
            with contextlib.suppress(OSError):
                while True:
                    taken.append(os.open("/dev/null", os.O_RDONLY))
            os.close(taken.pop())  # one is left, and a node takes three
            with pytest.raises(OSError, match="too many open files"):
                cell.open("mod1.readonly")
            assert axis.read().in_motion[0]
            cell.emergency_stop(why="no descriptors")
        finally:
            resource.setrlimit(resource.RLIMIT_NOFILE, before)
            for fd in taken:
                os.close(fd)
        wait_for(lambda: not axis.read().in_motion[0], "rest")
        cell.reset()
    works(daemon, "mod1.zaxis")
