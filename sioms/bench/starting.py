"""Start of the daemon, memory of its processes, and return of a node whose driver was killed."""

from __future__ import annotations

import errno
import itertools
import os
import signal
import time
from pathlib import Path

from sioms.check.daemon import CpuTimes, Daemon, memory_kb

from .baseline import interpreter_ns
from .figures import Bar, Report
from .options import Options
from .workcells import axes, wave, workcell

TYPICAL = workcell([axes("mod0"), axes("mod1"), wave("beam0", 0.0313)])
KILLS = 4
"""Kills of a driver that its daemon forgives within a minute."""
QUIET_S = 5.2
"""A driver that dies again sooner than this waits before it is started again."""


def bench_start(options: Options, report: Report) -> None:
    """Daemon start to ready with three devices, processor time it takes, and memory when it is up."""
    starts: list[int] = []
    bare: list[int] = []
    sizes: dict[str, dict[str, int]] = {}
    shares: dict[str, float] = {}
    with Daemon(TYPICAL):
        pass  # its processes have written what bytecode there was not yet
    for _ in range(options.count(3, 30)):
        bare += [interpreter_ns() for _ in range(3)]
        with Daemon(TYPICAL) as daemon:
            starts.append(daemon.ready_ns - daemon.start_ns)
            if not sizes:
                pids = {"daemon": daemon.pid, **daemon.device_pids()}
                pids["fork server"] = _fork_server(daemon.pid, set(pids.values()))
                cpu = CpuTimes(pids)
                time.sleep(options.count(1, 10))
                shares = cpu.shares()
                sizes = {who: memory_kb(pid) for who, pid in pids.items()}
    base = report.samples("bare interpreter, start to exit", bare, "ms")
    report.samples(
        "daemon start to ready, three devices",
        starts,
        "ms",
        baseline=base,
        bars=[Bar("ratio", 15.0)],
    )
    for who, size in sizes.items():
        bar = Bar("value", 25 * 1024) if who == "daemon" else Bar("value", 12 * 1024)
        kind = "rss" if who == "daemon" else "private"
        notes = f"rss {size['rss']} pss {size['pss']} private {size['private']}"
        bars = [] if who == "fork server" else [bar]
        report.value(f"{kind} memory of {who}", size[kind], "KiB", bars=bars, notes=notes)
    for who, share in shares.items():
        report.value(f"processor share of idle {who}", 100 * share, "%")


def _fork_server(daemon_pid: int, others: set[int]) -> int:
    """Return the pid of the fork server: the child of the daemon."""
    children = Path(f"/proc/{daemon_pid}/task/{daemon_pid}/children").read_text().split()
    return next(int(pid) for pid in children if int(pid) not in others)


def bench_restart(options: Options, report: Report) -> None:
    """A driver is killed: how soon its node can be read again, and whether its neighbour notices."""
    back: list[int] = []
    gaps: list[int] = []
    trials = options.slow(1, 20)
    for first in range(0, trials, KILLS):  # a device that dies more often is in fault, rightly
        with Daemon(TYPICAL) as daemon, daemon.cell() as cell, cell.open("mod1.readonly") as neighbour:
            for trial in range(first, min(first + KILLS, trials)):
                if trial > first:
                    time.sleep(QUIET_S)
                before = neighbour.read().number
                pid = daemon.device_pids()["mod0"]
                begin = time.monotonic_ns()
                os.kill(pid, signal.SIGKILL)
                _wait_back(daemon, pid)
                back.append(time.monotonic_ns() - begin)
                stamps = [snapshot.stamp_ns for snapshot in neighbour.history(before)]
                gaps += [b - a for a, b in itertools.pairwise(stamps)]
                report.progress(f"restart: {trial}")
    report.samples("driver killed to its node open and read again", back, "ms", bars=[Bar("p50", 500), Bar("p50", 50)])
    report.samples("period of the neighbour's publications meanwhile", gaps, "us")


def _wait_back(daemon: Daemon, old_pid: int) -> None:
    with daemon.cell() as cell:
        while True:
            try:
                with cell.open("mod0", "rw", 10.0) as node:
                    node.read()
                    if cell.status()["devices"][0]["pid"] != old_pid:
                        return
            except OSError as error:
                if error.errno not in (errno.EIO, errno.EBUSY):
                    raise
