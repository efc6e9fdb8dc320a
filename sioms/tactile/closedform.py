"""Give the contacts that have a closed solution: Hertz, wedge and flat-ended punch on a half plane (appendix
C).

Half plane of shear modulus mu and Poisson's ratio nu, no friction, no core: the contact widths are wrong on a
finger with a rigid core (`sioms.tactile.contact` has the right ones); the spectra of the pressures are exact
for their width. Loads P [N/m] compression positive; widths theta_w [rad], half width a = theta_w/2; R the
equivalent radius [m], 1/R = 1/rb + 1/rc.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import itj0y0, j0, j1

from sioms.tactile.cylinder import Cylinder

Floats = NDArray[np.float64]


def equivalent_radius(cylinder: Cylinder, indenter_m: float) -> float:
    """Return R = rb rc/(rb + rc) [m] of an indenter of radius rc >= 0, infinite for a flat (2.28)."""
    if not indenter_m >= 0.0:
        raise ValueError(
            f"take equivalent radius: indenter radius is {indenter_m} m; need >= 0, infinite if flat"
        )
    return 1.0 / (1.0 / cylinder.outer_m + 1.0 / indenter_m) if indenter_m > 0.0 else 0.0


def indenter_radius(cylinder: Cylinder, equivalent_m: float) -> float:
    """Return rc [m] from R; infinite if R >= rb (flat, or hollow beyond what a cylinder can say)."""
    if equivalent_m >= cylinder.outer_m:
        return float("inf")
    return 1.0 / (1.0 / equivalent_m - 1.0 / cylinder.outer_m) if equivalent_m > 0.0 else 0.0


def hertz_width(cylinder: Cylinder, load: float, equivalent_m: float) -> float:
    """Return theta_w [rad] of a round indenter: (2/rb) sqrt(2 P (1 - nu) R/(pi mu))."""
    square = 2.0 * load * (1.0 - cylinder.poisson) * equivalent_m / (np.pi * cylinder.shear_pa)
    return float(2.0 / cylinder.outer_m * np.sqrt(square))


def hertz_product(cylinder: Cylinder, half_width: ArrayLike) -> Floats:
    """Return P R [N] of Hertz's contact with half width a [rad], the inverse of `hertz_width`."""
    a = np.asarray(half_width, dtype=np.float64) * cylinder.outer_m
    product: Floats = np.pi * cylinder.shear_pa * a**2 / (2.0 * (1.0 - cylinder.poisson))
    return product


def wedge_width(cylinder: Cylinder, load: float, half_angle: float) -> float:
    """Return theta_w [rad] of a wedge of half angle tp [rad]: P (1 - nu) tan(tp)/(mu rb)."""
    return float(
        load * (1.0 - cylinder.poisson) * np.tan(half_angle) / (cylinder.shear_pa * cylinder.outer_m)
    )


def equivalent_wedge(cylinder: Cylinder, load: float, equivalent_m: float) -> float:
    """Return the half angle [rad] of the wedge with the width of a cylinder, both in closed form (2.58)."""
    square = 8.0 * cylinder.shear_pa * equivalent_m / (np.pi * load * (1.0 - cylinder.poisson))
    return float(np.arctan(np.sqrt(square)))


def ellipse_spectrum(argument: ArrayLike) -> Floats:
    """Return 2 J1(ka)/(ka): the spectrum of an elliptic pressure, 1 at 0."""
    x = np.asarray(argument, dtype=np.float64)
    small = np.abs(x) < 1e-6
    safe = np.where(small, 1.0, x)
    ratio: Floats = np.where(small, 1.0 - x**2 / 8.0, 2.0 * j1(safe) / safe)
    return ratio


def wedge_spectrum(argument: ArrayLike) -> Floats:
    """Return (1/ka) int_0^ka J0: the spectrum of a wedge's pressure arccosh(a/|t|), 1 at 0."""
    x = np.asarray(argument, dtype=np.float64)
    small = np.abs(x) < 1e-6
    safe = np.where(small, 1.0, x)
    ratio: Floats = np.where(small, 1.0 - x**2 / 12.0, itj0y0(safe)[0] / safe)
    return ratio


def punch_spectrum(argument: ArrayLike) -> Floats:
    """Return J0(ka): the spectrum of a flat-ended punch's pressure 1/sqrt(a^2 - t^2), 1 at 0."""
    ratio: Floats = j0(np.asarray(argument, dtype=np.float64))
    return ratio
