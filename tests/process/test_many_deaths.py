"""Nothing is left of clients that die, however many.

What counts is memory of a process's own: the ring of a page, which is shared memory, fills with ticks until it is full.
What is bounded fills, too: a driver grows by some 400 kB over its first 200 deaths, and by 12 kB over the next 300.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from pathlib import Path

from daemon_rig import Daemon, axes, wait_for

DEATHS = """
import os, signal, sys, sioms
for i in range(int(sys.argv[2])):
    if (pid := os.fork()) == 0:
        try:
            cell = sioms.Workcell(sys.argv[1], f"victim {i}")
            with cell.open("mod0.readonly") as watch:
                cell.reserve_marker()
                axis = cell.open("mod0.xaxis", "rw", timeout=20.0)
                axis.move(0.9 if i % 2 else -0.9)
                os.kill(os.getpid(), signal.SIGKILL)
        finally:
            os._exit(1)
    assert os.waitpid(pid, 0)[1] == signal.SIGKILL
"""


def left_of(pid: int) -> tuple[int, int]:
    """Return the descriptors of a process and its own memory [kB]."""
    status = Path(f"/proc/{pid}/status").read_text()
    own = next(line for line in status.splitlines() if line.startswith("RssAnon"))
    return len(os.listdir(f"/proc/{pid}/fd")), int(own.split()[1])


def test_some_hundred_deaths_of_clients_leave_nothing(
    start_daemon: Callable[..., Daemon], start: Callable[..., object]
) -> None:
    daemon = start_daemon('[workcell]\nname = "test"\n' + axes("mod0", "xaxis"))
    driver = daemon.device("mod0")["pid"]

    def die(count: int) -> list[tuple[int, int]]:
        killer = start([sys.executable, "-c", DEATHS, daemon.socket, str(count)])
        assert killer.wait_exit(100.0) == 0, killer.lines  # type: ignore[attr-defined]
        with daemon.cell("who looks") as cell:
            wait_for(lambda: len(cell.status()["sessions"]) == 1 and not cell.status()["holders"], "all have gone")
            with cell.open("mod0.readonly") as watch:
                wait_for(lambda: watch.statistics(1)["handles"] == 1, "all handles have ended")
        return [left_of(pid) for pid in (driver, daemon.pid)]

    before, after = die(120), die(120)
    for (descriptors, own), (descriptors_now, own_now) in zip(before, after, strict=True):
        assert descriptors_now == descriptors
        assert own_now - own < 250, f"{own_now - own} kB more after 120 deaths"
