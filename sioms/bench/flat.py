"""What deaths of clients leave in the processes that live on: descriptors and memory, in steps."""

from __future__ import annotations

import contextlib
import random
import time
from collections.abc import Callable
from functools import partial
from typing import Any

from sioms.check.daemon import Daemon, descriptors, memory_kb, wait_for
from sioms.client.command import command

from .figures import Bar, Report
from .killing import SPEED, fork_servers
from .options import Options
from .workcells import axes, workcell

STEPS = 10
AXES = 4
HEAP_KIB = 256
"""Private memory that a heap may gain by the way its pieces lie, in the second half [KiB]."""
LONGEST_S = 0.004
"""A client lives for up to this long after it has begun to move an axis [s]."""


def bench_flat(options: Options, report: Report) -> None:
    """Kill clients that move an axis, and look at daemon, fork server and driver after each tenth of them."""
    deaths = options.kills(200, 10_000)
    chance = random.Random(options.seed)
    with Daemon(workcell([axes("mod0", AXES, limits=False)])) as daemon:
        drivers = daemon.device_pids()
        servers = fork_servers(daemon, set(drivers.values()))
        pids = {"daemon": daemon.pid, "driver": drivers["mod0"], **dict(zip(["fork server"], servers, strict=False))}
        _kill(daemon, chance, max(STEPS, deaths // STEPS))  # what is loaded and cached once
        looks = [_look(daemon, pids)]
        for step in range(STEPS):
            _kill(daemon, chance, deaths // STEPS)
            looks.append(_look(daemon, pids))
            report.progress(f"{(step + 1) * deaths // STEPS} of {deaths} deaths")
    report.value("clients killed", STEPS * (deaths // STEPS))
    for who in pids:
        fds, private = zip(*[look[who] for look in looks], strict=True)
        report.note(f"{who}: private {', '.join(map(str, private))} KiB; descriptors {', '.join(map(str, fds))}")
        report.value(f"{who}: descriptors more", fds[-1] - fds[0], bars=[Bar("value", 0)])
        half = private[STEPS // 2]
        report.value(f"{who}: private memory more in the second half [KiB]", private[-1] - half,
                     bars=[Bar("value", HEAP_KIB)], notes=f"in the first {half - private[0]}")  # fmt: skip


def _kill(daemon: Daemon, chance: random.Random, count: int) -> None:
    """Have clients move an axis, and kill each in the middle of something."""
    with daemon.cell("judge") as cell, cell.open("mod0.readonly", timeout=10.0) as node:
        for number in range(count):
            axis = number % AXES
            pid = daemon.fork(_client(daemon, f"mod0.a{axis}"))
            wait_for(partial(_moves, node, axis), 10.0, "a client to move its axis")
            time.sleep(chance.random() * LONGEST_S)
            daemon.kill(pid)
            daemon.reap(pid)


def _moves(node: Any, axis: int) -> bool:
    return bool(abs(node.read().commanded_velocity[axis]) > SPEED / 2)


def _client(daemon: Daemon, name: str) -> Callable[[], None]:
    def work() -> None:
        with daemon.cell("mortal") as cell, cell.open(name, "rw", 10.0) as axis:
            axis.write(command(0, velocity=SPEED))
            marker = cell.reserve_marker()
            while True:
                with contextlib.suppress(OSError):
                    axis.statistics(10)
                    marker.wait(0.0005)

    return work


def _look(daemon: Daemon, pids: dict[str, int]) -> dict[str, tuple[int, int]]:
    """Return descriptors and private memory [KiB] of each process once all clients are gone."""
    with daemon.cell("judge") as cell:
        wait_for(lambda: len(cell.status()["sessions"]) == 1, 10.0, "the dead to be gone")
    time.sleep(1.0)
    return {who: (descriptors(pid), memory_kb(pid)["private"]) for who, pid in pids.items()}
