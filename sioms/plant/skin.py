"""What a finger's rubber does at a contact, in tables that a world can look up in every step.

The normal law is that of the elastic layer (`rubber`), not a spring: for a round contact of relative radius R the line
load P and the approach delta obey one curve, P R = F(delta R), because the pressure that closes a parabolic gap is
proportional to 1/R.  Against exact circles the curve holds to 1 % for objects of the finger's radius or more, to 2 % at
3 mm and 200 N/m.  A contact that is not round (a corner, a side that ends) counts as the round one with the same
overlapping area over the same chord: so forces go smoothly from a side to a corner, over the width of the contact.

Friction: table 4.2 of the source, by the contact's relative radius, interpolated in 1/R; it did not depend on load.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator

from sioms.plant.rubber import Layer, rubber

Array = NDArray[np.float64]

FRICTION = ((0.0, 3.4), (1 / 12.7e-3, 2.0), (1 / 2.5e-3, 2.0), (1 / 0.3e-3, 1.4))
"""1/R [1/m] and coefficient of HSII rubber: table 4.2."""

_LOADS = np.geomspace(2e-3, 3000.0, 72)
_POINTS = 1024


@dataclass(frozen=True, slots=True, eq=False)
class Skin:
    """Tables of one layer over s = sqrt(delta R) [m], evenly spaced from 0; immutable.

    Args:
        outer_m: rb.
        step: of s [m].
        product: P R [N].
        half_width: of the contact [m].
        shear: tangential stiffness per length [N/m^2].
        energy: integral of P R over delta R [N m^2].
    """

    outer_m: float
    step: float
    product: list[float]
    half_width: list[float]
    shear: list[float]
    energy: list[float]

    def press(self, depth_m: float, radius_m: float) -> tuple[float, float, float]:
        """Return line load P [N/m], half width [m] and tangential stiffness per length [N/m^2].

        Args:
            depth_m: approach delta, >= 0.
            radius_m: relative radius R, > 0; 1/R = 1/rb + 1/rc.
        """
        place = math.sqrt(depth_m * radius_m) / self.step
        row = int(place)
        last = len(self.product) - 2
        if row > last:
            row = last  # beyond the table it goes on straight
        share = place - row
        product, width, shear = self.product, self.half_width, self.shear
        return (
            (product[row] + share * (product[row + 1] - product[row])) / radius_m,
            width[row] + share * (width[row + 1] - width[row]),
            shear[row] + share * (shear[row + 1] - shear[row]),
        )

    def stored(self, depth_m: float, radius_m: float) -> float:
        """Return the energy per length [N] of a contact; as `press`."""
        place = np.sqrt(depth_m * radius_m) / self.step
        return float(np.interp(place, np.arange(len(self.energy)), self.energy)) / radius_m**2


def friction(radius_m: float) -> float:
    """Return the coefficient of friction at a relative radius R [m] > 0, by table 4.2 over 1/R."""
    bend = 1.0 / radius_m
    for (low, before), (high, after) in pairwise(FRICTION):
        if bend <= high:
            return before + (after - before) * (bend - low) / (high - low)
    return FRICTION[-1][1]


@lru_cache(maxsize=4)
def skin(layer: Layer = Layer(), depth_m: float = 2.4e-3) -> Skin:  # noqa: B008 (frozen)
    """Tabulate a layer, in about a second.

    Args:
        layer: the body.
        depth_m: of the elements; decides nothing here, but shares the body with a finger's strain tables.
    """
    body = rubber(layer, (layer.outer_m - depth_m,))
    approach, half, points = [], [], 3
    for load in _LOADS:
        pressed = body.press(float(load), math.inf, guess=points)
        approach.append(pressed.approach)
        half.append(pressed.half_width)
        points = round(pressed.half_width * 326) + 3
    rb = layer.outer_m
    place = np.sqrt(np.array(approach) * rb)
    # the width comes in steps of the surface's points: a smooth curve through it
    logs, first = np.log(_LOADS), 24
    smooth = np.polynomial.Polynomial.fit(logs[first:], np.log(half[first:]), 4)
    width = np.exp(smooth(np.maximum(logs, logs[first])) + 0.5 * np.minimum(logs - logs[first], 0.0))  # Hertz below
    s = np.linspace(0.0, place[-1], _POINTS)
    load_at = PchipInterpolator(np.concatenate([[0.0], place]), np.concatenate([[0.0], _LOADS]))
    width_at = PchipInterpolator(np.concatenate([[0.0], place]), np.concatenate([[0.0], width]))
    widths = np.linspace(0.0, 1.0, 40)[1:] ** 2 * width[-1]
    stiff = np.array([body.shear_stiffness(max(float(a), 4e-3)) for a in widths])
    product = load_at(s) * rb
    energy = np.concatenate([[0.0], np.cumsum(0.5 * (product[1:] + product[:-1]) * np.diff(s * s))])
    return Skin(
        rb,
        float(s[1]),
        product.tolist(),
        (width_at(s) * rb).tolist(),
        np.interp(width_at(s), widths, stiff).tolist(),
        energy.tolist(),
    )
