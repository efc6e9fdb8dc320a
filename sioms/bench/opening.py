"""Opens and closes: how fast, whether anything is left behind, and whether two writers can win."""

from __future__ import annotations

import errno
import os
import time
from collections.abc import Iterator

from sioms.check.daemon import CpuTimes, Daemon, descriptors, memory_kb
from sioms.client.workcell import Workcell

from .baseline import RoundTrip
from .figures import Bar, Report
from .options import Options
from .workcells import axes, workcell

CHUNK = 100
WARM = 2_000
GAIN_KB = 1024


def bench_open(options: Options, report: Report) -> None:
    """Open and close of an output node and of its companion; with a soak also what is left behind."""
    count = options.count(500, 20_000)
    with Daemon(workcell([axes("mod0")])) as daemon, daemon.cell() as cell, RoundTrip() as bare:
        pids = {"daemon": daemon.pid, "driver": daemon.device_pids()["mod0"], "client": os.getpid()}
        trips: list[int] = []
        taken: dict[str, list[int]] = {"mod0": [], "mod0.readonly": []}
        cpu = CpuTimes(pids)
        while len(trips) < count:
            trips += bare.samples(CHUNK)
            for name, samples in taken.items():
                samples += _opens(cell, name, CHUNK)
            report.progress(f"open: {len(trips)} of {count}")
        shares = cpu.shares()
        base = report.samples("bare round trip", trips)
        for name, samples in taken.items():
            report.samples(f"open and close of {name}", samples, baseline=base)
        rate = 1e9 / sorted(taken["mod0"])[len(taken["mod0"]) // 2]
        report.value("opens and closes per second", rate, "1/s", cpu=shares)
        _soak(cell, pids, options.soak or options.count(2_000, 100_000), report)


def _opens(cell: Workcell, name: str, count: int) -> list[int]:
    clock = time.perf_counter_ns
    result = []
    for _ in range(count):
        begin = clock()
        cell.open(name, "r").close()
        result.append(clock() - begin)
    return result


def _soak(cell: Workcell, pids: dict[str, int], count: int, report: Report) -> None:
    """Open and close many times; the processes must stay as they were."""
    _opens(cell, "mod0", WARM)
    before = {who: (descriptors(pid), memory_kb(pid)["private"]) for who, pid in pids.items()}
    begin = time.monotonic()
    for done in range(0, count, CHUNK):
        for _ in range(min(CHUNK, count - done)):
            cell.open("mod0", "r").close()
        report.progress(f"soak: {done} of {count}")
    took = time.monotonic() - begin
    notes = f"{count} opens and closes in {took:.0f} s"
    for who, pid in pids.items():
        fds, private = descriptors(pid), memory_kb(pid)["private"]
        report.value(f"descriptors gained by the {who}", fds - before[who][0], "", bars=[Bar("value", 0)], notes=notes)
        report.value(
            f"private memory gained by the {who}",
            private - before[who][1],
            "KiB",
            bars=[Bar("value", GAIN_KB)],
        )


def bench_race(options: Options, report: Report) -> None:
    """Two sessions of two processes open one output at the same time: exactly one must win."""
    trials = options.count(500, 100_000)
    with Daemon(workcell([axes("mod0")])) as daemon:
        racers = [_Racer(daemon) for _ in range(2)]
        winners = {0: 0, 1: 0, 2: 0}
        times: list[int] = []
        for done in range(trials):
            begin = time.monotonic_ns()
            for racer in racers:
                racer.tell()
            won = sum([racer.hear() for racer in racers])
            times.append(time.monotonic_ns() - begin)
            winners[won] += 1
            for racer in racers:
                racer.tell()  # close, or go on
            for racer in racers:
                racer.hear()
            report.progress(f"race: {done} of {trials}")
        report.samples("race of two opens, both answered", times)
        wrong = winners[0] + winners[2]
        report.value(
            "races without exactly one winner", wrong, "", bars=[Bar("value", 0)],
            notes=f"{trials} trials: none won {winners[0]}, one won {winners[1]}, both won {winners[2]}",
        )  # fmt: skip


class _Racer:
    """A forked client that opens when told, tells whether it won, and closes when told again."""

    def __init__(self, daemon: Daemon) -> None:
        hears, self._tells = os.pipe()
        self._hears, tells = os.pipe()

        def race() -> None:
            with daemon.cell("racer") as cell:
                for won in self._turns(cell, hears):
                    os.write(tells, bytes([won]))

        daemon.fork(race)

    def _turns(self, cell: Workcell, hears: int) -> Iterator[int]:
        while os.read(hears, 1):
            node = None
            try:
                node = cell.open("mod0", "rw")
            except OSError as error:
                if error.errno != errno.EBUSY:
                    raise
            yield int(node is not None)
            os.read(hears, 1)
            if node is not None:
                node.close()
            yield 0

    def tell(self) -> None:
        """Let it take its next step."""
        os.write(self._tells, b".")

    def hear(self) -> int:
        """Return what it answers."""
        answer = os.read(self._hears, 1)
        if not answer:
            raise RuntimeError("race: a racer has died; want it to live to the end")
        return answer[0]
