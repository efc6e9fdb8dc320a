"""Sessions with a gateway, one after the other: what they leave."""

from __future__ import annotations

import os
import time
from pathlib import Path

from sioms.check.remote import Gateway
from sioms.client.workcell import Workcell

from .figures import Bar, Report
from .options import Options

HEAP_KIB = 256
"""Private memory that a heap may gain by the way its pieces lie, over any number of sessions [KiB]."""


def _owned(pid: int) -> tuple[int, int]:
    """Return descriptors and private memory [KiB] of a process."""
    lines = Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()
    private = sum(int(line.split()[1]) for line in lines if line.startswith("Private"))
    return len(os.listdir(f"/proc/{pid}/fd")), private


def connect_again(options: Options, report: Report, gateway: Gateway) -> None:
    """Connect, hold something and leave, again and again; the second half shows whether more is kept each time."""
    pids = {"gateway": gateway.process.pid, "client": os.getpid()}
    trials, took = options.kills(60, 1000), []
    looks: list[dict[str, tuple[int, int]]] = []
    for trial in range(trials + 20):
        begin = time.perf_counter_ns()
        with Workcell(gateway.socket, "again") as cell:
            took.append(time.perf_counter_ns() - begin)
            with cell.open("mod0", "rw", 2.0):
                cell.nodes()
        if trial in (19, 19 + trials // 2, 19 + trials):
            time.sleep(1.0)
            looks.append({who: _owned(pid) for who, pid in pids.items()})
        report.progress(f"connection {trial}")
    report.samples("connecting", took, "ms")
    first, half, last = looks
    for who in pids:
        report.value(
            f"{who}: descriptors more after {trials} connections", last[who][0] - first[who][0], bars=[Bar("value", 0)]
        )
        report.value(
            f"{who}: private memory more in the second half [KiB]", last[who][1] - half[who][1],
            bars=[Bar("value", HEAP_KIB)], notes=f"in the first {half[who][1] - first[who][1]}",
        )  # fmt: skip
