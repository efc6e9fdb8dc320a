"""Deaths and hangs: a client or the daemon is killed or stopped, and its axes must halt by themselves."""

from __future__ import annotations

import errno
import os
import signal
import time
from collections.abc import Callable
from functools import partial
from typing import Any

from sioms.check.daemon import Daemon, wait_for
from sioms.client.command import command

from .figures import Bar, Report
from .options import Options
from .watching import HISTORY, Counted, Watch, halting_ns
from .workcells import axes, workcell

SPEED = 0.05
LEASE_S = 0.25
DEVICE = axes("mod0", history=HISTORY, limits=False)
BAR = Bar("max", 20.0)
DRIVERS = 4


def cruise(daemon: Daemon, node: str, lease: float = 0.0) -> Callable[[], None]:
    """Return what a client does that opens a node, sets its axes going, and then waits for its end."""

    def client() -> None:
        cell = daemon.cell("cruiser")
        axes_node = cell.open(node, "rw", 10.0, lease=lease)
        count = len(axes_node.info.channels)
        axes_node.write(b"".join([command(axis, velocity=SPEED) for axis in range(count)]))
        while True:
            time.sleep(lease / 5 if lease else 60.0)
            axes_node.keepalive()

    return client


def wait_cruising(node: Any) -> None:
    """Wait until all axes of a node go at their speed."""
    wait_for(lambda: all(abs(v - SPEED) < 1e-6 for v in _velocities(node)), 10.0, f"{node.name} to cruise")


def _velocities(node: Any) -> tuple[float, ...]:
    try:
        return tuple(node.read().commanded_velocity)
    except OSError as error:
        if error.errno != errno.EIO:
            raise
        return (0.0,)


def bench_client(options: Options, report: Report) -> None:
    """A client with four moving axes is killed; another hangs and its lease runs out."""
    with Daemon(workcell([DEVICE])) as daemon, daemon.cell() as cell, cell.open("mod0.readonly") as node:
        halts, frees, counted = [], [], Counted()
        trials = options.kills(20, 1000)
        for trial in range(trials):
            victim = daemon.fork(cruise(daemon, "mod0"))
            wait_cruising(node)
            watch = Watch(node)
            begin = daemon.kill(victim)
            with cell.open("mod0", "rw", 5.0):
                frees.append(time.monotonic_ns() - begin)
            halts.append(counted.look(partial(halting_ns, watch, begin)) - begin)
            daemon.reap(victim)
            report.progress(f"client killed: {trial} of {trials}")
        report.samples("client SIGKILL to its 4 axes halting", halts, "ms", bars=[BAR])
        report.samples("client SIGKILL to its node open again", frees, "ms", bars=[Bar("max", 50.0)])
        hangs = []
        trials = options.slow(5, 100)
        for trial in range(trials):
            victim = daemon.fork(cruise(daemon, "mod0", LEASE_S))
            wait_cruising(node)
            watch = Watch(node)
            begin = daemon.kill(victim, signal.SIGSTOP)
            hangs.append(counted.look(partial(halting_ns, watch, begin)) - begin)
            daemon.kill(victim)
            daemon.reap(victim)
            report.progress(f"client hung: {trial} of {trials}")
        counted.tell(report, "halts")
        bars = [Bar("max", LEASE_S * 1e3 + 20.0)]
        report.samples(f"client SIGSTOP, lease {LEASE_S * 1e3:g} ms, to its axes halting", hangs, "ms", bars=bars)


def bench_daemon(options: Options, report: Report) -> None:
    """The daemon is killed, or hangs, while the axes of four driver processes move."""
    kills: list[int] = []
    hangs: list[int] = []
    counted = Counted()
    for how, trials, found in (
        (signal.SIGKILL, options.kills(8, 1000), kills),
        (signal.SIGSTOP, options.slow(4, 100), hangs),
    ):
        while len(found) < trials:
            found += _daemon_trial(how, counted)
            report.progress(f"daemon {how.name}: {len(found)} of {trials}")
    if kills:
        report.samples("daemon SIGKILL to the axes of each driver halting", kills, "ms", bars=[BAR])
    if hangs:
        report.samples("daemon SIGSTOP, lease 500 ms, to the axes of each driver halting", hangs, "ms",
                       bars=[Bar("max", 520.0)])  # fmt: skip
    counted.tell(report, "halts")


def _daemon_trial(how: signal.Signals, counted: Counted) -> list[int]:
    """Kill a fresh daemon whose devices move; return how long each of them took to halt [ns]."""
    devices = [axes(f"mod{i}", history=HISTORY, limits=False) for i in range(DRIVERS)]
    with Daemon(workcell(devices, daemon_lease_s=0.5)) as daemon:
        pids = daemon.device_pids()
        cell = daemon.cell()
        nodes = [cell.open(f"{name}.readonly") for name in pids]
        for name in pids:
            daemon.fork(cruise(daemon, name))
        for node in nodes:
            wait_cruising(node)
        watches = [Watch(node) for node in nodes]
        begin = time.monotonic_ns()
        os.kill(daemon.pid, how)
        found = [counted.look(partial(halting_ns, watch, begin)) - begin for watch in watches]
        if how is signal.SIGSTOP:
            os.kill(daemon.pid, signal.SIGKILL)
        return found
