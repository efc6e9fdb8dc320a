"""Give the contacts that have a closed solution: Hertz, wedge, rounded wedge and flat-ended punch on a half plane
(appendix C).

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
        raise ValueError(f"take equivalent radius: indenter radius is {indenter_m} m; need >= 0, infinite if flat")
    return 1.0 / (1.0 / cylinder.outer_m + 1.0 / indenter_m) if indenter_m > 0.0 else 0.0


def indenter_radius(cylinder: Cylinder, equivalent_m: float) -> float:
    """Return rc [m] from R; infinite if R >= rb (flat, or hollow beyond what a cylinder can say)."""
    if equivalent_m >= cylinder.outer_m:
        return float("inf")
    return 1.0 / (1.0 / equivalent_m - 1.0 / cylinder.outer_m) if equivalent_m > 0.0 else 0.0


def _check_press(what: str, load: float, equivalent_m: float = 0.0) -> None:
    if not 0.0 <= load < np.inf:
        raise ValueError(f"{what}: load is {load} N/m; need 0 or a pressing one, which is positive")
    if not 0.0 <= equivalent_m < np.inf:
        raise ValueError(f"{what}: equivalent radius is {equivalent_m} m; need 0 or more, finite")


def hertz_width(cylinder: Cylinder, load: float, equivalent_m: float) -> float:
    """Return theta_w [rad] of a round indenter: (2/rb) sqrt(2 P (1 - nu) R/(pi mu)).

    Raises:
        ValueError: a load or an R that is negative or no number.
    """
    _check_press("take Hertz width", load, equivalent_m)
    square = 2.0 * load * (1.0 - cylinder.poisson) * equivalent_m / (np.pi * cylinder.shear_pa)
    return float(2.0 / cylinder.outer_m * np.sqrt(square))


def hertz_product(cylinder: Cylinder, half_width: ArrayLike) -> Floats:
    """Return P R [N] of Hertz's contact with half width a [rad], the inverse of `hertz_width`."""
    a = np.asarray(half_width, dtype=np.float64) * cylinder.outer_m
    product: Floats = np.pi * cylinder.shear_pa * a**2 / (2.0 * (1.0 - cylinder.poisson))
    return product


def wedge_width(cylinder: Cylinder, load: float, half_angle: float) -> float:
    """Return theta_w [rad] of a wedge of half angle tp [rad]: P (1 - nu) tan(tp)/(mu rb).

    Raises:
        ValueError: a load that is negative or no number, or a half angle not between 0 and pi/2.
    """
    _check_press("take wedge width", load)
    if not 0.0 < half_angle < 0.5 * np.pi:
        raise ValueError(
            f"compute wedge width: half angle is {half_angle} rad; want between 0 and pi/2, measured from its axis"
        )
    return float(load * (1.0 - cylinder.poisson) * np.tan(half_angle) / (cylinder.shear_pa * cylinder.outer_m))


def rounded_wedge_load(cylinder: Cylinder, half_width: float, half_angle: float, radius_m: float) -> float:
    """Return P [N/m] of a wedge whose edge is rounded with radius rc, at the half width a [rad].

    The half plane's load is E* times the integral of x h'(x)/sqrt(a^2 - x^2) over 0 to a, E* = 2 mu/(1 - nu), with the
    slope h' = x/rc up to b = rc cot(tp) and cot(tp) beyond. The finger is taken for flat as for the wedge; answers add,
    so that Hertz's load of R = rb is its own curvature's share.

    Args:
        cylinder: the finger.
        half_width: a [rad], > 0.
        half_angle: tp [rad] of the wedge, 0 to pi/2.
        radius_m: rc [m], > 0.
    """
    a, b = half_width * cylinder.outer_m, _rounded_to(cylinder, half_width, half_angle, radius_m)
    own = a**2 * np.arcsin(b / a) + b * np.sqrt(a**2 - b**2)
    return float(cylinder.shear_pa / (1.0 - cylinder.poisson) / radius_m * own)


def rounded_wedge_pressure(
    cylinder: Cylinder, half_width: float, half_angle: float, radius_m: float, t: ArrayLike
) -> Floats:
    """Return the pressure [Pa], compression positive, at angles t [rad] from the apex; arguments as
    `rounded_wedge_load`.

    The sum of arccosh(a/|x - s|)-like pressures of kinks spread evenly over the round edge, |s| < b.
    """
    a, b = half_width * cylinder.outer_m, _rounded_to(cylinder, half_width, half_angle, radius_m)
    x = np.clip(np.asarray(t, dtype=np.float64) * cylinder.outer_m, -a, a)
    arc = np.sqrt(a**2 - x**2)

    def kink(s: float) -> Floats:
        """(s - x) ln |(a^2 - x s + sqrt((a^2 - x^2)(a^2 - s^2)))/(a (x - s))|, which is 0 at x = s."""
        away = np.where(x == s, 1.0, np.abs(x - s))
        inside: Floats = (s - x) * np.log((a**2 - x * s + arc * np.sqrt(a**2 - s**2)) / (a * away))
        return inside

    scale = cylinder.shear_pa / (1.0 - cylinder.poisson) / (np.pi * radius_m)
    pressure: Floats = scale * (2.0 * np.arcsin(b / a) * arc + kink(b) - kink(-b))
    return pressure


def _rounded_to(cylinder: Cylinder, half_width: float, half_angle: float, radius_m: float) -> float:
    """Return how far from the apex [m] the slope is the round one's, at most the half width."""
    if not (half_width > 0.0 and 0.0 < half_angle < 0.5 * np.pi and radius_m > 0.0):
        raise ValueError(
            f"press rounded wedge: half width {half_width} rad, half angle {half_angle} rad, radius {radius_m} m; "
            "need all above 0, the angle below pi/2"
        )
    return min(radius_m / float(np.tan(half_angle)), half_width * cylinder.outer_m)


def equivalent_wedge(cylinder: Cylinder, load: float, equivalent_m: float) -> float:
    """Return the half angle [rad] of the wedge with the width of a cylinder, both in closed form (2.58).

    Raises:
        ValueError: a load that is not positive, or an R that is negative or no number.
    """
    _check_press("take equivalent wedge", load, equivalent_m)
    if load == 0.0:
        raise ValueError("take equivalent wedge: load is 0 N/m; need a positive (pressing) load")
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
