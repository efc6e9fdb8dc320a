"""Calls that come seldom: one in 10 ms, as a control loop makes them, so that caches are cold and cores asleep.

Every call has its turn beside the bare call that it is compared with: a read beside a bare copy out of shared memory, a
write beside a bare echo of as many bytes over a socket.
"""

from __future__ import annotations

import mmap
import os
import struct
import time
from collections.abc import Callable, Mapping
from typing import Any

from sioms.check.daemon import CpuTimes, Daemon, on_processors
from sioms.client.command import command

from .baseline import RoundTrip
from .figures import Bar, Figure, Report
from .options import Options
from .workcells import axes, workcell

PACE_S = 0.01
READING = struct.Struct("=36d")
"""Four axes of nine columns: what the bare copy copies."""
OVER_US, WRITE_RATIO, WRITE_P99_US = 5.0, 2.5, 700.0


def bench_paced(options: Options, report: Report) -> None:
    """Reads and writes, one call in 10 ms, on one core and from another core than the driver's."""
    with Daemon(workcell([axes("mod0")])) as daemon, daemon.cell() as cell, RoundTrip() as bare:
        driver = daemon.device_pids()["mod0"]
        with cell.open("mod0", "rw") as node:
            for where, (ours, theirs) in two_places(report).items():
                with on_processors({os.getpid(): ours, driver: theirs, bare.pid: theirs}):
                    _calls(options, report, node, bare, where, driver)


def two_places(report: Report) -> dict[str, tuple[int, int]]:
    """Return the processors of the client and of who answers it, by the name of that placement.

    Left to the kernel each pair of processes finds a place of its own, and a ratio compares places: a bare round trip
    takes a quarter on one core of what it takes across two.
    """
    cores = sorted(os.sched_getaffinity(0))
    if len(cores) < 2:
        report.note("one core alone: across cores is left out")
        return {"one core": (cores[0], cores[0])}
    return {"one core": (cores[-1], cores[-1]), "across cores": (cores[0], cores[-1])}


def _calls(options: Options, report: Report, node: Any, bare: RoundTrip, where: str, driver: int) -> None:
    memory = mmap.mmap(-1, mmap.PAGESIZE)
    records = [command(0, position=p) for p in (0.001, -0.001)]
    turns: dict[str, Callable[[], object]] = {
        "bare copy": lambda: READING.unpack_from(memory),
        "read of 4 axes": lambda: node.read().position,
        "bare echo": lambda: bare.once(len(records[0])),
        "write to acknowledgement": lambda: node.write(records[0], replace=True),
    }
    taken: dict[str, list[int]] = {name: [] for name in turns}
    count = options.count(150, 2000)
    cpu = CpuTimes({"client": os.getpid(), "driver": driver})
    for trial in range(count):
        records.reverse()
        for name, call in turns.items():
            time.sleep(PACE_S)
            begin = time.perf_counter_ns()
            call()
            taken[name].append(time.perf_counter_ns() - begin)
        report.progress(f"paced: {trial} of {count}")
    _report(report, taken, where, cpu.shares())


def _report(report: Report, taken: Mapping[str, list[int]], where: str, shares: Mapping[str, float]) -> None:
    copy = report.samples(f"bare copy, {where}", taken["bare copy"])
    most = 2 * _p50(copy) + OVER_US
    report.samples(f"read of 4 axes, {where}", taken["read of 4 axes"], baseline=copy, bars=[Bar("p50", most)])
    echo = report.samples(f"bare echo, {where}", taken["bare echo"])
    bars = [Bar("ratio", WRITE_RATIO), Bar("p99", WRITE_P99_US)]
    report.samples(
        f"write to acknowledgement, {where}", taken["write to acknowledgement"], baseline=echo, bars=bars, cpu=shares
    )


def _p50(figure: Figure) -> float:
    return figure.summary.values["p50"] if figure.summary is not None else 0.0
