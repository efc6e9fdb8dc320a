"""Predict what a finger will be able to tell before it is moulded: resolution, conditioning, errors, classes of
indenters.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sioms.tactile.closedform import equivalent_radius
from sioms.tactile.contact import Contact, frictionless
from sioms.tactile.cylinder import Cylinder, respond
from sioms.tactile.emap import e_map, highest_needed
from sioms.tactile.estimator import Estimator
from sioms.tactile.finger import Finger
from sioms.tactile.indenter import FLAT, Wedge
from sioms.tactile.model import pressed
from sioms.tactile.series import spread
from sioms.tactile.width import WidthTable, rigid_core_table

Floats = NDArray[np.float64]

CUTOFF = 0.1  # -20 dB


def cutoff(cylinder: Cylinder, radius_m: float, level: float = CUTOFF, field: str = "e_rr", traction: int = 0) -> float:
    """Return the highest frequency [cycles/rad] at which the response is within `level` of its maximum (2.18).

    Args:
        cylinder: the finger.
        radius_m: where the strain is taken.
        level: ratio to the maximum.
        field: a field of `Response`.
        traction: 0 for p, 1 for q.
    """
    k = np.arange(0, 40 + int(40.0 * cylinder.outer_m / max(cylinder.outer_m - radius_m, 1e-9)))
    size = np.abs(getattr(respond(cylinder, k, radius_m), field)[:, 0, traction])
    loud = np.flatnonzero(size >= level * size.max())
    last = int(loud[-1])
    if last + 1 >= size.size:
        return float("inf")
    # between whole wave numbers by the logarithm of the response
    fall = np.log(size[last] / size[last + 1])
    return float((last + np.log(size[last] / (level * size.max())) / fall) / (2.0 * np.pi))


def spacing_needed(cylinder: Cylinder, radius_m: float) -> float:
    """Return the largest angle between elements [rad] that does not alias: half the cut-off's wavelength."""
    return 1.0 / (2.0 * cutoff(cylinder, radius_m))


def conditioning(cylinder: Cylinder, angles: Floats, radius_m: float, poisson: ArrayLike) -> Floats:
    """Return the condition number of E's pressure columns at each Poisson's ratio."""
    out = []
    for nu in np.atleast_1d(np.asarray(poisson, dtype=np.float64)):
        body = Cylinder(cylinder.core_m, cylinder.outer_m, float(nu), cylinder.shear_pa)
        highest = max(highest_needed(body, radius_m), 40)
        out.append(np.linalg.cond(e_map(body, angles, radius_m, highest)[:, : 2 * highest + 1]))
    return np.array(out)


@dataclass(frozen=True, slots=True, eq=False)
class Errors:
    """Hold standard deviations over loads and radii, shape (loads, radii): place [rad], load [N/m], R [m]."""

    angle: Floats
    load: Floats
    radius: Floats


def predicted_errors(finger: Finger, loads: ArrayLike, radii_m: ArrayLike, places: int = 5) -> Errors:
    """Return the theoretical deviations (figures 3.27 to 3.29), mean of variances over places about the middle of the
    arc.

    Args:
        finger: gives elements and noise.
        loads: P [N/m].
        radii_m: indenter radii rc [m].
        places: contact places spread over one pitch.
    """
    estimator, widths = Estimator(finger), finger.width_table()
    angles = np.sort(np.array(finger.angles_rad))
    middle = angles.size // 2
    spots = np.linspace(angles[middle - 1], angles[middle], places)
    highest = finger.highest()
    matrix, spectra = finger.e_map()[:, : 2 * highest + 1], pressed(finger.cylinder, highest)
    load, radius = np.atleast_1d(np.asarray(loads, float)), np.atleast_1d(np.asarray(radii_m, float))
    out = np.empty((3, load.size, radius.size))
    for row, p in enumerate(load):
        for column, rc in enumerate(radius):
            half = widths.half_width(float(p) * equivalent_radius(finger.cylinder, float(rc)))
            spectrum = spectra(half)
            frames = [estimator.frame(matrix @ spread(finger.cylinder, -float(p), spectrum, float(t))) for t in spots]
            good = np.array([f.deviations for f in frames if f.usable])
            out[:, row, column] = np.sqrt(np.mean(good**2, axis=0)) if good.size else np.nan
    return Errors(*out)


def exact_equivalent_wedge(
    cylinder: Cylinder, load: float, indenter_m: float, widths: WidthTable | None = None
) -> tuple[float, Contact, Contact]:
    """Return the half angle [rad] of the wedge with the width and load of a cylinder, and both contacts (2.59 to 2.72).

    Args:
        cylinder: the finger.
        load: P [N/m].
        indenter_m: rc [m].
        widths: the finger's table, to save time.
    """
    table = rigid_core_table(cylinder) if widths is None else widths
    radius = equivalent_radius(cylinder, indenter_m)
    half = table.half_width(load * radius)
    flat = frictionless(cylinder, FLAT, half)
    base = load / (flat.load * cylinder.outer_m / radius)
    unit = Wedge(np.pi / 4)
    edge_load = frictionless(cylinder, unit, half).load - flat.load
    # the wedge's own slope must carry what the finger's curvature leaves over
    cotangent = (load - flat.load) / edge_load
    half_angle = float(np.arctan2(1.0, cotangent))
    scaled = Contact(cylinder, half, load, 0.0, flat.normal * (cylinder.outer_m / radius) * base, 0.0, flat.adhering)
    return half_angle, scaled, frictionless(cylinder, Wedge(half_angle), half)


def class_difference(
    cylinder: Cylinder, radius_m: float, load: float, indenter_m: float, widths: WidthTable | None = None
) -> float:
    """Return the root mean square strain between a round indenter and its equivalent wedge over the peak strain (fig
    2.25).

    Taken over the part of the finger where the peak's hundredth is passed.
    """
    _, ball, wedge = exact_equivalent_wedge(cylinder, load, indenter_m, widths)
    highest = highest_needed(cylinder, radius_m, 1e-4)
    theta = np.linspace(-np.pi / 2, np.pi / 2, 721)
    matrix = e_map(cylinder, theta, radius_m, highest)
    one, two = matrix @ ball.series(0.0, highest), matrix @ wedge.series(0.0, highest)
    peak = np.abs(one).max()
    seen = np.abs(one) > 0.01 * peak
    return float(np.sqrt(np.mean((one - two)[seen] ** 2)) / peak)
