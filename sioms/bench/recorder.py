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


def bench_recorder(options: Options, report: Report) -> None:
    """Record 24 axes at 1 kHz; kill recorders; replay a recording."""
    with Daemon(workcell([axes("mod0", AXES, history=256, limits=False)])) as daemon:
        _share(options, report, daemon)
    small = [axes("mod0", 4, history=256, limits=False), axes("mod1", 4, history=256), force("beam0")]
    with Daemon(workcell(small)) as daemon:
        _kills(options, report, daemon)
        _replay(options, report, daemon)


def _record(daemon: Daemon, path: Path) -> subprocess.Popen[bytes]:
    """Start ``sioms record`` of everything."""
    words = [sys.executable, "-P", "-m", "sioms.tools.front", "record", "-o", str(path)]
    environment = {**os.environ, "SIOMS_SOCKET": daemon.socket}
    return subprocess.Popen(words, env=environment, stderr=subprocess.DEVNULL, preexec_fn=ends_with_us())


def _share(options: Options, report: Report, daemon: Daemon) -> None:
    with tempfile.TemporaryDirectory(prefix="sioms-record-") as folder, daemon.cell() as cell:
        with cell.open("mod0", "rw") as node:
            node.write([command(axis, velocity=1e-3) for axis in range(AXES)])
            path = Path(folder) / "a.mcap"
            with _record(daemon, path) as process:
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
    with tempfile.TemporaryDirectory(prefix="sioms-record-") as folder:
        path, again = Path(folder) / "a.mcap", Path(folder) / "b.mcap"
        with daemon.cell() as cell, cell.open("mod0", "rw") as node, _record(daemon, path) as process:
            node.write([command(axis, velocity=1e-3 * (axis + 1)) for axis in range(4)])
            time.sleep(options.count(3, 60))
            process.send_signal(signal.SIGINT)
        words = [sys.executable, "-P", "-m", "sioms.tools.front"]
        subprocess.run(
            [*words, "replay", "-r", "2", str(path), "--", *words, "record", "-t", str(options.count(4, 40)), "-o",
             str(again)],
            check=True, stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL,
        )  # fmt: skip
        for name, values in _values(path).items():
            found = _values(again)[name]
            differ, begin = _compare(values, found)
            report.value(
                f"values of {name} that a replay does not publish again", differ, bars=[Bar("value", 0)],
                notes=f"of {values.size} in {len(values)} snapshots, from the {begin}. on",
            )  # fmt: skip


def _values(path: Path) -> dict[str, Any]:
    """Return all columns of all snapshots of each node, without number, stamp and tick."""
    with Recording(path) as recording:
        return {name: np.concatenate([s[:, 4:] for s in recording.slots(name)]) for name in recording.nodes}


def _compare(values: Any, found: Any) -> tuple[int, int]:
    """Return how many values differ from where the second recording begins, and where that is.

    The recorder of a replay may come after its first snapshots; from then on all must follow, up to the last.
    """
    begin = len(values) - len(found)
    if begin < 0:
        return int(found.size - values.size), 0
    return int(np.count_nonzero(values[begin:] != found)), begin
