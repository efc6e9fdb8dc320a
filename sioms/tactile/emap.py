"""Map the tractions on the finger to the strains at its elements: the E map (dissertation 2.20 to 2.25).

The map is linear: strain = E [p; q], with p and q in the layout of `sioms.tactile.series`, pressure columns
first.
Truncation: with nc wave numbers the peak strain of a line load misses about 0.2 % at nc = 40 for 10.3 of 12.7
mm; `highest_needed` gives nc for any depth.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sioms.tactile.cylinder import Cylinder, respond
from sioms.tactile.series import wave_numbers

Floats = NDArray[np.float64]

MOST_EXTENT = 0.2  # rad; half angle of an element's strip

_MOST = 2000


def e_map(
    cylinder: Cylinder, angles: ArrayLike, radii: ArrayLike, highest: int, poisson: ArrayLike | None = None,
    extent_rad: float = 0.0,
) -> Floats:  # fmt: skip
    """Return E, shape (ns, 4 nc + 2) [1/Pa].

    Args:
        cylinder: geometry and material.
        angles: element angles t_i [rad], shape (ns,).
        radii: effective element radii rs_i [m], shape (ns,) or scalar.
        highest: nc, the highest wave number kept.
        poisson: Poisson's ratio seen by each element, shape (ns,) or scalar; None takes the cylinder's.
        extent_rad: half angle over which an element averages.
    """
    theta = np.atleast_1d(np.asarray(angles, dtype=np.float64))
    radius = np.broadcast_to(np.asarray(radii, dtype=np.float64), theta.shape)
    given = np.asarray(cylinder.poisson if poisson is None else poisson, dtype=np.float64)
    ratio = np.broadcast_to(given, theta.shape)
    factors = strain_factors(cylinder, radius, ratio, highest) * felt(highest, extent_rad)[:, None]
    k = wave_numbers(highest)
    normal, shear = factors[:, k, 0], factors[:, k, 1]
    phase = theta[:, None] * k
    sine = np.arange(k.size) % 2 == 1
    pressure = normal * np.where(sine, np.sin(phase), np.cos(phase))
    tangential = shear * np.where(sine, -np.cos(phase), np.sin(phase))
    tangential[:, 0] = shear[:, 0]
    return np.concatenate([pressure, tangential], axis=1)


def felt(highest: int, extent_rad: float) -> Floats:
    """Return the share of each wave number that an element feels as it averages over an arc, shape (nc + 1,).

    A strip of copper is no line: over t - extent to t + extent cos kt has the mean cos kt times sin(k extent)/(k
        extent).
    """
    share: Floats = np.sinc(np.arange(highest + 1) * extent_rad / np.pi)
    return share


def strain_factors(cylinder: Cylinder, radii: Floats, poisson: Floats, highest: int) -> Floats:
    """Return e_rr per traction of each element and wave number, shape (ns, nc + 1, 2) [1/Pa]."""
    out = np.empty((radii.size, highest + 1, 2))
    for nu in np.unique(poisson):
        alike = poisson == nu
        body = Cylinder(cylinder.core_m, cylinder.outer_m, float(nu), cylinder.shear_pa)
        depths, place = np.unique(radii[alike], return_inverse=True)
        out[alike] = np.moveaxis(respond(body, np.arange(highest + 1), depths).e_rr, 1, 0)[place]
    return out


def highest_needed(cylinder: Cylinder, radius_m: float, share: float = 2e-3) -> int:
    """Return the smallest nc whose truncation misses less than `share` of a line load's peak strain at
    radius_m.

    Example:
        >>> from sioms.tactile.cylinder import FINGER_B
        >>> highest_needed(FINGER_B, 10.3e-3)
        40
    """
    factor = respond(cylinder, np.arange(_MOST), radius_m).e_rr[:, 0, 0]
    factor[0] *= 0.5
    missing = np.abs(factor[::-1].cumsum()[::-1]) / abs(factor.sum())
    late = np.nonzero(missing >= share)[0]
    return max(int(late[-1]), 1) if late.size else 1
