"""Describe indenters by the slope that they impose on the surface in contact (dissertation 2.27).

Inside the contact strip du_r/dt = rb t + rb h'(rb t), t [rad] from the indenter's apex: the first term
flattens the finger, h(x) [m] is the indenter's own height over the tangent x [m].  Small angles: the arc is
replaced by its parabola, which is the definition of the model, and needs a half width well below rc.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from sioms.tactile.cylinder import Cylinder

Floats = NDArray[np.float64]


class Indenter(Protocol):
    """Give the surface slope under an indenter; implementations are immutable."""

    def slope(self, cylinder: Cylinder, t: Floats) -> Floats:
        """Return du_r/dt [m/rad] at angles t [rad] from the apex."""
        ...


@dataclass(frozen=True, slots=True)
class Round:
    """A cylinder of radius rc [m] > 0; infinite for a flat."""

    radius_m: float

    def __post_init__(self) -> None:
        if not self.radius_m > 0.0:
            raise ValueError(
                f"describe round indenter: radius_m is {self.radius_m} m; need > 0, infinite for a flat, Wedge for an "
                "edge"
            )

    def slope(self, cylinder: Cylinder, t: Floats) -> Floats:
        """Return (rb^2/R) t."""
        return (cylinder.outer_m + cylinder.outer_m**2 / self.radius_m) * t


FLAT = Round(float("inf"))


@dataclass(frozen=True, slots=True)
class Wedge:
    """A wedge of half angle tp [rad], 0 < tp < pi/2, measured from its axis; its edge may be rounded with
    radius rc [m]."""

    half_angle: float
    radius_m: float = 0.0

    def __post_init__(self) -> None:
        if not 0.0 < self.half_angle < 0.5 * np.pi:
            raise ValueError(
                f"describe wedge: half_angle is {self.half_angle} rad; need between 0 and pi/2, measured from its axis"
            )
        if not 0.0 <= self.radius_m < np.inf:
            raise ValueError(
                f"describe wedge: radius_m of its edge is {self.radius_m} m; need 0 (sharp) or more, finite"
            )

    def slope(self, cylinder: Cylinder, t: Floats) -> Floats:
        """Return the round slope up to |t| = rc/(rb tan tp) and the constant one beyond."""
        rb, steep = cylinder.outer_m, 1.0 / np.tan(self.half_angle)
        round_ = self.radius_m > 0.0
        own = np.clip(rb * t / self.radius_m, -steep, steep) if round_ else steep * np.sign(t)
        total: Floats = rb * t + rb * own
        return total


@dataclass(frozen=True, slots=True, eq=False)
class Sampled:
    """Any profile given by points: x [m] strictly rising along the tangent, height h [m] away from the
    finger.

    Linear between the points; beyond the ends the last inclination goes on.
    """

    x_m: Floats
    height_m: Floats

    def __post_init__(self) -> None:
        x, h = np.asarray(self.x_m, dtype=np.float64), np.asarray(self.height_m, dtype=np.float64)
        if x.ndim != 1 or x.shape != h.shape or x.size < 3:
            raise ValueError(f"describe profile: shapes {x.shape}, {h.shape}; need two equal rows of 3 points or more")
        if not (np.all(np.diff(x) > 0.0) and np.all(np.isfinite(h))):
            raise ValueError("describe profile: points are not finite and strictly rising in x; sort them")

    def slope(self, cylinder: Cylinder, t: Floats) -> Floats:
        """Return rb t + rb h'(rb t), h' interpolated between the midpoints."""
        x, h = np.asarray(self.x_m, dtype=np.float64), np.asarray(self.height_m, dtype=np.float64)
        middle, incline = 0.5 * (x[1:] + x[:-1]), np.diff(h) / np.diff(x)
        rb = cylinder.outer_m
        total: Floats = rb * t + rb * np.interp(rb * t, middle, incline)
        return total
