"""Fuzzing: frames and files by the million, to each decoder in a process of its own, and to live sockets.

One list of targets (``decoders.TARGETS`` and ``live.LIVE``). None of what they are fed may end a process, raise what a
decoder does not name, or take more than its bounds of time and memory.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from sioms.children import ends_with_us

from .figures import Bar, Report
from .live import LIVE, bench_live
from .options import Options
from .search import counter, guided

if TYPE_CHECKING:
    from .decoders import Target

FRAMES, FILES = 20_000_000, 1_000_000
QUICK_FRAMES, QUICK_FILES = 60_000, 3_000
LED = 20
"""One input in so many is found by coverage; the others are changes at random of what those reached, many times as
fast.
"""
LIVE_SHARE = 0.05
"""Of the frames: what goes to live sockets takes ten times as long."""


def bench_fuzz(options: Options, report: Report) -> None:
    """Feed the targets that are asked for, or all, their shares of the frames and files."""
    from .decoders import TARGETS

    names = options.targets or (*TARGETS, *LIVE)
    if unknown := [name for name in names if name not in TARGETS and name not in LIVE]:
        raise RuntimeError(f"no target {unknown[0]}; there are: {', '.join((*TARGETS, *LIVE))}")
    if not guided():
        report.note("not guided by coverage: atheris is not installed")
    done = {True: 0, False: 0}
    broken = 0
    for name, runs in shares(options, TARGETS).items():
        if name in names and runs:
            tried, good = _search(name, runs, options.seed, report)
            done[TARGETS[name].frames] += tried
            broken += not good
    if live := [name for name in LIVE if name in names]:
        frames = options.frames if options.frames is not None else options.count(QUICK_FRAMES, FRAMES)
        done[True] += bench_live(live, int(frames * LIVE_SHARE), options.seed, report)
    report.value("frames in all", done[True])
    report.value("files in all", done[False])
    report.value("decoders broken", broken, bars=[Bar("value", 0)])


def shares(options: Options, targets: dict[str, Target]) -> dict[str, int]:
    """Return how many inputs each decoder gets."""
    frames = options.frames if options.frames is not None else options.count(QUICK_FRAMES, FRAMES)
    files = options.files if options.files is not None else options.count(QUICK_FILES, FILES)
    counts = {True: frames * (1.0 - LIVE_SHARE), False: float(files)}
    whole = {kind: sum(t.share for t in targets.values() if t.frames is kind) for kind in counts}
    return {name: -int(-counts[t.frames] * t.share // whole[t.frames]) for name, t in targets.items()}


def _search(name: str, runs: int, seed: int, report: Report) -> tuple[int, bool]:
    """Search one decoder; return how many inputs it took, and whether all was well."""
    folder, begin = Path(tempfile.mkdtemp(prefix="sioms-fuzz-")), time.monotonic()
    try:
        (folder / "corpus").mkdir()
        (folder / "count").write_bytes(bytes(8))
        tried = counter(str(folder / "count"))
        led = min(runs, max(runs // LED, 500)) if guided() else 0
        said, notes = "", ""
        if led:
            said = _child("guided", name, led, seed, folder, lambda: report.progress(f"{name}: {tried[0]} of {runs}"))
            notes = f"; {tried[0]} guided by coverage, which kept {len(list((folder / 'corpus').iterdir()))}"
        if not said and runs > led:
            said = _child(
                "random",
                name,
                runs - led,
                seed,
                folder,
                lambda: report.progress(f"{name}: {tried[0]} of {runs}"),
            )
        good = not said and tried[0] >= runs
        notes = f"{tried[0] / (time.monotonic() - begin):.0f} a second{notes}" + (f"; broken: {said}" if said else "")
        report.value(name, tried[0], notes=notes, bars=[Bar("value", runs, at_least=True)])
        return tried[0], good
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _child(how: str, name: str, runs: int, seed: int, folder: Path, progress: Callable[[], None]) -> str:
    """Search in a process of its own; return '' when all was well, else what it said."""
    words = [
        sys.executable,
        "-P",
        "-m",
        f"{__package__}.search",
        how,
        name,
        str(runs),
        str(seed),
        str(folder),
    ]
    with open(folder / "log", "wb") as log:
        child = subprocess.Popen(words, stdout=log, stderr=log, preexec_fn=ends_with_us())
    try:
        while child.poll() is None:
            progress()
            time.sleep(0.1)
    finally:
        child.kill()
        child.wait()
    if child.returncode == 0:
        return ""
    return f"status {child.returncode}: {(folder / 'log').read_text(errors='backslashreplace')[-1500:]}"
