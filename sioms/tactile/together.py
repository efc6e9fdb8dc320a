"""Fit all elements of a finger at once: what they have in common, and for each its place, gain and mostly its depth.

Poisson's ratio and the arc that an element averages over are the same for all; one element alone cannot tell them from
its depth. One least-squares problem in output units; gains are linear inside, see `calibrate`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from sioms.tactile.calibrate import DEEP, LARGEST, SHALLOW, SMALLEST, TURN, ElementFit, NearTouches
from sioms.tactile.cylinder import Cylinder
from sioms.tactile.emap import MOST_EXTENT
from sioms.tactile.touches import Touches, TouchLoads

Floats = NDArray[np.float64]

_POISSON, _EXTENT = 2, 3  # columns; place and depth are the first


@dataclass(frozen=True, slots=True)
class Common:
    """Say what moves beside place and gain: one depth for all or each its own, Poisson's ratio, the extent."""

    depth: bool = False
    poisson: bool = True
    extent: bool = True


@dataclass(frozen=True, slots=True)
class Shared:
    """Hold Poisson's ratio and the square of the extent [rad^2] of all elements; deviations are infinite where held."""

    poisson: float
    poisson_deviation: float
    extent_square: float
    extent_deviation: float


def fit_together(
    cylinder: Cylinder, begin: list[ElementFit | None], touches: Touches, loads: TouchLoads, adhesion: float,
    common: Common,
) -> tuple[list[ElementFit | None], Shared]:  # fmt: skip
    """Fit the elements that have touches near them, of which `begin` says where to start."""
    work = [NearTouches(cylinder, fit, touches.output[:, e], touches, loads, adhesion)
            for e, fit in enumerate(begin) if fit is not None]  # fmt: skip
    start = np.array(
        [[f.angle_rad, f.radius_m, f.poisson, f.extent_rad**2] for f in begin if f is not None],
        dtype=np.float64,
    )
    problem = _Problem(cylinder, work, start, common)
    best, shared = problem.solve()
    fits = iter([one.fit(row) for one, row in zip(work, best, strict=True)])
    return [None if fit is None else next(fits) for fit in begin], shared


class _Problem:
    """The least-squares problem over one vector; row i of a matrix of parameters is element i's.

    The extent goes by its square, with which strain changes from zero on.
    """

    def __init__(self, cylinder: Cylinder, work: list[NearTouches], start: Floats, common: Common) -> None:
        thick, count = cylinder.outer_m - cylinder.core_m, len(work)
        self._work, self._start = work, start
        self._scale = np.array([0.01, 0.05 * thick, 0.02, 1e-3])
        self._step = np.array([1e-6, 1e-4 * thick, 1e-4, 1e-6])
        self._low = np.array([-np.inf, cylinder.core_m + SHALLOW * thick, SMALLEST, 0.0])
        self._high = np.array([np.inf, cylinder.core_m + DEEP * thick, LARGEST, MOST_EXTENT**2])
        self._place = _places(count, common)
        self._moving = self._place >= 0
        self._column = np.zeros(int(self._place.max()) + 1, dtype=np.intp)
        self._column[self._place[self._moving]] = np.nonzero(self._moving)[1]
        self._rows = np.repeat(np.arange(count), [one.size for one in work])

    def solve(self) -> tuple[Floats, Shared]:
        """Return the parameters of every element, shape (elements, 4), and what they share."""
        first = np.array([self._start[self._place == n].mean() for n in range(self._column.size)])
        low, high = self._low[self._column], self._high[self._column]
        turns = self._column == 0
        low[turns], high[turns] = first[turns] - TURN, first[turns] + TURN
        inside, scale = (
            np.clip(first, low + 1e-3 * (high - low), high - 1e-3 * (high - low)),
            self._scale[self._column],
        )
        found = least_squares(
            self._misses, inside, jac=self._slopes, bounds=(low, high), x_scale=scale, xtol=1e-8, ftol=1e-9
        )
        matrix = np.asarray(found.jac, dtype=np.float64) * scale
        freedom = max(matrix.shape[0] - matrix.shape[1] - len(self._work), 1)
        variance = 2.0 * float(found.cost) / freedom
        deviation = scale * np.sqrt(np.diag(np.linalg.pinv(matrix.T @ matrix)) * variance)
        best = self._each(found.x)
        nu, extent = (float(deviation[n]) if n >= 0 else np.inf for n in self._place[0, _POISSON:])
        return best, Shared(float(best[0, _POISSON]), nu, float(best[0, _EXTENT]), extent)

    def _each(self, x: Floats) -> Floats:
        return np.where(self._moving, x[self._place], self._start)

    def _at(self, parameters: Floats) -> Floats:
        return np.concatenate([one.miss(row) for one, row in zip(self._work, parameters, strict=True)])

    def _misses(self, x: Floats) -> Floats:
        return self._at(self._each(x))

    def _slopes(self, x: Floats) -> Floats:
        """Return d misses/dx: an element's residuals move with its own parameters alone, so one step moves all
        elements.
        """
        each, every = self._each(x), np.arange(self._rows.size)
        at, out = self._at(each), np.zeros((every.size, x.size))
        for column in np.unique(self._column):
            step = self._step[column]
            h = np.where(each[:, column] + step < self._high[column], step, -step)
            moved = each.copy()
            moved[:, column] += h
            out[every, self._place[self._rows, column]] += (self._at(moved) - at) / h[self._rows]
        return out


def _places(count: int, common: Common) -> NDArray[np.intp]:
    """Return which number of the vector each parameter of each element is, shape (elements, 4); -1 where it is held."""
    every = np.arange(count)
    place = np.full((count, 4), -1, dtype=np.intp)
    place[:, 0], place[:, 1] = every, count + (0 if common.depth else every)
    size = count + (1 if common.depth else count)
    for column, moves in ((_POISSON, common.poisson), (_EXTENT, common.extent)):
        if moves:
            place[:, column], size = size, size + 1
    return place
