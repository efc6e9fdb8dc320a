"""Ask a calibration what it is worth: fingers made from halves of the touches estimate the other halves.

What their errors are above the deviations that the estimates state, by noise and residuals, is the finger's own:
strips, creep, a contact that no model describes, a map that learned its touches by heart. The finger's file carries it
(`Systematic`), so that stated deviations hold; a finger of which it is too large is not to be believed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sioms.tactile.closedform import equivalent_radius
from sioms.tactile.estimator import Estimator
from sioms.tactile.finger import Finger, Systematic
from sioms.tactile.linearity import linearise
from sioms.tactile.touches import Touches

Floats = NDArray[np.float64]

MOST = Systematic(place_rad=np.radians(0.3), load=0.05, radius=0.25)
"""What a sound finger's errors may be beside its noise."""
LEAST_LOAD = 100.0  # N/m, of the touches that are looked at
THINNEST_M = 1e-3  # rc of the indenters whose R is looked at: an edge has none
FEWEST = 15  # errors that tell anything
MOST_DOUBTFUL = 0.4
_COVERED = ((0.95, 2.0), (0.99, 3.0))  # shares of the errors within so many standard deviations
_TRIED = np.concatenate([[0.0], np.geomspace(1e-5, 10.0, 300)])


@dataclass(frozen=True, slots=True, eq=False)
class Estimates:
    """Hold what a finger estimates of known touches; immutable.

    Args:
        error: of place [rad], load and R, these two relative, shape (n, 3); nan where nothing was estimated, it is
            doubtful, or the touch has no R.
        stated: standard deviations of the estimates, likewise.
        doubtful: which estimates are doubtful, shape (n,).
        edge: which touches are of an edge, shape (n,).
    """

    error: Floats
    stated: Floats
    doubtful: NDArray[np.bool_]
    edge: NDArray[np.bool_]


def estimates(finger: Finger, touches: Touches, load: Floats) -> Estimates:
    """Let a finger estimate those touches that are heavy enough and lie between its outermost elements.

    Args:
        finger: calibrated from other touches.
        touches: with outputs as recorded.
        load: that is believed of them [N/m], shape (nt,).
    """
    angles = np.array(finger.angles_rad)[np.array(finger.elements.used)]
    inside = (touches.angle_rad > angles.min()) & (touches.angle_rad < angles.max())
    chosen = np.flatnonzero(inside & (load >= LEAST_LOAD))
    estimator = Estimator(finger, averaged=max(touches.averaged, 1.0))
    outputs = linearise(touches.output[chosen], np.array(finger.elements.quadratic))
    error, stated = np.full((chosen.size, 3), np.nan), np.full((chosen.size, 3), np.nan)
    doubtful = np.zeros(chosen.size, dtype=np.bool_)
    shapes = estimator.batch(-np.array(finger.elements.gain) * outputs)
    for row, (touch, shape) in enumerate(zip(chosen, shapes, strict=True)):
        doubtful[row] = shape.doubtful
        if shape.doubtful:
            continue
        rc = float(touches.radius_m[touch])
        radius = equivalent_radius(finger.cylinder, rc) if rc > THINNEST_M else np.nan
        unit = np.array([1.0, load[touch], radius])
        found = np.array([shape.angle_rad, shape.load_n_per_m, shape.equivalent_radius_m])
        error[row] = (found - np.array([touches.angle_rad[touch], load[touch], radius])) / unit
        stated[row] = np.array(shape.deviations) / unit
    return Estimates(error, stated, doubtful, touches.radius_m[chosen] <= THINNEST_M)


def joined(parts: list[Estimates]) -> Estimates:
    """Return the estimates of several fingers together."""
    return Estimates(
        np.concatenate([part.error for part in parts]),
        np.concatenate([part.stated for part in parts]),
        np.concatenate([part.doubtful for part in parts]),
        np.concatenate([part.edge for part in parts]),
    )


def systematic(found: Estimates) -> Systematic:
    """Return the least deviations beside the stated ones with which these cover the errors: 95 % within two, 99 %
    within three.

    For edges and for the others alike: many of the one kind must not hide what the finger does to the other. Zero where
    there are too few errors to tell.
    """
    kinds = (found.edge, ~found.edge)
    return Systematic(*(max(_beside(found.error[kind, n], found.stated[kind, n]) for kind in kinds) for n in range(3)))


def _beside(error: Floats, stated: Floats) -> float:
    known = np.isfinite(error) & np.isfinite(stated)
    if np.count_nonzero(known) < FEWEST:
        return 0.0
    z = np.abs(error[known])[:, None] / np.sqrt(stated[known, None] ** 2 + _TRIED**2 + 1e-30)
    enough = np.all([np.quantile(z, share, axis=0) <= most for share, most in _COVERED], axis=0)
    return float(_TRIED[enough.argmax()]) if enough.any() else float(_TRIED[-1])


def doubts(found: Estimates, beside: Systematic) -> list[str]:
    """Return why a finger is not to be believed whose halves do not find each other's touches."""
    out = []
    share = float(found.doubtful.mean()) if found.doubtful.size else 0.0
    if share > MOST_DOUBTFUL:
        out.append(
            f"{100.0 * share:.0f} % of the touches left out of it are doubtful when it estimates them; of a sound "
            f"finger less than {100.0 * MOST_DOUBTFUL:.0f} % are"
        )
    for what, unit, factor, one, most in (
        ("places", "degrees", 180.0 / np.pi, beside.place_rad, MOST.place_rad),
        ("loads", "%", 100.0, beside.load, MOST.load),
        ("R", "%", 100.0, beside.radius, MOST.radius),
    ):
        if one > most:
            out.append(
                f"it tells the {what} of touches left out of it no better than to {factor * one:.2g} {unit} beside the "
                f"noise (one standard deviation); of a sound finger want less than {factor * most:.2g} {unit}"
            )
    return out
