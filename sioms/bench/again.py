"""Sessions with a gateway, one after the other: what they leave."""

from __future__ import annotations

import os
import time
from pathlib import Path

from sioms.check.remote import Gateway
from sioms.client.workcell import Workcell

from .figures import Bar, Report
from .options import Options


def _owned(pid: int) -> tuple[int, float]:
    """Return descriptors and memory [MB] of a process."""
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return len(os.listdir(f"/proc/{pid}/fd")), pages * os.sysconf("SC_PAGESIZE") / 1e6


def connect_again(options: Options, report: Report, gateway: Gateway) -> None:
    """Connect, hold something and leave, again and again."""
    pids = {"gateway": gateway.process.pid, "client": os.getpid()}
    before: dict[str, tuple[int, float]] = {}
    trials, took = options.kills(60, 1000), []
    for trial in range(trials + 20):
        begin = time.perf_counter_ns()
        with Workcell(gateway.socket, "again") as cell:
            took.append(time.perf_counter_ns() - begin)
            with cell.open("mod0", "rw", 2.0):
                cell.nodes()
        if trial == 19:
            time.sleep(1.0)
            before = {who: _owned(pid) for who, pid in pids.items()}
        report.progress(f"connection {trial}")
    time.sleep(1.0)
    report.samples("connecting", took, "ms")
    for who, pid in pids.items():
        fds, megabytes = _owned(pid)
        report.value(
            f"{who}: descriptors more after {trials} connections", fds - before[who][0], bars=[Bar("value", 0)],
            notes=f"memory {megabytes - before[who][1]:+.2f} MB",
        )  # fmt: skip
