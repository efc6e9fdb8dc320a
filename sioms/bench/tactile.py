"""Shape estimation: time of a frame, share of a core, errors against theory, convergence, frames a second on all
cores.
"""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor

import numpy as np
from numpy.typing import NDArray

from sioms.tactile.closedform import equivalent_radius
from sioms.tactile.cylinder import FINGER_B
from sioms.tactile.estimator import Estimator
from sioms.tactile.finger import Finger, nominal_finger
from sioms.tactile.model import pressed
from sioms.tactile.quality import Load
from sioms.tactile.sensing import ShapeSensor
from sioms.tactile.series import spread

from .figures import Bar, Report
from .options import Options
from .touches import bench_touches

Floats = NDArray[np.float64]

NOISE = 1e-3
RADII = (0.5e-3, 1.59e-3, 3.9e-3, 6.01e-3, 12.3e-3, 25.25e-3, math.inf)
SHARES = 20  # of the frames of the convergence test, each by a process
_WIDE = 0.05  # rad; narrower contacts lie against the bound at zero width, where theory ends


def finger_of(elements: int) -> Finger:
    """Return the published finger, 16 elements at 9.22 degrees, or one with more over the same arc."""
    angles = np.radians(np.linspace(143.0, 143.0 - 9.22 * 15, elements))
    return nominal_finger(FINGER_B, angles, 10.3e-3, 1.0, NOISE)


def frames_of(finger: Finger, count: int, seed: int) -> tuple[Floats, Floats]:
    """Return noisy strains of touches all over the arc and their truth (angle [rad], load [N/m], R [m]).

    25 to 400 N/m, from an edge to a flat; shapes (count, ns) and (count, 3).
    """
    random, widths, highest = np.random.default_rng(seed), finger.width_table(), finger.highest()
    matrix, spectra = finger.e_map()[:, : 2 * highest + 1], pressed(finger.cylinder, highest)
    truth, frames = np.empty((count, 3)), np.empty((count, len(finger.angles_rad)))
    low, high = min(finger.angles_rad), max(finger.angles_rad)
    for number in range(count):
        angle, load = random.uniform(low, high), random.uniform(25.0, 400.0)
        radius = equivalent_radius(finger.cylinder, float(random.choice(RADII)))
        spectrum = spectra(widths.half_width(load * radius))
        frames[number] = matrix @ spread(finger.cylinder, -load, spectrum, angle)
        truth[number] = angle, load, radius
    return frames + NOISE * random.normal(size=frames.shape), truth


def fit_share(work: tuple[int, int]) -> Floats:
    """Fit one process's share; one row a frame: truth's angle [rad], error [deg], doubted, error
    over theory of each.
    """
    count, seed = work
    finger = finger_of(16)
    frames, truth = frames_of(finger, count, seed)
    out = np.full((count, 6), np.nan)
    for number, shape in enumerate(Estimator(finger, compiled=None).batch(frames)):
        out[number, 0], out[number, 2] = truth[number, 0], shape.doubtful
        if shape.usable:
            fitted = np.array([shape.angle_rad, shape.load_n_per_m, shape.equivalent_radius_m])
            out[number, 1] = np.degrees(shape.angle_rad - truth[number, 0])
            if shape.width_rad > _WIDE and shape.equivalent_radius_m < 1.4 * finger.cylinder.outer_m:
                out[number, 3:] = (fitted - truth[number]) / np.array(shape.deviations)
    return out


def bench_tactile(options: Options, report: Report) -> None:
    """Time of a frame and what the estimates are worth."""
    count = options.count(300, 5000)
    _frames(report, finger_of(16), count)
    _many_elements(report, finger_of(48), count)
    _worth(report, finger_of(16), options.count(400, 10_000))
    bench_touches(options, report)


def _kinds() -> list[tuple[str, bool, float]]:
    return [("plain numpy", False, 700.0), ("compiled", True, 25.0)]


def _frames(report: Report, finger: Finger, count: int) -> None:
    frames, _ = frames_of(finger, min(count, 500), 1)
    load = Load(200.0, 50.0)
    for name, compiled, bar in _kinds():
        try:
            estimator = Estimator(finger, compiled=compiled)
        except ImportError as error:
            report.note(str(error))
            continue
        report.samples(f"fit of 16 strains, {name}", _times(estimator.frame, frames, count), bars=[Bar("p50", bar)])
        report.samples(
            f"the same with a load, {name}",
            _times(lambda y, fit=estimator.frame: fit(y, load), frames, count),  # type: ignore[misc]
        )
        sense = _sensing(finger, compiled, frames.shape[1])
        report.samples(f"raw frame to shape in the driver, {name}", _times(sense, frames, count))


def _many_elements(report: Report, finger: Finger, count: int) -> None:
    frames, _ = frames_of(finger, min(count, 500), 2)
    for name, compiled, _ in _kinds():
        try:
            estimator = Estimator(finger, compiled=compiled)
        except ImportError:
            continue
        share = _share(estimator.frame, frames, count)
        report.value(f"fit of 48 strains at 1 kHz, share of a core, {name}", share, "%", bars=[Bar("value", 100 / 3)])
        share = _share(_sensing(finger, compiled, frames.shape[1]), frames, count)
        report.value(f"48 raw to shape at 1 kHz, share of a core, {name}", share, "%", bars=[Bar("value", 100 / 3)])


def _share(work: Callable[[Floats], object], frames: Floats, count: int) -> float:
    """Return the processor time of frames at 1 kHz as per cent of a core."""
    _times(work, frames, 10)
    began = time.process_time()
    for number in range(count):
        work(frames[number % len(frames)])
    return (time.process_time() - began) / count * 1e3 * 100.0


def _sensing(finger: Finger, compiled: bool, elements: int) -> Callable[[Floats], object]:
    """Return what a driver does with the raw frame of some strains."""
    sensor, scale = ShapeSensor(finger, compiled=compiled), finger.signal.scale
    stamp = 0

    def sense(y: Floats) -> object:
        nonlocal stamp
        stamp += 1_000_000
        return sensor.frame(-y / scale, stamp)

    for _ in range(30):
        sense(np.zeros(elements))
    return sense


def _times(work: Callable[[Floats], object], frames: Floats, count: int) -> list[int]:
    for strains in frames[:50]:
        work(strains)
    times = []
    for number in range(count):
        strains = frames[number % len(frames)]
        begin = time.perf_counter_ns()
        work(strains)
        times.append(time.perf_counter_ns() - begin)
    return times


def _worth(report: Report, finger: Finger, count: int) -> None:
    """Fit frames on all cores, in shares, with progress."""
    cores = max(len(os.sched_getaffinity(0)), 1)
    rows: list[Floats] = []
    with ProcessPoolExecutor(cores) as pool:
        for part in pool.map(fit_share, [(count // SHARES, 1000 + n) for n in range(SHARES)]):
            rows.append(part)
            report.progress(f"convergence: {sum(map(len, rows))} of {count} frames on {cores} cores")
    found = np.concatenate(rows)
    angle, error, sure = np.degrees(found[:, 0]), np.abs(found[:, 1]), found[:, 2] == 0.0
    low, high = np.degrees([min(finger.angles_rad), max(finger.angles_rad)])
    half_pitch = 0.5 * (high - low) / (len(finger.angles_rad) - 1)
    inner = (angle > low + half_pitch) & (angle < high - half_pitch)
    report.value(f"worst place of {int(inner.sum())}, half a pitch inside the outer elements",
                 float(np.nanmax(error[inner])), "deg", bars=[Bar("value", 2.0)])  # fmt: skip
    report.value(f"worst place of {int(sure.sum())} without a flag, whole arc", float(np.nanmax(error[sure])), "deg",
                 bars=[Bar("value", 2.0)], notes=f"{100 * np.mean(~sure):.1f} % flagged")  # fmt: skip
    report.value(f"worst place of all {len(error)}", float(np.nanmax(error)), "deg", bars=[Bar("value", 2.0)])
    report.value("frames without an estimate", float(np.isnan(error).sum()), "", bars=[Bar("value", 0.0)])
    for column, what in ((3, "place"), (4, "load"), (5, "R")):
        # a robust width: R of small touches is far from normal
        width = float(np.subtract(*np.nanpercentile(found[:, column], [84.13, 15.87]))) / 2.0
        report.value(f"error over theory, {what}", width, "", bars=[Bar("value", 1.1), Bar("value", 0.9, True)])
