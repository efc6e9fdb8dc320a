"""Measure shape estimation: time a frame, errors against theory, convergence."""

from __future__ import annotations

import argparse
import math
import os
import time
from concurrent.futures import ProcessPoolExecutor

import numpy as np
from numpy.typing import NDArray

from sioms.tactile.closedform import ellipse_spectrum, equivalent_radius
from sioms.tactile.cylinder import FINGER_B
from sioms.tactile.estimator import Estimator, Load
from sioms.tactile.finger import Finger, from_toml, nominal_finger
from sioms.tactile.series import spread
from sioms.tools.tactile import Progress

Floats = NDArray[np.float64]
NOISE = 1e-3
RADII = (0.5e-3, 1.59e-3, 3.9e-3, 6.01e-3, 12.3e-3, 25.25e-3, math.inf)


def published_finger(elements: int = 16) -> Finger:
    """Return the published finger, 16 elements at 9.22 degrees, or one with more over the same arc."""
    angles = np.radians(np.linspace(143.0, 143.0 - 9.22 * 15, elements))
    return nominal_finger(FINGER_B, angles, 10.3e-3, 1.0, NOISE)


def frames_of(finger: Finger, count: int, seed: int, noise: float = NOISE) -> tuple[Floats, Floats]:
    """Return noisy frames and their truth (angle [rad], load [N/m], R [m]): 25 to 400 N/m, edge to flat.

    Places keep one pitch from the outermost elements: nearer the end a touch has neighbours on one side only,
    and its theoretical deviation alone passes a degree at low loads.
    """
    random, widths, highest = np.random.default_rng(seed), finger.width_table(), finger.highest()
    matrix = finger.e_map()[:, : 2 * highest + 1]
    truth, frames = np.empty((count, 3)), np.empty((count, len(finger.angles_rad)))
    angles = np.sort(np.array(finger.angles_rad))
    low, high = float(angles[1]), float(angles[-2])
    for number in range(count):
        angle, load = random.uniform(low, high), random.uniform(25.0, 400.0)
        radius = equivalent_radius(finger.cylinder, float(random.choice(RADII)))
        spectrum = ellipse_spectrum(widths.half_width(load * radius) * np.arange(highest + 1))
        frames[number] = matrix @ spread(finger.cylinder, -load, spectrum, angle)
        truth[number] = angle, load, radius
    return frames + noise * random.normal(size=frames.shape), truth


def microseconds(estimator: Estimator, frames: Floats, load: Load | None = None) -> tuple[float, float]:
    """Return median and 99th percentile of the time of one frame [us]."""
    for strains in frames[:50]:
        estimator.frame(strains, load)
    times = []
    for strains in frames:
        begin = time.perf_counter_ns()
        estimator.frame(strains, load)
        times.append(time.perf_counter_ns() - begin)
    return float(np.median(times)) * 1e-3, float(np.percentile(times, 99)) * 1e-3


def _fit_share(work: tuple[int, int]) -> Floats:
    """Fit one process's share of the convergence test; return errors [deg] and standardised errors, shape (n, 4)."""
    count, seed = work
    finger = published_finger()
    frames, truth = frames_of(finger, count, seed)
    estimator = Estimator(finger, compiled=None)
    out = np.full((count, 4), np.nan)
    for number, shape in enumerate(estimator.batch(frames)):
        if shape.usable:
            fitted = np.array([shape.angle_rad, shape.load_n_per_m, shape.equivalent_radius_m])
            out[number, 0] = np.degrees(shape.angle_rad - truth[number, 0])
            if shape.width_rad > 0.05:  # away from the bound on the width
                out[number, 1:] = (fitted - truth[number]) / np.array(shape.deviations)
    return out


def errors(count: int, progress: Progress) -> Floats:
    """Fit frames on all cores, in shares, with progress."""
    cores = max(len(os.sched_getaffinity(0)), 1)
    shares = [(count // 20, 1000 + n) for n in range(20)]
    rows = []
    with ProcessPoolExecutor(cores) as pool:
        for part in pool.map(_fit_share, shares):
            rows.append(part)
            progress(f"convergence: {sum(len(row) for row in rows)} frames")
    return np.concatenate(rows)


def bench(args: argparse.Namespace) -> int:
    """Print the figures beside their bars."""
    finger = published_finger() if args.finger is None else from_toml(args.finger.read_text(encoding="utf-8"))
    progress = Progress()
    frames, _ = frames_of(finger, args.frames, 1, float(np.median(finger.strain_noise)))
    rows: list[tuple[str, str, str]] = []
    for name, compiled, bar in (("plain numpy", False, 700.0), ("compiled", True, 25.0)):
        try:
            estimator = Estimator(finger, compiled=compiled)
        except ImportError:
            rows.append((f"frame, {name}", "numba is not installed", f"{bar:g} us"))
            continue
        median, late = microseconds(estimator, frames)
        rows.append((f"frame, {name}, median / p99", f"{median:.1f} / {late:.1f} us", f"{bar:g} us"))
        median, late = microseconds(estimator, frames, Load(200.0, 50.0))
        rows.append((f"the same with a load cell, {name}", f"{median:.1f} / {late:.1f} us", ""))
        progress(name)
    if args.finger is None:
        wide = published_finger(48)
        many, _ = frames_of(wide, args.frames, 2)
        for name, choice in (("plain numpy", False), ("compiled if numba is there", None)):
            median, _ = microseconds(Estimator(wide, compiled=choice), many)
            rows.append((f"48 elements at 1 kHz, {name}", f"{median / 10:.1f} % of a core", "33 %"))
        progress("48 elements")
        miss = errors(max(args.frames * 5, 200), progress)
        rows.append((f"place, worst of {len(miss)}", f"{np.nanmax(np.abs(miss[:, 0])):.2f} deg", "2 deg"))
        rows.append(("frames without an estimate", f"{int(np.isnan(miss[:, 0]).sum())}", "0"))
        for column, what in ((1, "place"), (2, "load"), (3, "R")):
            # a robust width: R of small touches is far from normal
            width = float(np.subtract(*np.nanpercentile(miss[:, column], [84.13, 15.87]))) / 2.0
            rows.append((f"error over theory, {what}", f"{width:.3f}", "0.9 to 1.1"))
    progress.close()
    for what, value, limit in rows:
        print(f"{what:45s} {value:24s} {'bar ' + limit if limit else ''}")
    return 0
