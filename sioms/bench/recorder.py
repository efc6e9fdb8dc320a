"""The recorder: what it takes of a core, what a kill of it loses, and whether a replay publishes every value again."""

from __future__ import annotations

import mmap
import os
import random
import signal
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from sioms.check.daemon import CpuTimes, Daemon, wait_for
from sioms.children import ends_with_us
from sioms.client.command import command
from sioms.client.workcell import Workcell
from sioms.recording.live.files import LiveFile
from sioms.recording.live.recorder import Recorder
from sioms.recording.reader import Recording

from .figures import Bar, Report
from .options import Options
from .workcells import axes, force, workcell

AXES = 24
SHARE = 0.03
"""Of a core, which recording 24 axes at 1 kHz may take."""
_COUNT = struct.Struct("<Q")
_SHORT_S = 60
_FAST = 100.0
"""How much faster than it was recorded a long recording is replayed, where the machine keeps up."""


def bench_recorder(options: Options, report: Report) -> None:
    """Record 24 axes at 1 kHz; kill recorders; replay a recording."""
    with Daemon(workcell([axes("mod0", AXES, history=256, limits=False)])) as daemon:
        _share(options, report, daemon)
    small = [axes("mod0", 4, history=256, limits=False), axes("mod1", 4, history=256), force("beam0")]
    with Daemon(workcell(small)) as daemon:
        _kills(options, report, daemon)
        _replay(options, report, daemon)


def _record(socket: str, path: Path) -> subprocess.Popen[bytes]:
    """Start ``sioms record`` of everything."""
    words = [sys.executable, "-P", "-m", "sioms.tools.front", "record", "-o", str(path)]
    environment = {**os.environ, "SIOMS_SOCKET": socket}
    return subprocess.Popen(words, env=environment, stderr=subprocess.DEVNULL, preexec_fn=ends_with_us())


def _share(options: Options, report: Report, daemon: Daemon) -> None:
    with tempfile.TemporaryDirectory(prefix="sioms-record-") as folder, daemon.cell() as cell:
        with cell.open("mod0", "rw") as node:
            node.write([command(axis, velocity=1e-3) for axis in range(AXES)])
            path = Path(folder) / "a.mcap"
            with _record(daemon.socket, path) as process:
                wait_for(lambda: path.exists() and path.stat().st_size > 1_000_000, 30.0, "a recording")
                times, size = CpuTimes({"recorder": process.pid}), path.stat().st_size
                seconds = options.count(5, 60)
                time.sleep(seconds)
                share, rate = times.shares()["recorder"], (path.stat().st_size - size) / seconds
                process.send_signal(signal.SIGINT)
        with Recording(path) as recording:
            numbers = np.concatenate([slots[:, 0] for slots in recording.slots("mod0")]).astype(np.int64)
        missing = int(numbers[-1] - numbers[0] + 1 - len(numbers))
        report.value(
            f"share of a core that records {AXES} axes at 1 kHz [%]", 100 * share, bars=[Bar("value", 100 * SHARE)],
            notes=f"{rate / 1e6:.1f} MB/s",
        )  # fmt: skip
        report.value("snapshots missing in it", missing, bars=[Bar("value", 0)], notes=f"of {len(numbers)}")


# --- kills ----------------------------------------------------------------------------------------


def _recorder(address: str, path: str, safe: mmap.mmap) -> None:
    """Be a recorder that says, after each look, the sum of the snapshots that are safe."""
    recorder = Recorder(LiveFile(path), lambda: Workcell(address, "recorder"))
    while True:
        recorder.look()
        _COUNT.pack_into(safe, 0, sum(recorder.recorded.values()))
        time.sleep(recorder.period_s / 4)


def _kills(options: Options, report: Report, daemon: Daemon) -> None:
    dice, trials = random.Random(options.seed), options.slow(5, 200)
    lost = acknowledged = 0
    for trial in range(trials):
        with tempfile.TemporaryDirectory(prefix="sioms-record-") as folder:
            safe, path = mmap.mmap(-1, mmap.PAGESIZE), f"{folder}/a.mcap"
            pid = daemon.fork(partial(_recorder, daemon.socket, path, safe))
            wait_for(lambda safe=safe: _COUNT.unpack_from(safe)[0] > 0, 30.0, "a recording")  # type: ignore[misc]
            time.sleep(0.3 * dice.random())
            daemon.kill(pid)
            daemon.reap(pid)
            promised = _COUNT.unpack_from(safe)[0]
            with Recording(path) as recording:
                kept = sum(len(slots) for name in recording.nodes for slots in recording.slots(name))
            lost, acknowledged = lost + max(0, promised - kept), acknowledged + promised
        report.progress(f"recorder: kill {trial} of {trials}")
    report.value(
        "acknowledged snapshots lost by SIGKILLs of the recorder", lost, bars=[Bar("value", 0)],
        notes=f"of {acknowledged} in {trials} kills",
    )  # fmt: skip


# --- replay ---------------------------------------------------------------------------------------


def _replay(options: Options, report: Report, daemon: Daemon) -> None:
    """Record, replay with a recorder beside it, and compare every column of every snapshot."""
    seconds = options.soak or options.count(3, 60)
    with tempfile.TemporaryDirectory(prefix="sioms-record-") as folder:
        path, again = Path(folder) / "a.mcap", Path(folder) / "b.mcap"
        with daemon.cell() as cell, cell.open("mod0", "rw") as node, _record(daemon.socket, path) as process:
            for _ in range(seconds):
                node.write([command(axis, velocity=0.01 * (random.random() - 0.5)) for axis in range(4)])
                time.sleep(1.0)
            process.send_signal(signal.SIGINT)
        play(path, again, 2.0 if seconds <= _SHORT_S else _FAST)
        for name, (differ, compared, begin) in compare(path, again).items():
            report.value(
                f"values of {name} that a replay does not publish again", differ, bars=[Bar("value", 0)],
                notes=f"of {compared}, from the {begin}. snapshot on",
            )  # fmt: skip


def play(path: Path, again: Path, rate: float) -> None:
    """Replay a recording to its end at so many times its speed, and record that."""
    with tempfile.TemporaryDirectory(prefix="sioms-replay-") as folder:
        words, socket = [sys.executable, "-P", "-m", "sioms.tools.front"], f"{folder}/sock"
        replay = subprocess.Popen(
            [*words, "replay", "-r", str(rate), "--socket", socket, str(path)],
            stdout=subprocess.DEVNULL, preexec_fn=ends_with_us(),
        )  # fmt: skip
        wait_for(lambda: os.path.exists(socket), 30.0, "a replay")
        with _record(socket, again) as recorder:
            replay.wait()
            recorder.send_signal(signal.SIGINT)


def compare(path: Path, again: Path) -> dict[str, tuple[int, int, int]]:
    """Compare a recording with that of its replay, in which a snapshot's number is its place in the first one.

    The recorder of a replay comes after its first snapshots; from then on all must follow, up to the last.

    Returns:
        By node how many values differ or are missing, of how many, and from which snapshot on.
    """
    with Recording(path) as first, Recording(again) as second:
        return {name: _compare(first.slots(name), second.slots(name)) for name in first.nodes}


def _compare(recorded: Iterator[Any], published: Iterator[Any]) -> tuple[int, int, int]:
    rest = _counted(next(recorded))
    differ = compared = begin = after = 0
    for rows in published:
        numbers = rows[:, 0].astype(np.int64)
        while after + len(rest) < numbers[-1] and (more := next(recorded, None)) is not None:
            rest = np.concatenate([rest, _counted(more)])
        if not begin:
            begin = int(numbers[0])
            rest, after = rest[begin - 1 :], begin - 1
        wanted, rest = rest[: numbers[-1] - after], rest[numbers[-1] - after :]
        found = np.isin(np.arange(after + 1, after + 1 + len(wanted)), numbers)
        same = _counted(rows)[: int(found.sum())]
        differ += int(np.count_nonzero(wanted[found] != same)) + abs(len(wanted) - len(rows)) * wanted.shape[1]
        compared, after = compared + wanted.size, after + len(wanted)
    left = rest.size + sum(_counted(rows).size for rows in recorded)
    return differ + left, compared + left, begin


def _counted(slots: Any) -> Any:
    """Return what a replay does not change: the tick, and all columns of all channels."""
    return slots[:, [2, *range(4, slots.shape[1])]]
