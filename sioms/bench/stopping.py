"""Emergency stop: 16 axes in 4 driver processes with full buffers, while others wait and read."""

from __future__ import annotations

import contextlib
import os
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from sioms.check.daemon import CpuTimes, Daemon
from sioms.check.remote import Gateway
from sioms.client.command import command
from sioms.client.workcell import Workcell

from .baseline import interpreter_ns, run_ns
from .deaths import SPEED, wait_cruising
from .figures import Bar, Report
from .options import Options
from .watching import HISTORY, Counted, Watch, halting_ns, slowing_ns, standing_ns
from .workcells import axes, workcell

MODULES = 4
CAPACITY = 256
DECELERATION = 25.0
TICK_MS = 1.0
LONG_S = 30.0


def bench_stop(options: Options, report: Report) -> None:
    """From the call to every driver braking and to the last axis at rest."""
    devices = [
        axes(f"mod{i}", history=HISTORY, capacity=CAPACITY, acceleration=DECELERATION, limits=False)
        for i in range(MODULES)
    ]
    with Daemon(workcell(devices)) as daemon, daemon.cell() as cell:
        nodes = [cell.open(f"mod{i}", "rw") for i in range(MODULES)]
        daemon.fork(lambda: _wait_for_ever(daemon))
        daemon.fork(lambda: _read_for_ever(daemon))
        cpu = CpuTimes({"daemon": daemon.pid, **daemon.device_pids()})
        count = options.kills(20, 1000)
        trials = _trials(count, cell, nodes, report, lambda: cell.emergency_stop(why="bench"))
        acted, slower, rested, calls, _ = trials
        report.samples("emergency stop, call returns", calls, "ms")
        bars = [Bar("p50", 1.2), Bar("p99", 2 * TICK_MS), Bar("max", 2 * TICK_MS)]
        report.samples("emergency stop to the tick in which the last of 4 drivers brakes", acted, "ms", bars=bars)
        report.samples("emergency stop to the last axis measured a hundredth slower", slower, "ms")
        trials.counted.tell(report, "stops")
        bars = [Bar("p50", 5.0), Bar("p99", 10.0)]
        report.samples("emergency stop to the last of 16 axes at rest", rested, "ms", bars=bars, cpu=cpu.shares())
        _remote(options, report, daemon, cell, nodes)
        _shell(options, report, daemon, cell, nodes)


def _remote(options: Options, report: Report, daemon: Daemon, cell: Any, nodes: list[Any]) -> None:
    """The same from a client of a gateway."""
    with Gateway(daemon.socket) as gateway, Workcell(gateway.socket, "far") as far:
        count = options.kills(20, 500)
        trials = _trials(count, cell, nodes, report, lambda: far.emergency_stop_workcell("bench"))
    report.samples("remote emergency stop, call returns", trials.calls, "ms")
    name = "remote emergency stop to the tick in which the last of 4 drivers brakes"
    report.samples(name, trials.acted, "ms", bars=[Bar("p50", 2.0)])
    report.samples("remote emergency stop to the last of 16 axes at rest", trials.rested, "ms")


class Trials(NamedTuple):
    """Stops of moving axes [ns]: when the first tick is in which the last of them is commanded slower, when that is
    measured, when all stand, and how long the call takes.
    """

    acted: list[int]
    slower: list[int]
    rested: list[int]
    calls: list[int]
    counted: Counted


def _trials(count: int, cell: Any, nodes: list[Any], report: Report, stop: Callable[[], object]) -> Trials:
    """Stop moving axes again and again; the stamp of a tick is not interpolated to when braking began."""
    acted, slower, rested, calls, counted = trials = Trials([], [], [], [], Counted())
    for trial in range(count):
        _fill(nodes)
        watches = [Watch(node) for node in nodes]
        begin = time.monotonic_ns()
        stop()
        calls.append(time.monotonic_ns() - begin)
        for samples, look in ((acted, halting_ns), (slower, slowing_ns), (rested, standing_ns)):
            samples.append(max(counted.look(partial(look, watch, begin)) for watch in watches) - begin)
        cell.reset()
        report.progress(f"stop: {trial} of {count}")
    return trials


def _fill(nodes: list[Any]) -> None:
    """Fill all buffers with moves that last far longer than the trial, and wait until all axes go."""
    for node in nodes:
        count = len(node.info.channels)
        commands = [command(a, velocity=SPEED, time=LONG_S) for _ in range(CAPACITY) for a in range(count)]
        node.write(commands, 5.0)
    for node in nodes:
        wait_cruising(node)


def _wait_for_ever(daemon: Daemon) -> None:
    """Be the client that waits for the end of a motion that never ends."""
    with daemon.cell("waiter") as cell, cell.open("mod0.readonly") as node:
        while True:
            with contextlib.suppress(OSError):  # stopped: that is what this client is for
                node.wait_until_idle()
            time.sleep(0.01)


def _read_for_ever(daemon: Daemon) -> None:
    """Be the client that reads every publication at 1 kHz."""
    with daemon.cell("reader") as cell, cell.open("mod1.readonly") as node:
        number = 0
        while True:
            number = node.wait_new(number, 5.0).number


def _shell(options: Options, report: Report, daemon: Daemon, cell: Any, nodes: list[Any]) -> None:
    """The same from the shell: ``sdev -e``, from its start."""
    tool = Path(sys.executable).with_name("sdev")
    if not tool.exists():
        report.note(f"sdev is not installed beside {sys.executable}: left out")
        return
    environment = dict(os.environ, SIOMS_SOCKET=daemon.socket)
    bare: list[int] = []
    acted: list[int] = []
    rested: list[int] = []
    calls: list[int] = []
    counted = Counted()
    for _ in range(options.slow(10, 100)):
        bare.append(interpreter_ns())
        found = _trials(1, cell, nodes, report, lambda: run_ns([str(tool), "-e"], environment))
        acted += found.acted
        rested += found.rested
        calls += found.calls
        counted.lost += found.counted.lost
    base = report.samples("bare interpreter, start to exit", bare, "ms")
    report.samples(
        "sdev -e from start to the last driver braking", acted, "ms", baseline=base, bars=[Bar("ratio", 2.0)]
    )
    report.samples("sdev -e from start to the last axis at rest", rested, "ms", baseline=base)
    report.samples("sdev -e from start to exit", calls, "ms", baseline=base)
    counted.tell(report, "stops of sdev -e")
