"""Tabulate what the elements of a finger feel under a round contact: strain per unit load over place and width.

For a contact at angle t with half width a = sqrt(b) the strain of element i is P f_i(t, b), linear in the
load P.  f is summed once from the E map and the spectrum of the contact's tractions, then kept on a grid with
its derivatives; in between it is interpolated by bicubic Hermite polynomials (error under 1e-4 of the peak at
the default steps, far below any noise).  One look-up costs the same for 40 or 400 wave numbers.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.special import jv

from sioms.tactile.closedform import ellipse_spectrum
from sioms.tactile.contact import adhere, frictionless
from sioms.tactile.cylinder import Cylinder
from sioms.tactile.indenter import FLAT
from sioms.tactile.width import WIDEST

Floats = NDArray[np.float64]

ANGLE_STEP = np.radians(1.0)
WIDTH_STEP = 0.0125  # rad of half width
_SOLVED, _ORDER = 32, 16  # contacts solved for the spectra, and their Chebyshev terms
MARGIN = np.radians(20.0)  # beyond the outermost elements


@dataclass(frozen=True, slots=True, eq=False)
class Spectra:
    """Hold the tractions of round contacts per unit load over the half width; immutable.

    Args:
        half_widths: a [rad], rising in equal steps from 0, shape (nb,).
        normal: ratio of each pressure coefficient to that of a line load, shape (nb, nc + 1).
        normal_slope: its derivative by b = a^2, shape (nb, nc + 1).
        shear: sine coefficients of q about the middle, same unit, shape (nb, nc + 1); zero without adhesion.
        shear_slope: its derivative by b.
    """

    half_widths: Floats
    normal: Floats
    normal_slope: Floats
    shear: Floats
    shear_slope: Floats


def elliptic(highest: int, widest: float = WIDEST, step: float = WIDTH_STEP) -> Spectra:
    """Return the spectra of elliptic pressures: Hertz, and the approximate frictionless model of the dissertation."""
    a = step * np.arange(round(widest / step) + 1, dtype=np.float64)
    k = np.arange(highest + 1, dtype=np.float64)
    z = a[:, None] * k
    safe = np.where(z < 1e-4, 1.0, z)
    slope = -(k**2) * np.where(z < 1e-4, 0.125, jv(2, safe) / safe**2)  # d/db of 2 J1(ka)/(ka)
    return Spectra(a, ellipse_spectrum(z), slope, np.zeros_like(z), np.zeros_like(z))


def bounded(cylinder: Cylinder, highest: int, widest: float = WIDEST, step: float = WIDTH_STEP) -> Spectra:
    """Return the spectra of the exact frictionless pressures on the layer with its rigid core.

    Wide contacts press fuller than an ellipse: with it R of a flat under 400 N/m comes out 11.8 instead of 12.7 mm.
    """
    a, spline = step * np.arange(round(widest / step) + 1, dtype=np.float64), pressed(cylinder, highest)
    slope = np.empty((a.size, highest + 1))
    slope[1:] = spline(a[1:], 1) / (2.0 * a[1:, None])
    slope[0] = 0.5 * spline(0.0, 2)  # the spectrum is even in a
    none = np.zeros_like(slope)
    return Spectra(a, spline(a), slope, none, none)


def adhering(cylinder: Cylinder, share: float, base: Spectra) -> Spectra:
    """Return pressures with `share` (0 to 1) of the tangential traction of full adhesion.

    A real contact slips at its rim and sticks inside; the share is fitted, not predicted.
    """
    a, spline = base.half_widths, stuck(cylinder, base.normal.shape[1] - 1)
    slope = np.zeros_like(base.shear)
    slope[1:] = share * spline(a[1:], 1) / (2.0 * a[1:, None])
    slope[0] = slope[1]
    return Spectra(a, base.normal, base.normal_slope, share * spline(a), slope)


@lru_cache(maxsize=8)
def pressed(cylinder: Cylinder, highest: int) -> CubicSpline:
    """Return the pressure's spectrum over the half width [rad], each coefficient in units of a line load's.

    The pressure of a strip is proportional to 1/R: one table serves all radii. Takes half a second.
    """
    a = WIDEST * np.arange(1, _SOLVED + 1) / _SOLVED
    rows = np.ones((_SOLVED + 1, highest + 1))
    for row, half in zip(rows[1:], a, strict=True):
        solved = frictionless(cylinder, FLAT, float(half), order=_ORDER)
        row[:] = -solved.series(0.0, highest)[: 2 * highest + 1 : 2] * np.pi * cylinder.outer_m / solved.load
        row[0] *= 2.0
    return CubicSpline(np.concatenate([-a[::-1], [0.0], a]), np.concatenate([rows[:0:-1], rows]))


@lru_cache(maxsize=8)
def stuck(cylinder: Cylinder, highest: int) -> CubicSpline:
    """Return q's sine coefficients under full adhesion over the half width [rad], in units of a line load's pressure.

    Up to the widest contact; takes some seconds.
    """
    nodes = WIDEST * np.arange(9) / 8
    rows = np.zeros((nodes.size, highest + 1))
    for row, a in zip(rows[1:], nodes[1:], strict=True):
        solved = adhere(cylinder, FLAT, float(a))
        row[1:] = solved.series(0.0, highest)[2 * highest + 2 :: 2] * np.pi * cylinder.outer_m / solved.load
    return CubicSpline(nodes, rows)


@dataclass(frozen=True, slots=True, eq=False)
class StrainTable:
    """Hold f on the grid; immutable, safe to share.

    Args:
        first: angle of the first column [rad].
        step: angle step [rad].
        half_widths: a of the rows [rad], equal steps from 0, shape (nb,).
        nodes: f, step df/dt, df/db, step d2f/dtdb [m/N], shape (nb, nt, 4, ns).
    """

    first: float
    step: float
    half_widths: Floats
    nodes: Floats

    @property
    def last(self) -> float:
        """Return the angle of the last column [rad]."""
        return self.first + self.step * float(self.nodes.shape[1] - 1)

    def in_single_precision(self) -> StrainTable:
        """Return the table rounded to 6e-8 of each number: half the memory, which is the largest of a live finger."""
        return replace(self, nodes=self.nodes.astype(np.float32))

    def at(self, angle: float, square: float) -> Floats:
        """Return f, df/dt and df/db at a place [rad] and b = a^2 [rad^2], shape (3, ns); linear between the nodes'
        slopes.
        """
        rows, columns = self.nodes.shape[:2]
        x = min(max((angle - self.first) / self.step, 0.0), columns - 1.001)
        column, own = int(x), float(self.half_widths[1]) ** 2
        row = min(int(max(square, 0.0) ** 0.5 / float(self.half_widths[1])), rows - 2)
        low, high = row * row * own, (row + 1) ** 2 * own
        s, u = x - column, min(max((square - low) / (high - low), 0.0), 1.0)
        block, span = self.nodes[row : row + 2, column : column + 2], high - low
        along = _hermite(block[:, 0, ::2], block[:, 1, ::2], block[:, 0, 1::2], block[:, 1, 1::2], s)
        value = _hermite(along[0, 0], along[1, 0], span * along[0, 1], span * along[1, 1], u)
        turned = (1.0 - s) * block[:, 0, 1] + s * block[:, 1, 1]
        widened = (1.0 - s) * block[:, 0, 2] + s * block[:, 1, 2]
        return np.stack([
            value, ((1.0 - u) * turned[0] + u * turned[1]) / self.step, (1.0 - u) * widened[0] + u * widened[1]
        ])  # fmt: skip


def strain_table(outer_m: float, angles: Floats, normal: Floats, shear: Floats, spectra: Spectra) -> StrainTable:
    """Sum the strains of a finger on the grid.

    Args:
        outer_m: rb [m].
        angles: element angles [rad], shape (ns,); they give the arc.
        normal: pressure columns of E [1/Pa], shape (ns, 2 nc + 1).
        shear: tangential columns of E, same shape.
        spectra: tractions, for the same nc.
    """
    highest = normal.shape[1] // 2
    lowest, top = float(angles.min()) - MARGIN, float(angles.max()) + MARGIN
    count = int(np.ceil((top - lowest) / ANGLE_STEP)) + 1
    t = lowest + ANGLE_STEP * np.arange(count)
    pressed = _carry(normal, t, highest, odd=False)
    dragged = _carry(shear, t, highest, odd=True) if spectra.shear.any() else None
    scale = -1.0 / (np.pi * outer_m)  # a unit load presses: p < 0
    weight = np.where(np.arange(highest + 1) == 0, 0.5, 1.0)
    nodes = np.empty((spectra.half_widths.size, count, 4, angles.size))
    for row in range(spectra.half_widths.size):
        for place, spectrum in ((0, spectra.normal[row]), (2, spectra.normal_slope[row])):
            nodes[row, :, place : place + 2] = _sum(pressed, spectrum * weight * scale)
        if dragged is not None:
            for place, spectrum in ((0, spectra.shear[row]), (2, spectra.shear_slope[row])):
                nodes[row, :, place : place + 2] += _sum(dragged, spectrum * -scale)
    return StrainTable(lowest, ANGLE_STEP, spectra.half_widths, nodes)


def _hermite(low: Floats, high: Floats, low_slope: Floats, high_slope: Floats, s: float) -> Floats:
    """Return the cubic between two nodes at s, 0 to 1; the slopes per step."""
    r = 1.0 - s
    return np.asarray(
        (1.0 + 2.0 * s) * r * r * low + s * s * (3.0 - 2.0 * s) * high + s * r * r * low_slope - s * s * r * high_slope
    )


def _carry(columns: Floats, t: Floats, highest: int, odd: bool) -> Floats:
    """Return what each wave number of a traction about t gives: value and step d/dt, shape (2, nc + 1, nt, ns)."""
    k = np.arange(highest + 1, dtype=np.float64)
    sine, cosine = np.zeros((highest + 1, columns.shape[0])), np.empty((highest + 1, columns.shape[0]))
    sine[1:], cosine[:] = columns[:, 1::2].T, columns[:, ::2].T
    phase = k[:, None] * t
    c, s = np.cos(phase)[:, :, None], np.sin(phase)[:, :, None]
    # even: cos k(u - t) = c cos ku + s sin ku; odd: sin k(u - t) = c sin ku - s cos ku
    if odd:
        value = c * sine[:, None] - s * cosine[:, None]
        turn = -s * sine[:, None] - c * cosine[:, None]
    else:
        value = c * cosine[:, None] + s * sine[:, None]
        turn = -s * cosine[:, None] + c * sine[:, None]
    return np.stack([value, ANGLE_STEP * k[:, None, None] * turn])


def _sum(carried: Floats, spectrum: Floats) -> Floats:
    """Return value and derivative summed over wave numbers, shape (nt, 2, ns)."""
    total: Floats = np.moveaxis(np.tensordot(spectrum, carried, axes=(0, 1)), 0, 1)
    return total
