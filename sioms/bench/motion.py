"""Timing of buffered motion: ends, common starts, markers between processes; and edges of light beams.

Every ideal instant follows from the synch that started the motion, so it is known exactly.
"""

from __future__ import annotations

import os
import time
from typing import Any

from sioms.check.daemon import CpuTimes, Daemon

from .baseline import Wake
from .figures import Bar, Figure, Report
from .options import Options
from .watching import HISTORY, Watch
from .workcells import axes, wave, workcell

TICK_US = 1000.0
MOVE_S = 0.12
DISTANCE = 0.01
PERIOD_S = 0.0117
"""Of the light beam: edges fall anywhere within a tick."""


def bench_motion(options: Options, report: Report) -> None:
    """WAIT_UNTIL_IDLE, skew of a common start, markers: from a client to an axis and from axis to axis."""
    devices = [axes(f"mod{i}", history=HISTORY) for i in range(2)]
    with Daemon(workcell(devices)) as daemon, daemon.cell() as cell, Wake() as wake:
        base = report.samples("bare eventfd wake", wake.samples(options.count(100, 1000)))
        first, second = (cell.open(f"mod{i}", "rw") for i in range(2))
        trials = options.kills(20, 1000)
        _idle(first, trials, report, base)
        _skew(cell, first, second, trials, report)
        _marker_from_client(cell, first, trials, report)
        _marker_from_axis(cell, first, second, trials, report)


def _there_and_back(trial: int) -> float:
    return DISTANCE if trial % 2 == 0 else 0.0


def _idle(node: Any, trials: int, report: Report, base: Figure) -> None:
    """A move of a given time, started at a given instant, ends at a given instant."""
    late = []
    for trial in range(trials):
        node.move(_there_and_back(trial), 0, time=MOVE_S, synch=True)
        start_ns = node.synch(time.monotonic_ns() + 5_000_000)
        node.wait_until_idle(5.0)
        late.append(time.monotonic_ns() - start_ns - round(MOVE_S * 1e9))
        report.progress(f"wait until idle: {trial} of {trials}")
    bars = [Bar("p50", TICK_US + 2000), Bar("p99", TICK_US + 2000)]
    report.samples("WAIT_UNTIL_IDLE returns after the ideal end", late, baseline=base, bars=bars)


def _skew(cell: Any, first: Any, second: Any, trials: int, report: Report) -> None:
    """Axes of two processes start by one synch: first motion, and difference of position at one instant."""
    starts, skews, lates = [], [], []
    for trial in range(trials):
        for node in (first, second):
            node.move(_there_and_back(trial), 0, time=MOVE_S, synch=True)
        watches = [Watch(node) for node in (first, second)]
        start_ns = cell.synch(first, second)
        moving = [w.first(lambda s: s.in_motion[0], start_ns, 2.0, "a start") for w in watches]
        starts.append(abs(moving[0].stamp_ns - moving[1].stamp_ns))
        lates.append(max(snapshot.stamp_ns for snapshot in moving) - start_ns)
        skews.append(_time_between(watches, start_ns + round(MOVE_S / 2 * 1e9)))
        first.wait_until_idle(2.0)
        second.wait_until_idle(2.0)
        report.progress(f"skew: {trial} of {trials}")
    report.samples("start of axes in two processes, ticks apart", starts, bars=[Bar("max", TICK_US)])
    report.samples("the same, from their commanded positions half-way", skews, bars=[Bar("max", TICK_US)])
    report.samples("synch's instant to the first tick in motion", lates, bars=[Bar("max", TICK_US + 200)])


def _time_between(watches: list[Watch], when_ns: int) -> float:
    """Return how far apart in time two equal motions are, near an instant [ns]."""
    one = watches[0].first(lambda s: True, when_ns, 2.0, "half-way")
    other = watches[1].first(lambda s: True, one.stamp_ns, 2.0, "half-way")
    velocity = one.commanded_velocity[0]
    apart = other.commanded_position[0] - one.commanded_position[0]
    return abs(apart / velocity * 1e9 - (other.stamp_ns - one.stamp_ns)) if velocity else 0.0


def _marker_from_client(cell: Any, node: Any, trials: int, report: Report) -> None:
    """A client signals; an axis whose command waits for the marker starts."""
    took = []
    for trial in range(trials):
        marker = cell.reserve_marker()
        node.move(_there_and_back(trial), 0, wait=marker)
        time.sleep(0.003)
        watch = Watch(node)
        begin = time.monotonic_ns()
        marker.signal()
        moving = watch.first(lambda s: s.in_motion[0], begin, 2.0, "a start")
        took.append(moving.stamp_ns - begin)
        node.wait_until_idle(5.0)
        marker.free()
    report.samples("marker of a client to the waiting axis in motion", took, bars=[Bar("p50", 2000), Bar("p99", 2000)])


def _marker_from_axis(cell: Any, first: Any, second: Any, trials: int, report: Report) -> None:
    """An axis ends a command and signals; an axis of another process, waiting for it, starts."""
    took = []
    for trial in range(trials):
        marker = cell.reserve_marker()
        second.move(_there_and_back(trial), 0, wait=marker)
        first.move(_there_and_back(trial), 0, time=MOVE_S, synch=True, signal=marker)
        watch = Watch(second)
        end_ns = first.synch(time.monotonic_ns() + 5_000_000) + round(MOVE_S * 1e9)
        moving = watch.first(lambda s: s.in_motion[0], end_ns - 2_000_000, 2.0, "a start")
        took.append(moving.stamp_ns - end_ns)
        first.wait_until_idle(2.0)
        second.wait_until_idle(5.0)
        marker.free()
    bars = [Bar("p50", 2000), Bar("p99", 2000)]
    report.samples("end of an axis to the axis in another process in motion", took, bars=bars)


def bench_edge(options: Options, report: Report) -> None:
    """A client waits for the edges of a light beam; from each edge's stamp to the client having it."""
    count = options.count(100, 5000)
    with Daemon(workcell([wave("beam0", PERIOD_S)])) as daemon, daemon.cell() as cell, Wake() as wake:
        base = report.samples("bare eventfd wake", wake.samples(options.count(100, 1000)))
        cpu = CpuTimes({"driver": daemon.device_pids()["beam0"], "client": os.getpid()})
        late: list[int] = []
        with cell.open("beam0") as node:
            last: Any = node.read()
            edges = last.edges[0]
            while len(late) < count:
                event = node.wait_event(last=last, timeout=2.0)
                late.append(time.monotonic_ns() - event.stamp_ns)
                last = event
                report.progress(f"edge: {len(late)} of {count}")
            lost = node.read().edges[0] - edges - count
        report.samples(
            "edge to the waiting client awake", late, baseline=base, cpu=cpu.shares(), bars=[Bar("p50", TICK_US + 200)],
            notes=f"{max(0, lost)} edges not seen; the original: 500 us",
        )  # fmt: skip
