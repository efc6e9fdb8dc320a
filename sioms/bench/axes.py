"""How many axes one core carries, and where the time of a tick goes (tables F.8 and F.7 of the dissertation).

One driver process of n simulated servo axes; half of them carry out random profiles out of filled
buffers, the others hold. A tick is everything: stops and leases looked at, physics advanced and
measured, plans, limits, control law, watching, publication of all readings.

Two counts a rate. As table F.8 has it: the usual tick, from its schedule to its end, fits into the period. And in
time: so do 99 of 100 ticks, and at most one of a thousand is left out; that is a question of the machine and its
other guests as much as of the driver.
"""

from __future__ import annotations

import random
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from sioms.check.daemon import CpuTimes, Daemon
from sioms.client.command import command

from .figures import Bar, Report
from .options import Options
from .workcells import workcell

ORIGINAL = {1000: 90, 2000: 35, 3000: 19, 5000: 4}
"""Axes of the best processor of table F.8, the 486DX2 at 66 MHz, by rate [Hz]."""
WANTED = {1000: 2000, 5000: 200}
FIRST_GUESS = {1000: 2500, 2000: 1000, 3000: 500, 5000: 200}
MOST = 10_000
GROUP = 20
MOVES = 40
SKIPPED, MANY_SKIPPED = 0.001, 0.05
PRIORITY = 90
"""Above other drivers on the machine: what one core carries is asked, not what is left of it."""


@dataclass(frozen=True, slots=True)
class Load:
    """What a number of axes took.

    Attributes:
        axes, rate: how many, how often [Hz].
        phases: statistics of the driver's ticks [ns].
        skipped: share of ticks that never ran.
        share: of one core.
    """

    axes: int
    rate: int
    phases: dict[str, Any]
    skipped: float
    share: float

    @property
    def median_us(self) -> float:
        """The usual tick from its schedule to the end of all that belongs to it [us]."""
        return float(self.phases["late_ns"]["50.0"] + self.phases["spent_ns"]["50.0"]) * 1e-3

    @property
    def p99_us(self) -> float:
        """The 99th percentile of a tick from its begin to the end of all that belongs to it [us]."""
        return float(self.phases["spent_ns"]["99.0"]) * 1e-3

    @property
    def carried(self) -> bool:
        """Whether the usual tick, from its schedule to its end, fits into the period."""
        return self.median_us * self.rate < 1e6 and self.skipped <= MANY_SKIPPED

    @property
    def in_time(self) -> bool:
        """Whether 99 of 100 ticks do; a late start alone does not make the next one late."""
        return self.p99_us < 1e6 / self.rate and self.skipped <= SKIPPED


def bench_axes(options: Options, report: Report) -> None:
    """Search the most axes at each rate; quick: only look whether the wanted numbers are carried."""
    seconds = options.count(1, 3)
    best: list[Load] = []
    for rate in [1000, 5000] if options.quick else [1000, 2000, 3000, 5000]:
        loads = _Loads(rate, seconds, report)
        if options.quick:
            found = loads.at(WANTED[rate])
            carried, in_time = (found if found and each(found) else None for each in CRITERIA)
        else:
            carried, in_time = (loads.search(each) for each in CRITERIA)
        bars = [Bar("value", WANTED[rate], True)] if rate in WANTED else []
        report.value(
            f"axes carried at {rate} Hz", carried.axes if carried else 0, "", bars=bars,
            notes=f"the 486DX2 of table F.8: {ORIGINAL[rate]}{_notes(carried)}",
        )  # fmt: skip
        report.value(f"axes in time at {rate} Hz", in_time.axes if in_time else 0, "", notes=_notes(in_time)[2:])
        best += [carried] if carried else []
    for load in [_measure(12, 1000, seconds), *best]:
        _break_down(load, report)


CRITERIA: tuple[Callable[[Load], bool], ...] = (lambda load: load.carried, lambda load: load.in_time)


def _notes(load: Load | None) -> str:
    if load is None:
        return ""
    return (
        f"; tick p50 {load.median_us:.0f} us, p99 {load.p99_us:.0f} us of {1e6 / load.rate:.0f} us, "
        f"{load.skipped:.2%} left out, core {load.share:.0%}"
    )


class _Loads:
    """Loads at one rate, each measured once.

    Concurrency: one thread.
    """

    def __init__(self, rate: int, seconds: float, report: Report) -> None:
        self._rate, self._seconds, self._report = rate, seconds, report
        self._known: dict[int, Load | None] = {}

    def at(self, axes: int) -> Load | None:
        """Return what a number of axes takes; None when the driver stops them because it is late by many periods."""
        if axes not in self._known:
            try:
                self._known[axes] = load = _measure(axes, self._rate, self._seconds)
            except (OSError, RuntimeError) as error:
                self._known[axes] = None
                self._report.note(f"{axes:6} axes at {self._rate} Hz: {error!s:.120}: too many")
            else:
                self._report.note(f"{axes:6} axes at {self._rate} Hz{_notes(load)}")
        return self._known[axes]

    def search(self, suits: Callable[[Load], bool]) -> Load | None:
        """Return the largest load found that suits: double or halve, then halve the interval four times."""
        low, high, best, n = 0, MOST + 1, None, FIRST_GUESS[self._rate]
        for _ in range(7):
            load = self.at(n)
            low, high, best = (n, high, load) if load is not None and suits(load) else (low, n, best)
            if high - low <= max(10, high // 20):
                break
            n = (low + high) // 2 if high <= MOST else min(2 * n, MOST)
        return best


def _measure(axes: int, rate: int, seconds: float) -> Load:
    with Daemon(_config(axes, rate)) as daemon, daemon.cell() as cell:
        watcher = cell.open("many.a0.readonly")
        groups = [cell.open(f"group{i}", "rw", 5.0) for i in range(_groups(axes))]
        for group in groups:
            _fill(group)
        time.sleep(0.3)
        cpu = CpuTimes({"driver": daemon.device_pids()["many"]})
        before = watcher.statistics(1)
        time.sleep(seconds)
        after = watcher.statistics(max(1, int(0.95 * seconds * rate)))
        share = cpu.shares()["driver"]
        moving = [sum(group.read().in_motion) for group in groups]
        wanted = len(groups) * len(groups[0].info.channels)
        if sum(moving) < wanted // 2:
            text = "; ".join(daemon.log().splitlines()[-3:])
            raise RuntimeError(f"load {axes} axes: {sum(moving)} of them move; want {wanted}; log: {text}")
    ticks = after["ticks"] - before["ticks"]
    left_out = after["skipped"] - before["skipped"]
    return Load(axes, rate, after, left_out / max(1, ticks + left_out), share)


def _groups(axes: int) -> int:
    """Return how many groups of axes make half of them."""
    return max(1, axes // (2 * GROUP))


def _config(axes: int, rate: int) -> str:
    device = (
        f'[device.many]\ndriver = "sim-axes"\nrealtime_priority = {PRIORITY}\ntick_hz = {rate}\nhistory = 4\ncapacity '
        "= 64\n"
        f'[[device.many.axis]]\nname = "a"\ncount = {axes}\nposition_min = -0.4\nposition_max = 0.4\nvelocity_max = '
        "1.0\n"
        "acceleration_max = 10.0\njerk_max = 1000.0\nforce_max = 60.0\nfollowing_error_max = 0.1\n"
        "motor = { mass = 1.0, viscous = 2.0, coulomb = 1.0, stiction = 1.5, encoder_step = 1e-6 }\n"
    )
    size = min(GROUP, axes // 2)
    names = [[f"a{g * GROUP + i}" for i in range(size)] for g in range(_groups(axes))]
    groups = [f'[node.group{g}]\nof = "many"\nchannels = {members}\n' for g, members in enumerate(names)]
    return workcell([device, *groups])


def _fill(group: Any) -> None:
    """Write random moves of some tenths of a second to all axes of a group."""
    generator = random.Random(group.name)
    axes = range(len(group.info.channels))
    for _ in range(0, MOVES, 10):
        group.write(
            b"".join([command(a, position=generator.uniform(-0.2, 0.2)) for _ in range(10) for a in axes]),
            5.0,
        )


def _break_down(load: Load, report: Report) -> None:
    """Say where the time of a tick goes, as table F.7 does."""
    names = {
        "late_ns": "scheduling",
        "input_ns": "stops, leases, measurement",
        "control_ns": "plans, limits, law, watching",
        "publish_ns": "publication, waits, events",
        "busy_ns": "whole tick",
        "total_ns": "from schedule to end",
        "spent_ns": "whole tick and, after it, simulated mechanics and plans ahead",
    }
    for phase, text in names.items():
        p = load.phases[phase]
        report.value(
            f"{load.axes} axes at {load.rate} Hz: {text}", p["50.0"] * 1e-3, "us",
            notes=f"p99 {p['99.0'] * 1e-3:.0f}, max {p['100.0'] * 1e-3:.0f}",
        )  # fmt: skip
