"""Score calibration and estimation on folders of recordings: every fourth touch is kept from the calibration and
fitted.

One row for each finger.  A finger whose truth is known (``--truth FOLDER`` with NAME.json, as a generator of
such data writes it) also gets the errors of its parameters.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import sys
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sioms.tactile.calibration import Calibration, Options, calibrate
from sioms.tactile.closedform import equivalent_radius
from sioms.tactile.command.progress import Progress
from sioms.tactile.estimator import Estimator
from sioms.tactile.files import read_folder
from sioms.tactile.finger import Finger
from sioms.tactile.linearity import linearise
from sioms.tactile.touches import Touches, join, ramps_of

Floats = NDArray[np.float64]
KEPT = 4  # every fourth touch is kept from the calibration
LEAST_LOAD = 100.0  # N/m, of the touches that are scored: below, R is hardly told


@dataclass(frozen=True, slots=True)
class Score:
    """Hold what one finger reached; residuals in per cent of peak, deviations over the touches kept back.

    Args:
        name: of the finger.
        model, mapped: mean residual of elements on touches left out, by the model and by the identified map.
        place_deg, load, radius_mm: standard deviations of the errors of place, load [N/m] and R, all indenters;
            of the load against the load cell, scaled to the commanded level, where there is one.
        worst_deg: largest error of place less its mean.
        bias: mean errors of place [deg], load [N/m] and R [mm].
        flagged: share of the touches whose estimate carries a flag that doubts it.
        touches: number of touches scored.
        found: what was found, in words, beside the truth where that is known.
    """

    name: str
    model: float
    mapped: float
    place_deg: float
    load: float
    radius_mm: float
    worst_deg: float
    bias: tuple[float, float, float]
    flagged: float
    touches: int
    found: str


def score_folder(folder: Path, truth: Path | None, edge_half_angle: float) -> Score:
    """Calibrate on three quarters of the touches of a folder and fit the rest."""
    data = read_folder(folder)
    ramp = data.recordings.get("ramp")
    ramps = [] if ramp is None else ramps_of(ramp, data.nominal.signal.scale)
    touches = join(list(data.touches.values()))
    kept = np.arange(len(touches)) % KEPT == 1
    result = calibrate(data.nominal, touches.pick(~kept), Options(edge_half_angle), ramps=ramps)
    errors, flagged = fit_errors(result.finger, touches.pick(kept))
    if not np.isfinite(errors).any():
        raise ValueError(
            f"score {folder}: none of the {len(errors)} touches kept back could be fitted; see what calibrate says of "
            "it"
        )
    spread, mean = np.nanstd(errors, axis=0), np.nanmean(errors, axis=0)
    mapped = result.residuals.get("corrected", np.array([np.nan]))
    told = truth / f"{folder.name}.json" if truth is not None else None
    return Score(
        name=folder.name,
        model=100 * min(float(np.nanmean(result.residuals[name])) for name in ("uniform", "elements")),
        mapped=100 * float(np.nanmean(mapped)),
        place_deg=float(spread[0]), load=float(spread[1]), radius_mm=float(spread[2]),
        worst_deg=float(np.nanmax(np.abs(errors[:, 0] - mean[0]))),
        bias=(float(mean[0]), float(mean[1]), float(mean[2])),
        flagged=float(np.mean(flagged)),
        touches=len(errors),
        found=_found(result, json.loads(told.read_text()) if told is not None and told.exists() else None),
    )  # fmt: skip


def fit_errors(finger: Finger, touches: Touches) -> tuple[Floats, NDArray[np.bool_]]:
    """Fit touches over the elements; return errors of place [deg], load [N/m], R [mm], shape (n, 3), and who is
    doubted.
    """
    angles = np.array(finger.angles_rad)[np.array(finger.elements.used)]
    inside = (touches.angle_rad > angles.min()) & (touches.angle_rad < angles.max())
    touches = touches.pick(inside & (touches.load >= LEAST_LOAD))
    applied = touches.load
    if len(touches) and np.isfinite(touches.force).all() and np.all(touches.force > 0.0):
        applied = touches.force * float(np.median(touches.load / touches.force))
    strains = -np.array(finger.elements.gain) * linearise(touches.output, np.array(finger.elements.quadratic))
    estimator = Estimator(finger, compiled=None, averaged=max(touches.averaged, 1.0))
    errors, doubted = np.full((len(touches), 3), np.nan), np.zeros(len(touches), dtype=np.bool_)
    for number, shape in enumerate(estimator.batch(strains)):
        doubted[number] = shape.doubtful
        if shape.usable:
            errors[number] = (
                math.degrees(shape.angle_rad - touches.angle_rad[number]),
                shape.load_n_per_m - applied[number],
                1e3 * (shape.equivalent_radius_m
                       - equivalent_radius(finger.cylinder, float(touches.radius_m[number]))),
            )  # fmt: skip
    return errors, doubted


def _found(result: Calibration, truth: dict[str, Any] | None) -> str:
    finger, quadratic = result.finger, result.quadratic
    parts = [
        f"map {finger.notes['map']}",
        f"adhesion {finger.contact.adhesion:.2f}",
        f"nu {finger.geometry.poisson:.3f}",
    ]
    if quadratic is not None:
        parts.append(f"quadratic {float(np.mean(finger.elements.quadratic)) / 100:+.3f}/%")
    if finger.signal.proximity:
        parts.append(f"proximity {100 * finger.signal.proximity:+.1f} %")
    if truth is not None:
        own = truth["elements"]
        angle = np.degrees(finger.angles_rad) - own["theta_deg"]
        parts.append(f"angles {angle.mean():+.3f} +- {angle.std():.3f} deg")
        known = ", ".join(f"{name} {value:.3g}" for name, value in truth["parameters"].items())
        parts.append(f"truth: {known or 'no effect'}")
    return "; ".join(parts)


def score(args: argparse.Namespace) -> int:
    """Score the folders on all cores and print the table."""
    folders = [child for folder in args.data for child in ([folder] if _is_data(folder) else sorted(folder.iterdir()))]
    if not folders:
        raise ValueError(f"score fingers: {args.data[0]} is empty; give folders of recordings")
    if bad := [str(folder) for folder in folders if not _is_data(folder)]:
        raise ValueError(f"score fingers: {', '.join(bad)} holds no *.npz; give folders of recordings")
    if args.truth is not None and not args.truth.is_dir():
        raise ValueError(f"score fingers: {args.truth} is not a folder; want the one with NAME.json")
    progress = Progress(len(folders))
    work = [(folder, args.truth, math.radians(args.edge_deg)) for folder in folders]
    workers = min(args.jobs or len(os.sched_getaffinity(0)), len(work))
    print("| finger | model, % of peak | map, % of peak | place, deg | load, N/m | R, mm | worst place, deg "
          "| mean errors: deg, N/m, mm | flagged | found |")  # fmt: skip
    print("|" + " --- |" * 10)
    rows = []
    with ProcessPoolExecutor(workers) as pool:
        for row in pool.map(_score_one, work):
            rows.append(row)
            place, load, radius = row.bias
            print(
                f"| {row.name} | {row.model:.2f} | {row.mapped:.2f} | {row.place_deg:.3f} | {row.load:.1f} "
                f"| {row.radius_mm:.2f} | {row.worst_deg:.2f} | {place:+.3f}, {load:+.1f}, {radius:+.2f} "
                f"| {100 * row.flagged:.0f} % | {row.found} |",
                flush=True,
            )
            progress(row.name)
    progress.close()
    if len(rows) > 1:
        middle = [
            float(np.median([getattr(row, name) for row in rows]))
            for name in ("model", "mapped", "place_deg", "load", "radius_mm", "worst_deg")
        ]
        print("| median | {:.2f} | {:.2f} | {:.3f} | {:.1f} | {:.2f} | {:.2f} | | | |".format(*middle))
    return 0


def _is_data(folder: Path) -> bool:
    return folder.is_dir() and any(folder.glob("*.npz"))


def _score_one(work: tuple[Path, Path | None, float]) -> Score:
    try:
        return score_folder(*work)
    except ValueError as error:
        print(f"score {work[0]}: {error}", file=sys.stderr)
        nan = math.nan
        return Score(work[0].name, nan, nan, nan, nan, nan, nan, (nan, nan, nan), nan, 0, str(error))
