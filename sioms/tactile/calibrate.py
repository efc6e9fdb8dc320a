"""Fit the elements of a finger to recorded touches: place, effective depth, Poisson's ratio and gain (dissertation
3.4).

For each element over the touches within 25 degrees: minimise the squares of the residual in OUTPUT units, the
gain by linear least squares inside.  (In strain units with a free gain the objective falls when all strains
shrink: the fit then runs to the core.)  Residuals are reported in per cent of the peak model strain of a 200
    N/m edge.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from sioms.tactile.cylinder import Cylinder, respond
from sioms.tactile.emap import MOST_EXTENT, felt
from sioms.tactile.touches import Touches, TouchLoads

Floats = NDArray[np.float64]

NEAR = np.radians(25.0)
FEWEST = 12  # touches near an element for four parameters
REFERENCE_LOAD = 200.0  # N/m, of the edge whose peak strain is the unit of residuals
_SILENT = 0.05  # of what the others answer: an element that answers less is dead
TURN = 0.15  # rad, how far an element may lie from its nominal place
SMALLEST, LARGEST = 0.35, 0.5  # Poisson's ratio
SHALLOW, DEEP = 0.02, 0.9  # of the layer, between which an element's effective radius lies


@dataclass(frozen=True, slots=True)
class ElementFit:
    """Hold one element's parameters; immutable.

    Args:
        angle_rad: place.
        radius_m: effective radius.
        poisson: nu.
        gain: strain per output.
        residual: root mean square in output units.
        near: number of touches used.
        extent_rad: half angle over which it averages.
    """

    angle_rad: float
    radius_m: float
    poisson: float
    gain: float
    residual: float
    near: int
    extent_rad: float = 0.0


@lru_cache(maxsize=20000)
def _factors(cylinder: Cylinder, poisson: float, radius: float, highest: int) -> Floats:
    body = Cylinder(cylinder.core_m, cylinder.outer_m, poisson, cylinder.shear_pa)
    return respond(body, np.arange(highest + 1), radius).e_rr[:, 0, :]


def strain_of(
    cylinder: Cylinder,
    angle: float,
    radius: float,
    poisson: float,
    touches: Touches,
    loads: TouchLoads,
    adhesion: float,
    extent_rad: float = 0.0,
) -> Floats:
    """Return the model strain of one element under every touch, shape (nt,)."""
    highest = loads.normal.shape[1] - 1
    factor = _factors(cylinder, round(poisson, 7), round(radius, 10), highest)
    factor = factor * felt(highest, extent_rad)[:, None]
    # p even and q odd about the touch: both give strains even about it
    amplitude = loads.normal * factor[:, 0] - adhesion * loads.shear * factor[:, 1]
    phase = np.cos(np.arange(highest + 1) * (angle - touches.angle_rad)[:, None])
    strain: Floats = np.einsum("jk,jk->j", amplitude, phase)
    return strain


@dataclass(frozen=True, slots=True)
class Freedom:
    """Say what may move: depth (per element or one for all) and Poisson's ratio."""

    depth: bool = True
    poisson: bool = True


class NearTouches:
    """One element with the touches near the place where its fit begins."""

    def __init__(
        self,
        cylinder: Cylinder,
        start: ElementFit,
        output: Floats,
        touches: Touches,
        loads: TouchLoads,
        adhesion: float,
    ) -> None:
        near = np.abs(touches.angle_rad - start.angle_rad) <= NEAR
        self._cylinder, self._adhesion = cylinder, adhesion
        self._output, self._touches = output[near], touches.pick(near)
        self._loads = TouchLoads(loads.normal[near], loads.shear[near])

    @property
    def size(self) -> int:
        """Return the number of touches near."""
        return int(self._output.size)

    def _model(self, v: Floats) -> Floats:
        angle, radius, poisson, square = v.tolist()
        return -strain_of(
            self._cylinder, angle, radius, poisson, self._touches, self._loads, self._adhesion, square**0.5
        )

    def miss(self, v: Floats) -> Floats:
        """Return output less model with the best gain; v: place, radius, Poisson's ratio, square of the extent."""
        d, model = self._output, self._model(v)
        return np.asarray(d - model * (float(d @ model) / float(model @ model)))

    def fit(self, v: Floats) -> ElementFit:
        """Return the element with these parameters."""
        d, model = self._output, self._model(v)
        residual = float(np.sqrt(np.mean(self.miss(v) ** 2)))
        angle, radius, poisson, square = v.tolist()
        gain = float(model @ model) / float(d @ model)
        return ElementFit(angle, radius, poisson, gain, residual, d.size, square**0.5)


def fit_element(
    cylinder: Cylinder,
    start: ElementFit,
    output: Floats,
    touches: Touches,
    loads: TouchLoads,
    adhesion: float,
    freedom: Freedom,
) -> ElementFit:
    """Fit one element to the touches near it; `output` is its linear output, shape (nt,)."""
    one = NearTouches(cylinder, start, output, touches, loads, adhesion)
    free = np.array([True, freedom.depth, freedom.poisson, False])
    full = np.array([start.angle_rad, start.radius_m, start.poisson, start.extent_rad**2])

    def miss(free_values: Floats) -> Floats:
        values = full.copy()
        values[free] = free_values
        return one.miss(values)

    thick = cylinder.outer_m - cylinder.core_m
    low = np.array([full[0] - TURN, cylinder.core_m + SHALLOW * thick, SMALLEST, 0.0])
    high = np.array([full[0] + TURN, cylinder.core_m + DEEP * thick, LARGEST, MOST_EXTENT**2])
    # twice as far from the bounds as the difference quotient reaches
    inside = np.clip(full, low + 1e-4 * (high - low), high - 1e-4 * (high - low))
    scale = np.array([0.01, 0.05 * thick, 0.02, 1e-3])
    full[free] = least_squares(
        miss,
        inside[free],
        bounds=(low[free], high[free]),
        x_scale=scale[free],
        diff_step=np.full(int(free.sum()), 1e-5),
        xtol=1e-9,
        ftol=1e-10,
    ).x
    return one.fit(full)


def starts(
    cylinder: Cylinder, angles: Floats, radii: Floats, touches: Touches, extent_rad: float = 0.0
) -> list[ElementFit | None]:
    """Return where to start each element, None where too few touches are near or the element does not answer them."""
    near = np.abs(touches.angle_rad[:, None] - angles) <= NEAR
    enough = near.sum(axis=0) >= FEWEST
    loudest = np.max(np.where(near, np.abs(touches.output), 0.0), axis=0, initial=0.0)
    alive = loudest > _SILENT * np.median(loudest[enough]) if enough.any() else enough
    return [
        ElementFit(float(angle), float(radius), cylinder.poisson, 1.0, np.nan, int(count), extent_rad) if good else None
        for angle, radius, count, good in zip(angles, radii, near.sum(axis=0), enough & alive, strict=True)
    ]


def fit_elements(
    cylinder: Cylinder,
    begin: list[ElementFit | None],
    touches: Touches,
    loads: TouchLoads,
    adhesion: float,
    freedom: Freedom,
    tick: Callable[[], None] = lambda: None,
) -> list[ElementFit | None]:
    """Fit every element that has touches; `tick` is called after each."""
    out: list[ElementFit | None] = []
    for element, start in enumerate(begin):
        found = None
        if start is not None:
            found = fit_element(cylinder, start, touches.output[:, element], touches, loads, adhesion, freedom)
        out.append(found)
        tick()
    return out
