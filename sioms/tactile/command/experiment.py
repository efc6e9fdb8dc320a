"""Repeat the experiments of the published finger on a simulated one: probe, record, calibrate, tabulate."""

from __future__ import annotations

import argparse
import math
import tempfile
from pathlib import Path

import numpy as np

import sioms
from sioms.report_page import Page
from sioms.tactile.command.progress import Progress
from sioms.tactile.command.tables import calibrated, tables
from sioms.tactile.finger import to_toml
from sioms.tactile.live.prober import LENGTH_M, Prober, Touch, write_nominal
from sioms.tactile.live.simulated import FINGER, simulated
from sioms.whole_file import write_whole

ANGLES_DEG = 143.0 - 9.22 * np.arange(16)
RADII_M = (0.0, 0.5e-3, 1.59e-3, 3.9e-3, 6.01e-3, 7.55e-3, 9.3e-3, 12.3e-3, 18.71e-3, 25.25e-3, math.inf)
"""The indenters: an edge, nine radii, a flat."""


def plan(quick: bool) -> dict[str, list[Touch]]:
    """Return the touches: an edge all round, a flat all round, every indenter over forty degrees, and several loads."""
    step, part = (3.0, 4.0) if quick else (1.0, 1.0)
    round_all = np.radians(np.arange(0.0, 150.1, step))
    middle = np.radians(np.arange(55.0, 94.1, part))
    loads = [
        Touch(float(place), load, radius)
        for radius in (1.59e-3, 12.3e-3)
        for place in np.radians(np.arange(15.0, 140.0, 18.0 if quick else 9.0))
        for load in (50.0, 100.0, 150.0, 250.0)
    ]
    return {
        "edge": [Touch(float(t), 200.0, 0.0) for t in round_all],
        "flat": [Touch(float(t), 200.0, math.inf) for t in np.radians(np.arange(5.0, 145.1, 4 * step))],
        "indenters": [Touch(float(t), 200.0, radius) for radius in RADII_M for t in middle],
        "loads": loads,
    }


def probe(folder: Path, finger: str, quick: bool, progress: Progress) -> None:
    """Run the workcell with a simulated finger, touch it by plan, write the recordings."""
    write_nominal(folder / "nominal.json", np.radians(ANGLES_DEG))
    if "length_m" not in finger:
        finger += f"; length_m = {LENGTH_M}"
    with (
        tempfile.TemporaryDirectory(prefix="sioms-finger-", dir="/tmp") as place,
        simulated(Path(place), finger, RADII_M) as mount,
        sioms.Workcell(name="experiment") as cell,
        Prober(cell, mount) as prober,
    ):
        prober.quiet(1024 if quick else 8192).save(folder / "noise.npz")
        progress("noise")
        for name, touches in plan(quick).items():
            prober.run(touches, progress, name).save(folder / f"{name}.npz")
        seconds = 0.5 if quick else 2.0
        prober.ramps(np.radians(ANGLES_DEG).tolist(), 250.0, seconds, progress).save(folder / "ramp.npz")


def experiment(args: argparse.Namespace) -> int:
    """Probe, calibrate, print the tables beside the published ones and write them as a page."""
    args.output.mkdir(parents=True, exist_ok=True)
    progress = Progress()
    if not args.recorded:
        probe(args.output, args.finger or FINGER, args.quick, progress)
    data, result = calibrated(args.output, progress)
    write_whole(args.output / "finger.toml", to_toml(result.finger))
    page = Page("Experiments on a finger, beside the published ones")
    page.text(f"The finger: {args.finger or FINGER}." if not args.recorded else f"Recordings in {args.output}.")
    for warning in result.warnings:
        page.warn(warning)
        print(f"warning: {warning}")
    for table in tables(data, result, progress):
        print(f"\n{table.title}\n")
        widths = [max(len(str(row[i])) for row in (table.head, *table.rows)) for i in range(len(table.head))]
        for row in (table.head, *table.rows):
            print("  ".join(str(cell).ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip())
        page.head(table.title)
        page.table(table.head, table.rows)
    page.write(args.output / "experiment.html")
    progress.close()
    print(f"\nwrote {args.output}/experiment.html and finger.toml")
    return 0
