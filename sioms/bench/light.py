"""Many light devices in one driver process: what they take of a core, and how soon a stop reaches the last of them.

100 devices of four axes that tick 100 times a second, in one process (``process = "NAME"``); that process, the daemon
and the fork server are bound to one core. The client is not.
"""

from __future__ import annotations

import os
import time
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any

from sioms.check.daemon import CpuTimes, Daemon, memory_kb
from sioms.client.command import command
from sioms.protocol.flags import AxisStatus

from .baseline import interpreter_ns
from .deaths import SPEED, wait_cruising
from .figures import Bar, Report
from .options import Options
from .watching import Counted, Watch, halting_ns, standing_ns
from .workcells import axes, workcell

DEVICES = 100
RATE_HZ = 100
HISTORY = 256
"""Snapshots that a device keeps: some seconds, so that the last of all devices can be looked at after the first."""
LOOK_BACK_NS = 3 * 1_000_000_000 // RATE_HZ
LATE_S = 0.5
START_S, STOP_MS, HALT_MS, MOST_SHARE = 3.0, 15.0, 20.0, 1.0


def bench_light(options: Options, report: Report) -> None:
    """Start, processor, memory, descriptors, stops and the death of the owner of 100 light devices on one core."""
    starts, bare = [], []
    config = workcell([_device(i) for i in range(DEVICES)])
    core = max(os.sched_getaffinity(0))
    for _ in range(options.count(1, 5) - 1):
        starts.append(_start_ns(config, core))
        bare += [interpreter_ns() for _ in range(3)]
    with Daemon(config, core) as daemon, daemon.cell() as cell, ExitStack() as stack:
        starts.append(daemon.ready_ns - daemon.start_ns)
        bare += [interpreter_ns() for _ in range(3)]
        base = report.samples("bare interpreter, start to exit", bare, "ms")
        bars = [Bar("max", START_S * 1e3)]
        report.samples(f"daemon start to ready, {DEVICES} devices", starts, "ms", baseline=base, bars=bars)
        pid = _process(daemon)
        seconds = options.count(2, 10)
        time.sleep(2.0)  # devices that nobody looks at are idle after a second
        _share(report, "idle", pid, daemon.pid, seconds)
        nodes = [stack.enter_context(cell.open(f"light{i}", "rw", 5.0)) for i in range(DEVICES)]
        _share(report, "all nodes open, at rest", pid, daemon.pid, seconds)
        _go(nodes)
        before = _ticks(nodes)
        _share(report, "all axes moving", pid, daemon.pid, seconds)
        ran, skipped = (after - was for after, was in zip(_ticks(nodes), before, strict=True))
        report.value("ticks left out meanwhile", 100 * skipped / (ran + skipped), "%", notes=f"of {ran + skipped}")
        _size(report, pid)
        _stops(options, report, cell, nodes)
        states = {device["name"]: device["state"] for device in cell.status()["devices"]}
        faults = [name for name, state in states.items() if state != "up"]
        report.value("devices in fault", len(faults) + _axes_in_fault(nodes), "", bars=[Bar("value", 0)],
                     notes=" ".join(faults))  # fmt: skip
    _deaths(options, report, config, core)


def _deaths(options: Options, report: Report, config: str, core: int) -> None:
    """Kill a client that owns all devices while they move."""
    halts, counted = [], Counted()
    with Daemon(config, core) as daemon, daemon.cell() as cell, ExitStack() as stack:
        nodes = [stack.enter_context(cell.open(f"light{i}.readonly")) for i in range(DEVICES)]
        trials = options.kills(2, 50)
        for trial in range(trials):
            victim = daemon.fork(partial(_own, daemon))
            for node in nodes:
                wait_cruising(node)
            time.sleep(3e-9 * LOOK_BACK_NS)
            watches = [Watch(node) for node in nodes]
            begin = daemon.kill(victim)
            found = (partial(halting_ns, watch, begin, look_back_ns=LOOK_BACK_NS) for watch in watches)
            halts.append(max(counted.look(one) for one in found) - begin)
            daemon.reap(victim)
            report.progress(f"light, owner killed: {trial} of {trials}")
    report.samples(
        f"owner SIGKILL to the last of its {DEVICES} devices halting", halts, "ms", bars=[Bar("max", HALT_MS)]
    )
    counted.tell(report, "halts")


def _own(daemon: Daemon) -> None:
    """Own all devices, set them going, and wait for the end."""
    cell = daemon.cell("owner")
    _go([cell.open(f"light{i}", "rw", 10.0) for i in range(DEVICES)])
    time.sleep(600.0)


def _device(number: int) -> str:
    text = axes(f"light{number}", tick_hz=RATE_HZ, history=HISTORY, capacity=16, limits=False,
                axis_keys="bandwidth_hz = 5.0\n")  # fmt: skip
    text = text.replace("realtime_priority = 50\n", "realtime_priority = 0\n")  # as simulated devices have it
    return text.replace("late_max_s = 0.5\n", f'late_max_s = {LATE_S}\nprocess = "light"\n')


def _start_ns(config: str, core: int) -> int:
    with Daemon(config, core) as daemon:
        return daemon.ready_ns - daemon.start_ns


def _process(daemon: Daemon) -> int:
    """Return the pid of the one process of all devices."""
    pids = set(daemon.device_pids().values())
    if len(pids) != 1:
        raise RuntimeError(f"start {DEVICES} devices in one process: they are in {len(pids)}")
    return pids.pop()


def _share(report: Report, when: str, driver: int, daemon: int, seconds: float) -> None:
    cpu = CpuTimes({"driver": driver, "daemon": daemon})
    time.sleep(seconds)
    shares = cpu.shares()
    bars = [Bar("value", 100 * MOST_SHARE)]
    report.value(f"processor share, {when}", 100 * sum(shares.values()), "%", cpu=shares, bars=bars)


def _size(report: Report, pid: int) -> None:
    size = memory_kb(pid)
    notes = f"rss {size['rss']} pss {size['pss']}"
    report.value("private memory of the process, a device", size["private"] / DEVICES, "KiB", notes=notes)
    files = len(os.listdir(f"/proc/{pid}/fd"))
    faults = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[7]
    report.value("descriptors of the process, a device", files / DEVICES, "", notes=f"{files}; {faults} page faults")


def _go(nodes: list[Any]) -> None:
    for node in nodes:
        node.write([command(a, velocity=SPEED, time=1000.0) for a in range(len(node.info.channels))])
    for node in nodes:
        wait_cruising(node)
    time.sleep(3e-9 * LOOK_BACK_NS)  # the last one, too, has gone at its speed for as long as is looked back


def _ticks(nodes: list[Any]) -> tuple[int, int]:
    """Return how many ticks were done and left out, of all devices."""
    found = [node.statistics(1) for node in nodes]
    return sum(one["ticks"] for one in found), sum(one["skipped"] for one in found)


def _axes_in_fault(nodes: list[Any]) -> int:
    return sum(any(status & AxisStatus.FAULT for status in node.read().status) for node in nodes)


def _stops(options: Options, report: Report, cell: Any, nodes: list[Any]) -> None:
    """Stop moving axes again and again; a device that does not brake ends the trial, and the run says so."""
    acted, rested, calls, counted = [], [], [], Counted()
    trials = options.kills(10, 300)
    for trial in range(trials):
        watches = [Watch(node) for node in nodes]
        begin = time.monotonic_ns()
        cell.emergency_stop(why="bench")
        calls.append(time.monotonic_ns() - begin)
        halts = (partial(halting_ns, watch, begin, look_back_ns=LOOK_BACK_NS) for watch in watches)
        acted.append(max(counted.look(halt) for halt in halts) - begin)
        rested.append(max(counted.look(partial(standing_ns, watch, begin)) for watch in watches) - begin)
        cell.reset()
        _go(nodes)
        report.progress(f"light: {trial} of {trials}")
    report.samples("emergency stop, call returns", calls, "ms")
    report.samples(f"emergency stop to the last of {DEVICES} devices braking", acted, "ms", bars=[Bar("max", STOP_MS)])
    report.samples(f"emergency stop to the last of {4 * DEVICES} axes at rest", rested, "ms")
    counted.tell(report, "stops")
