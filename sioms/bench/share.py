"""What devices take of a core while they work and while nobody asks for anything, beside an empty loop.

Each device has a daemon of its own and takes turns with a process that waits for a timer and does nothing else, all on
one core: what the machine takes for the wake itself is in both.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from sioms.check.daemon import CpuTimes, Daemon, memory_kb
from sioms.children import ends_with_us
from sioms.client.command import command

from .figures import Bar, Report
from .options import Options
from .workcells import axes, stepper, workcell

_EMPTY = """
import ctypes, os, select, struct, sys
libc = ctypes.CDLL(None)
timer = libc.timerfd_create(1, 0)
period_ns = int(sys.argv[1])
libc.timerfd_settime(timer, 0, struct.pack("qqqq", period_ns // 10**9, period_ns % 10**9, 0, 1000), None)
epoll = select.epoll()
epoll.register(timer, select.EPOLLIN)
while True:
    epoll.poll()
    os.read(timer, 8)
"""
WAY_M, MOVE_S, MOVES = 0.02, 0.25, 4000
IDLE_S = 2.5
"""A device that nobody looks at is idle after a second."""
DEMO = Path("etc/demo.toml")


def bench_share(options: Options, report: Report) -> None:
    """Processor of moving axes, of one stepper, and of the idle demonstration cell."""
    seconds, rounds = options.count(1, 5), options.count(2, 6)
    cases = (
        ("4 axes at 1000 Hz, moving", axes("mod0", history=64), 1000, 4.0),
        ("1 stepper at 1000 Hz, moving", stepper("mod0"), 1000, 3.5),
        ("4 axes at 250 Hz, moving", axes("mod0", tick_hz=250, axis_keys="bandwidth_hz = 5.0"), 250, None),
        ("4 axes at 100 Hz, moving", axes("mod0", tick_hz=100, axis_keys="bandwidth_hz = 5.0"), 100, None),
    )
    for what, device, rate_hz, most in cases:
        with Daemon(workcell([device]), _core()) as daemon, daemon.cell() as cell, cell.open("mod0", "rw") as node:
            driver = {"driver": daemon.device_pids()["mod0"]}
            bare, taken = [], []
            for _ in range(rounds):
                with _empty(rate_hz) as empty:
                    bare.append(_share({"empty": empty}, seconds))
                _move(node)
                taken.append(_share(driver, seconds))
                node.stop()
                node.wait_until_idle(5.0)
            _tell(report, what, rate_hz, bare, taken, most)
    _demo(report, options)


def _tell(report: Report, what: str, rate_hz: int, bare: list[float], taken: list[float], most: float | None) -> None:
    """Tell the medians, which a foreign load of a second does not move."""
    loop, share = (100 * sorted(each)[len(each) // 2] for each in (bare, taken))
    notes = f"{share / loop:.2f} x an empty loop of {loop:.2f} %; {min(taken):.1%} to {max(taken):.1%}"
    bars = [] if most is None else [Bar("value", most)]
    report.value(f"processor share of {what}", share, "%", bars=bars, notes=notes)


def _core() -> int:
    return max(os.sched_getaffinity(0))


def _share(pids: dict[str, int], seconds: float) -> float:
    cpu = CpuTimes(pids)
    time.sleep(seconds)
    return sum(cpu.shares().values())


def _move(node: Any) -> None:
    """Fill the buffers with moves to and fro."""
    channels = range(len(node.info.channels))
    most = min(MOVES, node.info.buffer_capacity)
    node.write([command(a, position=WAY_M * (i % 2), time=MOVE_S) for i in range(most) for a in channels])
    time.sleep(0.3)


@contextmanager
def _empty(rate_hz: int) -> Iterator[int]:
    """Run an empty loop of a rate on our core, in the class of drivers where that is allowed; yield its pid."""
    process = subprocess.Popen(
        ["taskset", "-c", str(_core()), sys.executable, "-IS", "-c", _EMPTY, str(10**9 // rate_hz)],
        preexec_fn=ends_with_us(),
    )
    try:
        time.sleep(0.2)
        yield process.pid
    finally:
        process.kill()
        process.wait()


def _demo(report: Report, options: Options) -> None:
    """The whole demonstration cell with no client: processor and memory of all its processes."""
    path = next((root / DEMO for root in Path(__file__).parents if (root / DEMO).exists()), None)
    if path is None:
        report.note(f"{DEMO} is not installed: the idle demonstration cell is left out")
        return
    text = re.sub(r'(_file = ")(?=[^/])', rf"\g<1>{path.parent}/", path.read_text(encoding="utf-8"))
    with Daemon(text, _core()) as daemon:
        time.sleep(IDLE_S)
        pids = {str(pid): pid for pid in [daemon.pid, *_below(daemon.pid)]}
        share = 100 * _share(pids, options.count(2, 20))
        memory = sum(memory_kb(pid)["pss"] for pid in pids.values()) / 1024
        tactile = memory_kb(daemon.device_pids()["tactile0"])
    bars = [Bar("value", 10.0)]
    notes = f"{len(pids)} processes"
    report.value("processor share of the idle demonstration cell", share, "%", bars=bars, notes=notes)
    report.value("memory of the idle demonstration cell, shared pages counted once", memory, "MiB")
    bars = [Bar("value", 12.0)]
    notes = f"rss {tactile['rss']} pss {tactile['pss']} KiB"
    report.value("private memory of its tactile finger", tactile["private"] / 1024, "MiB", bars=bars, notes=notes)


def _below(pid: int) -> list[int]:
    """Return the processes that a process, and those below it, have started."""
    children = [int(one) for one in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]
    return [each for child in children for each in (child, *_below(child))]
