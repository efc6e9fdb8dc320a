"""Reads out of the shared page, and how soon a subscriber wakes after a publication."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from typing import Any

from sioms.check.daemon import CpuTimes, Daemon, on_one_processor

from .baseline import RoundTrip, Wake
from .figures import Bar, Figure, Report
from .options import Options
from .workcells import axes, force, workcell

CHUNK = 200
SPEED = 8.0
SKIPPED = 0.001
"""Part of the publications that a subscriber may miss."""


def bench_read(options: Options, report: Report) -> None:
    """Read of a 4-axis node and of 48 analog channels, interleaved with bare round trips."""
    count = options.count(4_000, 100_000)
    config = workcell([axes("mod0"), axes("mod1", 24)])
    with Daemon(config) as daemon, daemon.cell() as cell, RoundTrip() as bare:
        driver = daemon.device_pids()["mod0"]
        with cell.open("mod0.readonly") as four, cell.open("mod1.plant") as many:
            one = cell.open("mod0.a0.readonly")
            reads: dict[str, Callable[[], Any]] = {
                "read of 4 axes": four.read,
                "read of 4 axes, positions taken": lambda: four.read().position,
                "read of 1 axis, position taken": lambda: one.read().position[0],
                "read of 48 analog channels, values taken": lambda: many.read().data,
            }
            taken: dict[str, list[int]] = {name: [] for name in reads}
            trips: list[int] = []
            cpu = CpuTimes({"client": os.getpid(), "driver": driver})
            while len(trips) < count:
                trips += bare.samples(CHUNK)
                for name, read in reads.items():
                    taken[name] += _time_calls(read, CHUNK)
                report.progress(f"read: {len(trips)} of {count}")
            shares = cpu.shares()
        base = report.samples("bare round trip", trips)
        trip = base.summary.values["p50"] if base.summary else 0.0
        for name, samples in taken.items():
            bars = [Bar("p50", 2.0), Bar("ratio", 1 / SPEED)] if "4 axes" in name else [Bar("p50", 5.0)]
            report.samples(name, samples, baseline=base, bars=bars)
        rate = 1e9 / sorted(taken["read of 1 axis, position taken"])[count // 2]
        report.value("reads per second, one Python client", rate, "1/s", cpu=shares, bars=[Bar("value", 7000, True)])
        report.value("channel values per second, 48 at a time", 48e9 / sorted(
            taken["read of 48 analog channels, values taken"])[count // 2], "1/s", bars=[Bar("value", 20_000, True)],
            notes=f"bare round trips per second {1e6 / trip:.0f}")  # fmt: skip


def _time_calls(call: Callable[[], Any], count: int) -> list[int]:
    clock = time.perf_counter_ns
    result = []
    for _ in range(count):
        begin = clock()
        call()
        result.append(clock() - begin)
    return result


def bench_update(options: Options, report: Report) -> None:
    """From the instant that a publication's values hold for to the subscriber holding them, all on one processor."""
    config = workcell(
        [force("force0", tick_hz=100), axes("slow", tick_hz=100, axis_keys="bandwidth_hz = 5"), axes("fast")]
    )
    cases = (
        ("force0", "six forces at 100 Hz", options.count(100, 2000)),
        ("slow.readonly", "four axes at 100 Hz", options.count(100, 2000)),
        ("fast.readonly", "four axes at 1000 Hz", options.count(1000, 10_000)),
    )
    with Wake() as wake:
        base = report.samples("bare eventfd wake", wake.samples(options.count(200, 3000)))
    with Daemon(config) as daemon, daemon.cell() as cell:
        for name, what, count in cases:
            _update(report, base, daemon, cell, name, what, count, [Bar("p50", 370), Bar("p99", 590)])
    alone = workcell([axes("slow", tick_hz=100, axis_keys="bandwidth_hz = 5")])
    with Daemon(alone) as daemon, daemon.cell() as cell:  # a neighbour at 1 kHz keeps the core awake
        what = "four axes at 100 Hz, no other device"
        bars = [Bar("p50", 150), Bar("p99", 400)]
        _update(report, base, daemon, cell, "slow.readonly", what, options.count(100, 2000), bars)


def _update(
    report: Report, base: Figure, daemon: Daemon, cell: Any, name: str, what: str, count: int, bars: list[Bar]
) -> None:
    driver = daemon.device_pids()[name.partition(".")[0]]
    with cell.open(name) as node, on_one_processor(driver, os.getpid()):
        cpu = CpuTimes({"driver": driver, "client": os.getpid()})
        waited, lost = _updates(node, count)
        report.samples(f"update to subscriber, {what}", waited, baseline=base, cpu=cpu.shares(), bars=bars)
    most = SKIPPED * count
    report.value("publications not seen one by one", lost, "", bars=[Bar("value", most)], notes=f"of {count}; {what}")


def _updates(node: Any, count: int) -> tuple[list[int], int]:
    """Return the ages of snapshots when they are in hand [ns], and how many were skipped."""
    result: list[int] = []
    first = number = node.wait_new(0).number
    while len(result) < count:
        snapshot = node.wait_new(number, 2.0)
        result.append(time.monotonic_ns() - snapshot.stamp_ns)
        number = snapshot.number
    return result, number - first - count
