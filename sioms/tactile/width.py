"""Tabulate the width of a round contact: theta_w is a function of the product P R alone (dissertation 3.5.2).

For a fixed strip the bounded pressure is proportional to 1/R, hence P R depends on the half width only.  The
table keeps the ratio of P R to Hertz's value over a; it is even in a, starts at exactly 1, bends gently, and
17 points give 1e-5.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import CubicSpline

from sioms.tactile.closedform import hertz_product
from sioms.tactile.contact import frictionless
from sioms.tactile.cylinder import Cylinder
from sioms.tactile.indenter import FLAT

Floats = NDArray[np.float64]

POINTS = 17
_FINE = 101
WIDEST = 0.5  # half width [rad]: a flat under some 700 N/m on the fingers described here


@dataclass(frozen=True, slots=True, eq=False)
class WidthTable:
    """Hold the ratio h = P R / (P R of Hertz) over the half width a; immutable.  Asked by b = a^2, the search
    variable.

    Args:
        cylinder: the finger.
        half_widths: a [rad], rising from 0, shape (n,).
        ratio: h, shape (n,), 1 at a = 0; all ones give Hertz's model.
    """

    cylinder: Cylinder
    half_widths: Floats
    ratio: Floats
    _spline: CubicSpline = field(init=False, repr=False)
    _fine: list[tuple[float, float]] = field(init=False, repr=False)
    _step: float = field(init=False, repr=False)
    _unit: float = field(init=False, repr=False)

    def __post_init__(self) -> None:
        # mirrored about a = 0, because the ratio is even
        a, h = np.asarray(self.half_widths), np.asarray(self.ratio)
        spline = CubicSpline(np.concatenate([-a[:0:-1], a]), np.concatenate([h[:0:-1], h]))
        fine, step = np.linspace(0.0, a[-1], _FINE, retstep=True)
        object.__setattr__(self, "_spline", spline)
        object.__setattr__(
            self, "_fine", list(zip(spline(fine).tolist(), (step * spline(fine, 1)).tolist(), strict=True))
        )
        object.__setattr__(self, "_step", float(step))
        object.__setattr__(self, "_unit", float(hertz_product(self.cylinder, 1.0)))

    @property
    def is_hertz(self) -> bool:
        """Return whether this is Hertz's half plane."""
        return bool(np.all(self.ratio == 1.0))

    @property
    def largest(self) -> float:
        """Return the largest b [rad^2] of the table."""
        return float(self.half_widths[-1] ** 2)

    def product(self, square: ArrayLike) -> Floats:
        """Return P R [N] at b = a^2 [rad^2]."""
        b = np.asarray(square, dtype=np.float64)
        product: Floats = hertz_product(self.cylinder, np.sqrt(b)) * self._spline(np.sqrt(b))
        return product

    def slope(self, square: ArrayLike) -> Floats:
        """Return d(P R)/db [N/rad^2]."""
        a = np.sqrt(np.asarray(square, dtype=np.float64))
        # d(a^2 h)/d(a^2) = h + a h'/2
        slope: Floats = hertz_product(self.cylinder, 1.0) * (self._spline(a) + 0.5 * a * self._spline(a, 1))
        return slope

    def radius(self, load: float, square: float) -> tuple[float, float]:
        """Return R [m] and dR/db [m/rad^2] at a load [N/m] and b = a^2; scalar and fast, for every frame."""
        a = square**0.5
        place = min(int(a / self._step), len(self._fine) - 2)
        h0, d0 = self._fine[place]
        h1, d1 = self._fine[place + 1]
        s = a / self._step - place
        r = 1.0 - s
        h = (1.0 + 2.0 * s) * r * r * h0 + s * r * r * d0 + s * s * (3.0 - 2.0 * s) * h1 - s * s * r * d1
        slope = 6.0 * s * r * (h1 - h0) + r * (1.0 - 3.0 * s) * d0 + s * (3.0 * s - 2.0) * d1
        unit = self._unit / load
        return unit * square * h, unit * (h + 0.5 * a * slope / self._step)

    def half_width(self, product: float) -> float:
        """Return a [rad] at the product P R [N].

        Raises:
            ValueError: the product is negative or beyond the table.
        """
        top = float(self.product(self.largest))
        if not 0.0 <= product <= top:
            raise ValueError(f"look up contact width: P R is {product} N; the table covers 0 to {top:.4g} N")
        b = product / float(hertz_product(self.cylinder, 1.0))
        for _ in range(50):  # Newton; h is near one and monotone
            step = (float(self.product(b)) - product) / float(self.slope(b))
            b = min(max(b - step, 0.0), self.largest)
            if abs(step) < 1e-15 + 1e-13 * b:
                break
        return float(np.sqrt(b))


def rigid_core_table(cylinder: Cylinder, points: int = POINTS, widest: float = WIDEST) -> WidthTable:
    """Compute the table of the frictionless finger with its rigid core: the "approximate frictionless" model.

    Takes about half a second; a calibrated finger's file carries its result.
    """
    a = widest * np.arange(1, points) / (points - 1)
    load = np.array([frictionless(cylinder, FLAT, float(half), order=16).load for half in a])
    ratio = load * cylinder.outer_m / hertz_product(cylinder, a)
    return WidthTable(cylinder, np.concatenate([[0.0], a]), np.concatenate([[1.0], ratio]))


def hertz_table(cylinder: Cylinder, widest: float = WIDEST) -> WidthTable:
    """Return the table of Hertz's half plane, kept to show its bias (table 3.10)."""
    return WidthTable(cylinder, np.linspace(0.0, widest, 4), np.ones(4))
