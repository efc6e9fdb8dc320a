"""Fit recorded frames of a finger on all cores: a row of numbers for each frame, as the finger's driver would have
published it.
"""

from __future__ import annotations

import argparse
import dataclasses
import os
import sys
from collections import Counter, deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import TextIO

import numpy as np

from sioms.documents import read_text
from sioms.tactile.chain import StrainFrame
from sioms.tactile.command.progress import Progress
from sioms.tactile.files import read_recording
from sioms.tactile.finger import Finger, from_toml
from sioms.tactile.quality import Load, Quality
from sioms.tactile.sensing import CHANNELS, LoadTare, Sensed, ShapeSensor, numbers
from sioms.tactile.touches import BASELINE, Recording

Block = list[tuple[StrainFrame, Load | None]]
FRAMES = 1000  # handed to a process at a time
HEAD = ("recording", "frame", "time_s", *(name for name, _, _ in CHANNELS))
_TOUCHED, _QUALITY = 0, len(CHANNELS) - 1


@dataclass(frozen=True, slots=True)
class Setting:
    """How frames are sensed; makes the same sensor in every process.

    Args:
        finger: the calibrated finger.
        compiled: as in ``ShapeSensor``.
        load_deviation: of the recorded force [N/m]; None leaves the force alone.
        settle_frames: averaged for the baseline, or as many as are marked before a touch.
    """

    finger: Finger
    compiled: bool | None
    load_deviation: float | None
    settle_frames: int

    def sensor(self) -> ShapeSensor:
        """Return a sensor that has seen nothing yet."""
        tare = None if self.load_deviation is None else LoadTare(1.0, self.load_deviation, 2.0)
        return ShapeSensor(self.finger, compiled=self.compiled, tare=tare, settle_frames=self.settle_frames)


_sensor: ShapeSensor  # of a process of the pool


def _begin(setting: Setting) -> None:
    global _sensor
    _sensor = setting.sensor()


def _fit(block: Block) -> list[tuple[float, ...]]:
    """Estimate a block of frames; which process does it does not matter, estimates need no state."""
    return [numbers(Sensed(strain, _sensor.shape(strain, load))) for strain, load in block]


def shape(args: argparse.Namespace) -> int:
    """Read, fit, write a table, tell what was found."""
    jobs = args.jobs or len(os.sched_getaffinity(0))
    compiled = False if args.plain else None
    finger = from_toml(read_text(args.finger))
    setting = Setting(finger, compiled, args.load_deviation, args.settle)
    setting.sensor()  # refuses nonsense before anything is written
    recordings = {path: _read(path, setting) for path in _paths(args.data)}
    tally, progress = Tally(), Progress()
    with (
        args.output.open("w", encoding="utf-8") as file,
        ProcessPoolExecutor(jobs, initializer=_begin, initargs=(setting,)) as pool,
    ):
        file.write(",".join(HEAD) + "\n")
        for path, recording in recordings.items():
            _write(file, path.stem, recording, rows(recording, setting, pool, 2 * jobs), tally, progress)
    progress.close()
    print(f"wrote {args.output}: {tally}")
    return 0


def _paths(given: list[Path]) -> list[Path]:
    paths = [path for entry in given for path in ([entry] if entry.is_file() else sorted(entry.glob("*.npz")))]
    if not paths:
        raise ValueError(f"fit frames: {given[0]} holds no *.npz; give recordings, or folders of them")
    return paths


def _read(path: Path, setting: Setting) -> Recording:
    """Read a recording.

    Raises:
        ValueError: no recording, or of another finger.
    """
    recording = read_recording(path)
    elements = len(setting.finger.angles_rad)
    if recording.raw.shape[1] != elements:
        raise ValueError(
            f"fit {path}: frames of {recording.raw.shape[1]} readings; finger {setting.finger.name!r} has {elements}"
        )
    return recording


def rows(
    recording: Recording, setting: Setting, pool: ProcessPoolExecutor, ahead: int
) -> Iterator[list[tuple[float, ...]]]:
    """Return the numbers of a recording's frames, block by block in order; `ahead` blocks are being
    fitted meanwhile.
    """
    waiting: deque[Future[list[tuple[float, ...]]]] = deque()
    for block in _blocks(recording, setting):
        waiting.append(pool.submit(_fit, block))
        if len(waiting) > ahead:
            yield waiting.popleft().result()
    while waiting:
        yield waiting.popleft().result()


def _blocks(recording: Recording, setting: Setting) -> Iterator[Block]:
    """Bring the frames through baseline and drift, which is done in their order.

    Frames that are marked as a touch's baseline are taken for what they say: nothing touches, begin anew from these.
    """
    anew, fewest = baselines(recording)
    sensor = dataclasses.replace(setting, settle_frames=min(setting.settle_frames, fewest)).sensor()
    stamps = np.round((recording.time_s - recording.time_s[:1]) * 1e9).astype(np.int64).tolist()
    force = recording.force.tolist()
    block: Block = []
    for number, raw in enumerate(recording.raw):
        if number in anew:
            sensor.zero()
        block.append(sensor.strain(raw, stamps[number], force[number]))
        if len(block) == FRAMES:
            yield block
            block = []
    if block:
        yield block


def baselines(recording: Recording) -> tuple[set[int], int]:
    """Return where the marked baselines of touches begin, and how many frames the shortest has; many without marks."""
    marked = np.where(recording.phase == BASELINE, recording.touch, -1)
    edges = np.flatnonzero(np.diff(marked, prepend=-1, append=-1))
    begins, ends = edges[:-1][marked[edges[:-1]] >= 0], edges[1:][marked[edges[:-1]] >= 0]
    return set(begins.tolist()), int(np.min(ends - begins, initial=sys.maxsize))


class Tally:
    """Counts frames, touched ones, and flags."""

    def __init__(self) -> None:
        self.frames = self.touched = self.good = 0
        self._flags: Counter[Quality] = Counter()

    def add(self, row: tuple[float, ...]) -> None:
        """Count a frame."""
        self.frames += 1
        if row[_TOUCHED] == 1.0:
            quality = Quality(int(row[_QUALITY]))
            self.touched += 1
            self.good += quality is Quality.GOOD
            self._flags.update(quality)

    def __str__(self) -> str:
        flags = ", ".join(f"{count} {flag.name}" for flag, count in self._flags.most_common())
        return f"{self.frames} frames, {self.touched} touched, {self.good} of these without a flag" + (
            f" ({flags})" if flags else ""
        )


def _write(
    file: TextIO, name: str, recording: Recording, blocks: Iterator[list[tuple[float, ...]]], tally: Tally,
    tell: Callable[[str], None],
) -> None:  # fmt: skip
    number, count = 0, len(recording.time_s)
    for block in blocks:
        for row in block:
            values = ",".join(f"{value:.9g}" for value in row)
            file.write(f"{name},{number},{recording.time_s[number]:.6f},{values}\n")
            tally.add(row)
            number += 1
        tell(f"{name}: {number} of {count} frames")
