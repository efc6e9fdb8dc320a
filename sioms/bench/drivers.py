"""Drivers on lines that take their time: cycle against the arithmetic limit, streams, processor share, stops on a busy
line.

The simulators' ptys have no speed of their own, so a wire between carries each character at the configured baud rate in
both directions. The limit of a cycle is its characters times bits over baud, and the silences that the protocol
demands; the time that the simulated device takes to answer is measured by the wire and taken off, because it is not the
driver's.
"""

from __future__ import annotations

import itertools
import re
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from sioms.check.daemon import CpuTimes
from sioms.check.motion_trials import run, wait_moving
from sioms.check.rigs import Rig, find_rig
from sioms.check.station import Station, wait_for
from sioms.check.trial import Failed

from .figures import Bar, Report
from .options import Options

RATIO = 1.3
BRAKING = 0.98
"""Part of its speed below which a device has begun to brake."""
STOP_S = 2.0
SILENCE_CHARACTERS, SILENCE_S, FAST_BAUD = 3.5, 0.00175, 19200


@dataclass(frozen=True, slots=True)
class Case:
    """A driver at a speed of its line.

    Attributes:
        rig: name of it.
        baud: of the line.
        poll_hz: more than the line can carry; 0 leaves the rig's rate.
        modbus: a silence comes before each request.
        stops: measure emergency stops, too.
    """

    rig: str
    baud: int
    poll_hz: float
    modbus: bool = False
    stops: bool = False


CASES = (
    Case("tmcl", 9600, 100.0),
    Case("tmcl", 115200, 1000.0, stops=True),
    Case("dynamixel", 57600, 500.0),
    Case("dynamixel", 115200, 500.0),
    Case("dynamixel", 1000000, 1000.0, stops=True),
    Case("leadshine", 19200, 200.0, modbus=True),
    Case("leadshine", 115200, 500.0, modbus=True, stops=True),
    Case("oriental_az", 230400, 500.0, modbus=True, stops=True),
    Case("odrive", 115200, 400.0, stops=True),
    Case("grbl", 115200, 50.0, stops=True),
)
QUICK = {
    ("tmcl", 115200),
    ("dynamixel", 1000000),
    ("leadshine", 115200),
    ("odrive", 115200),
    ("grbl", 115200),
}
STREAMS = (("ati-rdt", 1000.0), ("schunk-ft", 1000.0), ("ft300", 100.0))


def bench_drivers(options: Options, report: Report) -> None:
    """Measure each family in turn."""
    for case in CASES:
        rig = find_rig(case.rig)
        if rig is None or (options.quick and (case.rig, case.baud) not in QUICK):
            continue
        _guarded(
            f"{case.rig} at {case.baud}",
            report,
            partial(_serial, options, report, rig, case),
        )
    for name, rate_hz in STREAMS:
        rig = find_rig(name)
        if rig is None:
            report.note(f"{name}: not installed, left out")
            continue
        _guarded(name, report, partial(_pushed, options, report, rig, rate_hz))
    _guarded("framed-adc", report, partial(_framed, options, report))


def _guarded(name: str, report: Report, work: Callable[[], None]) -> None:
    try:
        work()
    except (OSError, RuntimeError, Failed) as error:
        report.note(f"{name}: {error}")


def faster(rig: Rig, baud: int, poll_hz: float) -> Rig:
    """Return a rig with another speed of its line and another rate of polling."""
    tables = rig.tables
    if "baud" in tables:
        tables = re.sub(r"baud = \d+", f"baud = {baud}", tables)
    else:
        tables = tables.replace('serial = "{port}"', f'serial = "{{port}}", baud = {baud}')
    if poll_hz and "poll_hz" in tables:
        tables = re.sub(r"poll_hz = [\d.]+", f"poll_hz = {poll_hz:.1f}", tables)
    elif poll_hz:
        tables = re.sub(r"(driver = .*\n)", rf"\1poll_hz = {poll_hz:.1f}\n", tables, count=1)
    if rig.driver == "tmcl":
        tables = re.sub(r"(driver = .*\n)", r"\1heartbeat_s = 1.0\n", tables, count=1)
    return replace(rig, tables=tables)


# --- request and reply ---------------------------------------------------------------------------


def _serial(options: Options, report: Report, rig: Rig, case: Case) -> None:
    """Poll as fast as the line carries it; compare the cycle with the arithmetic limit."""
    with Station(faster(rig, case.baud, case.poll_hz)) as station:
        pid = station.status()["pid"]
        node = station.cell.open(station.nodes[0].reader)
        time.sleep(0.3)
        cpu = CpuTimes({"driver": pid})
        before, first, began = station.totals(), node.read(), time.monotonic()
        stamps = _stamps(station, node, 1.5 if options.quick else 8.0)
        after, last, took_s = station.totals(), node.read(), time.monotonic() - began
        share = cpu.shares()
        cycles = last.number - first.number
        moved = {key: (after[key] - before[key]) / cycles for key in after}
        line_s = (moved["request_bytes"] + moved["reply_bytes"]) * station.character_s
        silence_s = moved["requests"] * _silence(case, station) if case.modbus else 0.0
        device_s = moved["device_ns"] / 1e9
        cycle_s = took_s / cycles
        least_s = max(line_s + silence_s, 1 / case.poll_hz)
        name = f"{case.rig} {case.baud}"
        gaps = [b - a for a, b in itertools.pairwise(stamps)] or [int(1e9 * cycle_s)]
        notes = (
            f"{moved['requests']:.1f} requests, {moved['request_bytes'] + moved['reply_bytes']:.1f} characters a cycle"
        )
        report.samples(f"{name}: cycle", gaps, "ms", cpu=share, notes=notes)
        report.value(f"{name}: line time of a cycle", 1e3 * line_s, "ms")
        if silence_s:
            report.value(f"{name}: silences of a cycle", 1e3 * silence_s, "ms")
        report.value(f"{name}: the device's own time in a cycle", 1e3 * device_s, "ms")
        report.value(f"{name}: cycle over line time", cycle_s / line_s, "")
        bars = [Bar("value", RATIO, source="1.3 times the arithmetic limit of the line")]
        report.value(f"{name}: cycle less the device's time, over limit", (cycle_s - device_s) / least_s, "", bars=bars)
        report.value(f"{name}: processor share of the driver", share["driver"], "")
        node.close()
        if case.stops:
            _stops(options, report, station, name)


def _silence(case: Case, station: Station) -> float:
    """Return the silence that Modbus wants before a frame [s]."""
    gap_s = 0.004 if case.rig == "oriental_az" else 0.0
    return max(gap_s, SILENCE_S if case.baud > FAST_BAUD else SILENCE_CHARACTERS * station.character_s)


def _stamps(station: Station, node: Any, seconds: float) -> list[int]:
    """Return the stamps of all snapshots of a time [ns]."""
    stamps: list[int] = []
    number = node.read().number
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        time.sleep(0.02)
        for snapshot in node.history(number):
            number = snapshot.number
            stamps.append(snapshot.stamp_ns)
    return stamps


# --- stops ---------------------------------------------------------------------------------------


def _stops(options: Options, report: Report, station: Station, name: str) -> None:
    """Stop a running axis while its line is busy; how long until the device brakes."""
    axis = station.rig.axes[0]
    delays: list[int] = []
    for _ in range(options.slow(5, 100)):
        with station.cell.open(axis.node, "rw", timeout=5.0) as node:
            run(station, node, axis)
            wait_moving(station, node.read, axis)
            cruise = _cruising(station)
            begin = time.monotonic_ns()
            station.cell.emergency_stop(why="bench")
            if not wait_for(partial(_brakes, station, cruise), STOP_S, 0.0):
                report.note(f"{name}: a stop did not brake the device within {STOP_S:g} s")
                return
            delays.append(time.monotonic_ns() - begin)
            wait_for(partial(_stands, node), STOP_S)
        station.cell.reset()
        station.settle()
        report.progress(f"{name}: {len(delays)} stops")
    report.samples(f"{name}: emergency stop to the device braking", delays, "ms")


def _brakes(station: Station, cruise: float) -> bool:
    return abs(station.speed() or 0.0) < BRAKING * cruise


def _stands(node: Any) -> bool:
    return not node.read().in_motion[0]


def _cruising(station: Station) -> float:
    """Wait until the device's speed has settled; return it."""
    speed = abs(station.speed() or 0.0)
    while True:
        time.sleep(0.03)
        now = abs(station.speed() or 0.0)
        if abs(now - speed) <= 0.002 * speed:
            return now
        speed = now


# --- streams -------------------------------------------------------------------------------------


def _pushed(options: Options, report: Report, rig: Rig, rate_hz: float) -> None:
    """Count what a device that pushes sends, and what is published."""
    with Station(rig, paced=rig.line == "serial", wired=rig.line == "serial") as station:
        _count(options, report, station, rig.title, rate_hz)


def _framed(options: Options, report: Report) -> None:
    """5,000 frames a second of 16 elements."""
    rate_hz = 5000
    rig = find_rig("framed-adc")
    if rig is None:
        return
    tables = (
        f'[device.framed_adc]\ndriver = "framed-adc"\nchannels = 16\nrate_hz = {rate_hz}\nscale = 0.0005\nunit = "N"\n'
        'history = 4096\nline = { serial = "{port}", baud = 4000000 }\n'
    )
    simulator: Sequence[str] = (
        "sioms.drivers.framed_adc.simulator",
        "--channels",
        "16",
        "--max-rate",
        str(rate_hz),
    )
    with Station(replace(rig, tables=tables, simulator=simulator), wired=False) as station:
        _count(options, report, station, "framed-adc, 16 elements", rate_hz)


def _count(options: Options, report: Report, station: Station, name: str, rate_hz: float) -> None:
    seconds = 2.0 if options.quick else 30.0
    with station.cell.open(station.nodes[0].reader) as node:
        time.sleep(0.3)
        before = _lost(node.statistics(1))
        cpu = CpuTimes({"driver": station.status()["pid"]})
        first = node.read()
        time.sleep(seconds)
        last = node.read()
        share = cpu.shares()
        lost = _lost(node.statistics(1)) - before
    rate = (last.number - first.number) / ((last.stamp_ns - first.stamp_ns) / 1e9)
    bar = Bar("value", 0.99 * rate_hz, at_least=True, source="the device's rate")
    report.value(f"{name}: samples a second", rate, "1/s", cpu=share, bars=[bar])
    report.value(f"{name}: samples lost", lost, "", bars=[Bar("value", 0.0, source="no loss")])
    report.value(f"{name}: processor share of the driver", share["driver"], "")


def _lost(statistics: dict[str, object]) -> int:
    """Return what a stream has lost or found damaged."""
    counters = statistics.get("stream")
    if not isinstance(counters, dict):
        return 0
    words = ("lost", "bad", "malformed", "missed", "gap")
    return sum(int(value) for key, value in counters.items() if any(word in key for word in words))
