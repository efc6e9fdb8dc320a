"""The shell tools: how soon devin has printed and devout written, and a loop that both close through a pipe."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from sioms.check.daemon import Daemon
from sioms.children import ends_with_us

from .baseline import interpreter_ns, run_ns
from .figures import Bar, Report
from .options import Options
from .watching import HISTORY, Watch
from .workcells import axes, wave, workcell

PERIOD_NS = 1_000_000
LEFT_OUT = 0.001
"""Part of the samples that may be left out."""
STEP_S = 0.0517
"""Period of the light beam whose steps go round the loop."""


def bench_pipe(options: Options, report: Report) -> None:
    """Start of devin and devout; lateness of its rows at 1 kHz; a step through devin, pipe and devout."""
    tools = [Path(sys.executable).with_name(name) for name in ("devin", "devout")]
    missing = [str(tool) for tool in tools if not tool.exists()]
    if missing:
        report.note(f"{missing[0]} is not installed: left out; install the package, also in place")
        return
    devices = [
        axes("mod0", history=HISTORY, limits=False, acceleration=100.0, jerk=None),
        wave("beam0", STEP_S),
    ]
    with Daemon(workcell(devices)) as daemon:
        environment = dict(os.environ, SIOMS_SOCKET=daemon.socket)
        devin, devout = (str(tool) for tool in tools)
        _start(options, report, devin, devout, environment)
        _loop(options, report, devin, devout, environment, "")
        try:
            with _realtime():
                _loop(options, report, devin, devout, environment, ", SCHED_FIFO")
        except PermissionError:
            report.note("SCHED_FIFO is not allowed to this user: left out")
        _steps(options, report, devin, devout, environment, daemon)


def _start(options: Options, report: Report, devin: str, devout: str, environment: dict[str, str]) -> None:
    lines = ([devin, "mod0"], [devout, "-W", "mod0.a0", "0"])
    bare: list[int] = []
    took: list[list[int]] = [[] for _ in lines]
    for _ in range(options.count(10, 200)):
        bare.append(interpreter_ns())
        for line, times in zip(lines, took, strict=True):
            times.append(run_ns(line, environment))
    base = report.samples("bare interpreter, start to exit", bare, "ms")
    for words, times in zip(("devin mod0", "devout -W mod0.a0 0"), took, strict=True):
        report.samples(f"{words}, start to exit", times, "ms", baseline=base, bars=[Bar("ratio", 0.6)])


@contextlib.contextmanager
def _realtime() -> Iterator[None]:
    """Run ourselves, and the tools started meanwhile, under SCHED_FIFO below all drivers."""
    os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(10))
    try:
        yield
    finally:
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


def _loop(options: Options, report: Report, devin: str, devout: str, environment: dict[str, str], how: str) -> None:
    """Let rows pass through our hands: when they come, which are left out, and whether devout keeps up."""
    rows = 1000 * options.count(2, 60)
    source = subprocess.Popen(
        [devin, "-t0.001", f"-L{rows}", "-n0p", "beam0", "-N"],
        env=environment,
        stdout=subprocess.PIPE,
        preexec_fn=ends_with_us(),
    )
    sink = subprocess.Popen(
        [devout, "-rv", "-L-1", "mod0.a0"], env=environment, stdin=subprocess.PIPE, preexec_fn=ends_with_us()
    )
    arrivals: list[tuple[int, int]] = []
    sampled: list[float] = []
    if source.stdout is None or sink.stdin is None:
        raise RuntimeError("run devin and devout: no pipes to them")
    for line in iter(source.stdout.readline, b""):
        now_ns = time.monotonic_ns()
        passed_s, number, value = line.split()
        sampled.append(1e9 * float(passed_s) - int(number) * PERIOD_NS)
        arrivals.append((int(number), now_ns))
        os.write(sink.stdin.fileno(), value + b"\n")
        report.progress(f"pipe: {len(arrivals)} of {rows} rows")
    last_ns = time.monotonic_ns()
    sink.stdin.close()
    statuses = source.wait(), sink.wait(10.0)
    drained_ms = (time.monotonic_ns() - last_ns) * 1e-6
    start_ns = min(at - number * PERIOD_NS for number, at in arrivals)
    late = [at - number * PERIOD_NS - start_ns for number, at in arrivals]
    limit = 300 if how else 1000
    report.samples(f"samples of devin -t0.001 after their schedule{how}", sampled, bars=[Bar("p99", limit)])
    report.samples(f"rows of devin -t0.001 through the pipe{how}", late)
    share = 100 * sum(one < PERIOD_NS for one in late) / len(late)
    report.value(f"cycles within 1 ms of schedule{how}", share, "%", bars=[Bar("value", 99.0, True)])
    report.value(
        f"rows lost between devin and devout{how}",
        rows - len(arrivals),
        "",
        bars=[Bar("value", 0)],
        notes=f"of {rows}; exit statuses {statuses}; devout ends {drained_ms:.0f} ms after its last row",
    )
    left_out = arrivals[-1][0] + 1 - len(arrivals)
    due = arrivals[-1][0] + 1
    bars = [Bar("value", LEFT_OUT * due)]
    report.value(f"samples left out, their time had passed{how}", left_out, "", bars=bars, notes=f"of {due}")


def _steps(
    options: Options, report: Report, devin: str, devout: str, environment: dict[str, str], daemon: Daemon
) -> None:
    """``devin | devout``, nothing between: from each edge of the beam to the axis commanded otherwise."""
    seconds = options.count(2, 60)
    source = subprocess.Popen(
        [devin, "-t0.001", f"-L{1000 * (seconds + 2)}", "-n0p", "beam0"],
        env=environment,
        stdout=subprocess.PIPE,
        preexec_fn=ends_with_us(),
    )
    sink = subprocess.Popen(
        [devout, "-rv", "-L-1", "mod0.a0"], env=environment, stdin=source.stdout, preexec_fn=ends_with_us()
    )
    if source.stdout is not None:
        source.stdout.close()  # theirs alone: the end of one must be seen by the other
    with daemon.cell() as cell, cell.open("beam0") as beam, cell.open("mod0.a0.readonly") as axis:
        Watch(axis).first(lambda s: s.commanded_velocity[0] > 0.5, 0, 20.0, "the loop to run")
        took = _step_times(beam, axis, seconds)
        source.terminate()
        source.wait()
        sink.wait(10.0)
    report.samples("edge of the beam to the axis following it, through the pipe", took, bars=[Bar("p50", 5000)])


def _step_times(beam: Any, axis: Any, seconds: float) -> list[int]:
    """Return the times from each edge to the first snapshot in which the commanded velocity follows it."""
    took: list[int] = []
    last = beam.read()
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        watch = Watch(axis)
        event = beam.wait_event(last=last, timeout=5.0)
        last = event
        before = watch.first(lambda s: True, event.stamp_ns - 2 * PERIOD_NS, 1.0, "a look before").commanded_velocity[0]
        sign = 1 if event.final else -1

        def follows(snapshot: Any, sign: int = sign, before: float = before) -> bool:
            return bool(sign * (snapshot.commanded_velocity[0] - before) > 1e-6)

        took.append(watch.first(follows, event.stamp_ns, 1.0, "the axis to follow").stamp_ns - event.stamp_ns)
    return took
