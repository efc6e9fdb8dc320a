"""A hundred remote readers, one of which is stopped: what local reads and writes take beside them.

Readers are in ten processes under three keys, each with a copy of the same device at 1 kHz, and read fifty times a
second. They stand for other machines: on this one they take what processor time nobody else wants. Local figures come
from before, beside and after them, so that a busy machine shows, and of a client and a driver on one core, so that the
same is compared (docs/decisions/1082-ratios-compare-the-same-place.md); all others are where the kernel puts them.
"""

from __future__ import annotations

import contextlib
import mmap
import os
import signal
import statistics
import time
from functools import partial
from typing import Any

from sioms.check.daemon import CpuTimes, Daemon, on_one_processor, wait_for
from sioms.check.remote import Gateway
from sioms.client.command import command
from sioms.client.keys import VARIABLE, Folder
from sioms.client.workcell import Workcell

from .figures import Bar, Report
from .options import Options
from .workcells import axes, workcell

PROCESSES = (11,) * 9 + (1,)
"""Readers of each process; the last one is stopped."""
KEYS = 3
PERIOD_S = 0.02
CHANGE = 1.1
"""Of local medians, by the readers."""


def _reader(address: str, folder: str, count: int, ready: mmap.mmap, place: int) -> None:
    """Have some sessions, and read in each of them now and then."""
    os.environ[VARIABLE] = folder
    with contextlib.ExitStack() as stack:
        nodes: list[Any] = []
        for _ in range(count):
            cell = stack.enter_context(Workcell(address, "reader"))
            nodes.append(stack.enter_context(cell.open("mod0.readonly")))
        ready[place] = 1
        os.nice(19)  # not before: beside other work a hundred sessions would take a minute
        while True:
            for node in nodes:
                with contextlib.suppress(OSError):  # stale: this process had no processor for long
                    node.read()
            time.sleep(PERIOD_S)


def bench_crowd(options: Options, report: Report) -> None:
    """Measure local latencies without readers, with a hundred, and without them again."""
    config = workcell([axes("mod0", 4, history=1024, limits=False), axes("mod1", 4, limits=False)])
    with (
        Daemon(config) as daemon, Gateway(daemon.socket) as gateway, daemon.cell() as cell,
        cell.open("mod1", "rw") as node, cell.open("mod0.readonly") as other,
    ):  # fmt: skip
        local = partial(_measure, options, report, node, other, daemon.device_pids()["mod1"])
        figures = [local("without remote readers")]
        pids = _begin(daemon, gateway)
        os.kill(pids[-1], signal.SIGSTOP)
        time.sleep(1.0)
        times = CpuTimes({"gateway": gateway.process.pid})
        figures.append(local(f"beside {sum(PROCESSES)}, one stopped"))
        report.value("share of a core that the gateway takes meanwhile [%]", 100 * times.shares()["gateway"])
        for pid in pids:
            daemon.kill(pid)
            daemon.reap(pid)
        time.sleep(1.0)
        figures.append(local("when they have left"))
    for what in figures[0]:
        without = statistics.mean(each[what] for each in (figures[0], figures[2]))
        report.value(
            f"local {what} beside remote readers, by the median without", figures[1][what] / without,
            bars=[Bar("value", CHANGE)],
        )  # fmt: skip


def _begin(daemon: Daemon, gateway: Gateway) -> list[int]:
    folders = [gateway.own.path]
    for number in range(1, KEYS):
        folder = Folder(f"{gateway.folder}/reader{number}")
        gateway.keys.allow(f"reader{number}", folder.new(f"reader{number}").public)
        folder.trust(f"{gateway.host}:{gateway.port}", gateway.public)
        folders.append(folder.path)
    time.sleep(0.3)
    ready = mmap.mmap(-1, mmap.PAGESIZE)
    pids = [
        daemon.fork(partial(_reader, gateway.socket, folders[place % KEYS], count, ready, place))
        for place, count in enumerate(PROCESSES)
    ]
    wait_for(lambda: sum(ready[: len(PROCESSES)]) == len(PROCESSES), 60.0, "a hundred readers")
    return pids


def _measure(options: Options, report: Report, node: Any, other: Any, driver: int, when: str) -> dict[str, float]:
    """Return medians of local reads and writes [ns]; writes come ten milliseconds apart and in a row."""
    with on_one_processor(os.getpid(), driver):
        taken = _calls(options, report, node, other, when)
    for what, samples in taken.items():
        report.samples(f"local {what}, {when}", samples)
    return {what: statistics.median(samples) for what, samples in taken.items()}


def _calls(options: Options, report: Report, node: Any, other: Any, when: str) -> dict[str, list[int]]:
    records = [command(0, position=p) for p in (1e-4, 0.0)]
    reads: list[int] = []
    rows: list[int] = []
    paced: list[int] = []
    clock = time.perf_counter_ns
    for turn in range(options.count(150, 1500)):
        time.sleep(0.01)
        for samples, act in (
            (paced, partial(node.write, records[turn & 1], replace=True)), (reads, other.read),
            *[(rows, partial(node.write, records[i & 1], replace=True)) for i in range(5)],
        ):  # fmt: skip
            begin = clock()
            act()
            samples.append(clock() - begin)
        report.progress(f"crowd: {when}, {turn}")
    return {"read": reads, "write, 10 ms apart": paced, "write, in a row": rows}
