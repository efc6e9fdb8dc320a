"""Fit the elements of a finger to recorded touches: place, effective depth, Poisson's ratio and gain (dissertation 3.4).

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
from sioms.tactile.touches import Touches, TouchLoads

Floats = NDArray[np.float64]

NEAR = np.radians(25.0)
FEWEST = 12  # touches near an element for four parameters
REFERENCE_LOAD = 200.0  # N/m, of the edge whose peak strain is the unit of residuals
_SILENT = 0.05  # of what the others answer: an element that answers less is dead
_TURN = 0.15  # rad, how far an element may lie from its nominal place
_SMALLEST, _LARGEST = 0.35, 0.5  # Poisson's ratio


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
    """

    angle_rad: float
    radius_m: float
    poisson: float
    gain: float
    residual: float
    near: int


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
) -> Floats:
    """Return the model strain of one element under every touch, shape (nt,)."""
    highest = loads.normal.shape[1] - 1
    factor = _factors(cylinder, round(poisson, 7), round(radius, 10), highest)
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
    near = np.abs(touches.angle_rad - start.angle_rad) <= NEAR
    mine, d = touches.pick(near), output[near]
    local = TouchLoads(loads.normal[near], loads.shear[near])
    free = np.array([True, freedom.depth, freedom.poisson])
    full = np.array([start.angle_rad, start.radius_m, start.poisson])

    def model(free_values: Floats) -> Floats:
        values = full.copy()
        values[free] = free_values
        return -strain_of(cylinder, values[0], values[1], values[2], mine, local, adhesion)

    def miss(free_values: Floats) -> Floats:
        strain = model(free_values)
        rest: Floats = d - strain * (float(d @ strain) / float(strain @ strain))
        return rest

    thick = cylinder.outer_m - cylinder.core_m
    low = np.array([full[0] - _TURN, cylinder.core_m + 0.02 * thick, _SMALLEST])
    high = np.array([full[0] + _TURN, cylinder.core_m + 0.9 * thick, _LARGEST])
    # twice as far from the bounds as the difference quotient reaches
    inside = np.clip(full, low + 1e-4 * (high - low), high - 1e-4 * (high - low))
    scale = np.array([0.01, 0.05 * thick, 0.02])
    found = least_squares(
        miss,
        inside[free],
        bounds=(low[free], high[free]),
        x_scale=scale[free],
        diff_step=np.full(int(free.sum()), 1e-5),
        xtol=1e-9,
        ftol=1e-10,
    )
    full[free] = found.x
    strain = model(found.x)
    gain = float(strain @ strain) / float(d @ strain)
    residual = float(np.sqrt(np.mean(found.fun**2)))
    return ElementFit(float(full[0]), float(full[1]), float(full[2]), gain, residual, int(near.sum()))


def starts(cylinder: Cylinder, angles: Floats, radii: Floats, touches: Touches) -> list[ElementFit | None]:
    """Return where to start each element, None where too few touches are near or the element does not answer them."""
    near = np.abs(touches.angle_rad[:, None] - angles) <= NEAR
    enough = near.sum(axis=0) >= FEWEST
    loudest = np.max(np.where(near, np.abs(touches.output), 0.0), axis=0, initial=0.0)
    alive = loudest > _SILENT * np.median(loudest[enough]) if enough.any() else enough
    return [
        ElementFit(float(angle), float(radius), cylinder.poisson, 1.0, np.nan, int(count)) if good else None
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
            found = fit_element(
                cylinder, start, touches.output[:, element], touches, loads, adhesion, freedom
            )
        out.append(found)
        tick()
    return out


def fit_uniform(
    cylinder: Cylinder,
    begin: list[ElementFit | None],
    touches: Touches,
    loads: TouchLoads,
    adhesion: float,
    tick: Callable[[], None] = lambda: None,
    free_poisson: bool = True,
) -> tuple[list[ElementFit | None], tuple[float, float], tuple[float, float]]:
    """Fit one depth and one Poisson's ratio for all, places and gains for each.

    Returns:
        The elements, (depth, nu), and the standard deviations of both.
    """
    thick = cylinder.outer_m - cylinder.core_m
    known = [fit for fit in begin if fit is not None]
    places: list[ElementFit | None] = list(begin)

    def miss(common: Floats) -> Floats:
        nonlocal places
        moved = [
            None if fit is None else ElementFit(fit.angle_rad, float(common[0]) * thick + cylinder.core_m,
                float(common[1]) if free_poisson else cylinder.poisson, fit.gain, fit.residual, fit.near)
            for fit in begin
        ]  # fmt: skip
        places = fit_elements(cylinder, moved, touches, loads, adhesion, Freedom(False, False))
        tick()
        return np.concatenate(
            [
                _misses(cylinder, fit, first.angle_rad, e, touches, loads, adhesion)
                for e, (fit, first) in enumerate(zip(places, begin, strict=True))
                if fit is not None and first is not None
            ]
        )

    first = float(np.mean([fit.radius_m for fit in known]))
    start = np.array([(first - cylinder.core_m) / thick, min(cylinder.poisson, 0.495)])[: 1 + free_poisson]
    bounds = (np.array([0.02, _SMALLEST])[: 1 + free_poisson], np.array([0.9, _LARGEST])[: 1 + free_poisson])
    found = least_squares(
        miss,
        start,
        bounds=bounds,
        x_scale=[0.05, 0.02][: 1 + free_poisson],
        diff_step=np.full(start.size, 1e-3),
        xtol=1e-5,
    )
    miss(found.x)
    variance = 2.0 * found.cost / max(found.fun.size - 2 * len(known) - 2, 1)
    jacobian = np.asarray(found.jac, dtype=np.float64)
    deviation = np.sqrt(np.diag(np.linalg.pinv(jacobian.T @ jacobian)) * variance)
    nu = float(found.x[1]) if free_poisson else cylinder.poisson
    nu_deviation = float(deviation[1]) if free_poisson else np.inf
    depth = float(found.x[0]) * thick + cylinder.core_m
    return places, (depth, nu), (float(deviation[0]) * thick, nu_deviation)


def _misses(
    cylinder: Cylinder,
    fit: ElementFit,
    centre: float,
    element: int,
    touches: Touches,
    loads: TouchLoads,
    adhesion: float,
) -> Floats:
    """Return the residual [output] of a fitted element over the touches near `centre`, where its fit began."""
    near = np.abs(touches.angle_rad - centre) <= NEAR
    local = TouchLoads(loads.normal[near], loads.shear[near])
    strain = strain_of(
        cylinder, fit.angle_rad, fit.radius_m, fit.poisson, touches.pick(near), local, adhesion
    )
    residual: Floats = touches.output[near, element] + strain / fit.gain
    return residual
