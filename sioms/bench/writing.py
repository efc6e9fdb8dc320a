"""Writes of axis commands, to their acknowledgement by the driver."""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from statistics import mean
from typing import Any

from sioms.check.daemon import CpuTimes, Daemon, on_processors
from sioms.client.command import command

from .baseline import RoundTrip
from .figures import Bar, Report
from .options import Options
from .paced import two_places
from .workcells import axes, workcell

CHUNK = 100
MANY = 10_000
KERNEL = "where the kernel puts them"
"""Each pair of processes finds a place of its own then, so that a ratio compares places, too, and has no bar."""


def bench_write(options: Options, report: Report) -> None:
    """One record and 16 in a row, in turn with bare round trips of processes at the same place; 10,000 appended."""
    config = workcell([axes("mod0"), axes("mod1", 16)])
    with Daemon(config) as daemon, daemon.cell() as cell, RoundTrip() as bare:
        drivers = [daemon.device_pids()[name] for name in ("mod0", "mod1")]
        with cell.open("mod0", "rw") as mod0, cell.open("mod1", "rw") as mod1:
            for where, (ours, theirs) in two_places(report).items():
                with on_processors({os.getpid(): ours, **dict.fromkeys([*drivers, bare.pid], theirs)}):
                    _in_a_row(options, report, (mod0, mod1), bare, where, drivers[0])
            _in_a_row(options, report, (mod0, mod1), bare, KERNEL, drivers[0])
            mod0.stop()
            mod0.wait_until_idle(5.0)
            _append_many(mod0, options, report)


def _in_a_row(options: Options, report: Report, nodes: Sequence[Any], bare: RoundTrip, where: str, driver: int) -> None:
    mod0, mod1 = nodes
    one = [command(0, position=p) for p in (0.001, -0.001)]
    velocity = [command(0, velocity=v) for v in (0.001, -0.001)]
    sixteen = [b"".join([command(i, position=p) for i in range(16)]) for p in (0.001, -0.001)]
    count, trips = options.count(1_000, 20_000), list[int]()
    taken: dict[str, list[int]] = {"1 position": [], "1 velocity": [], "16": []}
    cpu = CpuTimes({"client": os.getpid(), "driver": driver})
    while len(trips) < count:
        trips += bare.samples(CHUNK, len(one[0]))
        taken["1 position"] += _writes(mod0, one, CHUNK)
        taken["1 velocity"] += _writes(mod0, velocity, CHUNK)
        taken["16"] += _writes(mod1, sixteen, CHUNK)
        report.progress(f"write, {where}: {len(trips)} of {count}")
    shares = cpu.shares()
    base = report.samples(f"bare round trip, {where}", trips)
    for name, samples in taken.items():
        report.samples(
            f"write to acknowledgement, {name}, replacing, {where}", samples, baseline=base,
            bars=[Bar("p50", 145), *[Bar("ratio", 3.0)] * (where != KERNEL)] if name.startswith("1 ") else [],
            notes=f"{1e9 / mean(samples):.0f} a second, mean {mean(samples) / mean(trips):.1f} mean bare round trips",
        )  # fmt: skip
    report.value(f"processor share of the driver while written to, {where}", shares["driver"], "", cpu=shares)


def _writes(node: Any, records: list[bytes], count: int) -> list[int]:
    clock = time.perf_counter_ns
    result = []
    for i in range(count):
        record = records[i & 1]
        begin = clock()
        node.write(record, replace=True)
        result.append(clock() - begin)
    return result


def _append_many(node: Any, options: Options, report: Report) -> None:
    """Append a long trajectory of passing points with times, a quarter to each of four axes."""
    import numpy as np

    from sioms.protocol.flags import ControlMode, NodeClass
    from sioms.protocol.records import numpy_dtype

    index = np.arange(MANY) // 4
    records = np.zeros(MANY, dtype=numpy_dtype(NodeClass.AXIS))
    records["axis"] = np.arange(MANY) % 4
    records["control_mode"] = int(ControlMode.POSITION | ControlMode.VELOCITY | ControlMode.SPECIFIED_TIME)
    records["time"] = 0.01
    rate = 2 * np.pi * 0.5
    records["position"] = 0.05 * (1 - np.cos(rate * 0.01 * (index + 1)))
    records["velocity"] = 0.05 * rate * np.sin(rate * 0.01 * (index + 1))
    start = b"".join([command(axis, position=0.0) for axis in range(4)])
    samples = []
    for _ in range(options.count(3, 30)):
        node.write(start)
        node.wait_until_idle(10.0)
        begin = time.perf_counter_ns()
        node.write(records)
        samples.append(time.perf_counter_ns() - begin)
        node.stop()
        node.wait_until_idle(5.0)
    report.samples("append 10,000 commands in one write", samples, "ms", bars=[Bar("p50", 100), Bar("max", 100)])
