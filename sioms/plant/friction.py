"""Exact motion of a mass under a force held constant, viscous friction and dry friction.

One step solves, for each axis on its own,

    m dv/dt = F - b v - c sgn(v),   v = 0 kept while |F| <= h        (b, c, h may depend on direction)

in closed form: the exponential solution up to the instant at which the velocity comes to zero, then
rest (stiction) or the solution from rest the other way. There is no smoothing of the sign function
and no step-size limit from friction, however stiff. A force that depends on the position enters as
its value at the mid-point of the step (``x + v t/2``), which makes the scheme second order, and for
a conservative force without friction the leapfrog method, whose energy error stays bounded.

Conventions: ``state`` is an array of shape (2, n), velocities in row 0, positions in row 1.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# Turns the surplus over stiction into a direction without disturbing any velocity that matters.
_TINY = 1e-200
_SERIES_BELOW = 1e-2


@dataclass(frozen=True, slots=True)
class Directed:
    """A coefficient for motion in the positive and in the negative direction, shape (n,) each."""

    plus: Array
    minus: Array

    @classmethod
    def both(cls, value: Array) -> "Directed":
        """Return the same coefficient for both directions."""
        return cls(value, value)

    @property
    def symmetric(self) -> bool:
        """Whether the direction makes no difference."""
        return bool(np.array_equal(self.plus, self.minus))

    def along(self, direction: Array, axes: NDArray[np.intp]) -> Array:
        """Return the coefficient of the given axes for their direction (+1 or -1)."""
        return np.where(direction > 0, self.plus[axes], self.minus[axes])


def coefficients(viscous: Array, mass: Array, time_s: Array) -> tuple[Array, Array, Array, Array]:
    """Return the solution of ``m dv/dt = N - b v`` after a time, N constant.

    Args:
        viscous: b [N s/m], at least 0.
        mass: m [kg], positive.
        time_s: duration [s].

    Returns:
        (e, g, p, q) with ``v1 = e v0 + g N`` and ``x1 = x0 + p v0 + q N``; accurate for any b,
        also zero.
    """
    z = viscous * time_s / mass
    small = z < _SERIES_BELOW
    divisor = np.where(small, 1.0, z)
    # phi2 = (z - 1 + exp(-z)) / z^2, by its series where the difference would cancel.
    series = 1 / 2 - z / 6 * (1 - z / 4 * (1 - z / 5 * (1 - z / 6 * (1 - z / 7))))
    direct = (1 + np.expm1(-z) / divisor) / divisor
    phi2 = np.where(small, series, direct)
    phi1 = np.where(small, 1 - z * series, -np.expm1(-z) / divisor)
    return np.exp(-z), time_s / mass * phi1, time_s * phi1, time_s * time_s / mass * phi2


class FrictionStep:
    """Steps n masses, in place, by one fixed duration.

    Args:
        state: shape (2, n), velocities and positions; stepped in place.
        mass: [kg], shape (n,), positive.
        viscous: b [N s/m].
        sliding: dry friction while moving [N].
        breakaway: force that a resting mass withstands [N], at least the sliding friction.
        time_s: duration of a step [s].
    """

    def __init__(
        self,
        state: Array,
        mass: Array,
        viscous: Directed,
        sliding: Directed,
        breakaway: Directed,
        time_s: float,
    ) -> None:
        n = mass.size
        self.state = state
        self.time_s = time_s
        self._mass = mass
        self._viscous = viscous
        self._sliding = sliding
        self._breakaway = breakaway
        self._hold_minus = -breakaway.minus
        time = np.full(n, time_s)
        plus = np.array(coefficients(viscous.plus, mass, time))
        minus = np.array(coefficients(viscous.minus, mass, time))
        self._directed = not (viscous.symmetric and sliding.symmetric)
        # Rows (e, p) act on the old velocity, rows (g, q) on the net force: one product for both.
        self._of_velocity, self._of_force = plus[[0, 2]], plus[[1, 3]]
        mean, half = (plus + minus) / 2, (plus - minus) / 2
        self._velocity_mean, self._velocity_half = mean[[0, 2]], half[[0, 2]]
        self._force_mean, self._force_half = mean[[1, 3]], half[[1, 3]]
        self._level = sliding.plus.copy()
        self._level_mean = (sliding.plus + sliding.minus) / 2
        self._level_half = (sliding.plus - sliding.minus) / 2
        self._direction, self._net, self._work = np.zeros((3, n))
        self._new, self._part = np.zeros((2, 2, n))
        self._reversed = np.zeros(n, dtype=np.bool_)
        self._resistance: Array | None = None
        self._variation: Array | None = None

    def step(self, force: Array, resistance: Array | None = None, variation: Array | None = None) -> None:
        """Advance all masses.

        Args:
            force: [N], shape (n,), held over the step.
            resistance: further dry friction [N], at least 0, added to sliding and breakaway.
            variation: factor on sliding and breakaway, at least 0.
        """
        velocity = self.state[0]
        direction, net, new = self._direction, self._net, self._new
        self._resistance, self._variation = resistance, variation
        self._find_direction(force, velocity, resistance)
        if self._directed:
            self._select(direction)
        # (F d - c) d is F - c d for a moving mass and 0 for one that sticks (d = 0).
        np.multiply(force, direction, out=net)
        np.subtract(net, self._level if variation is None else self._level * variation, out=net)
        if resistance is not None:
            np.subtract(net, resistance, out=net)
        np.multiply(net, direction, out=net)
        np.multiply(self._of_velocity, velocity, out=new)
        np.multiply(self._of_force, net, out=self._part)
        np.add(new, self._part, out=new)
        np.add(new[1], self.state[1], out=new[1])
        np.multiply(new[0], direction, out=self._work)
        np.less(self._work, 0.0, out=self._reversed)
        if np.count_nonzero(self._reversed):
            self._stop_and_reverse(np.flatnonzero(self._reversed), force)
        self.state[...] = new

    def _find_direction(self, force: Array, velocity: Array, resistance: Array | None) -> None:
        """Set the direction to the sign of the velocity; at rest to that of a force over stiction, else 0."""
        work, direction = self._work, self._direction
        plus, minus = self._breakaway.plus, self._hold_minus
        if self._variation is not None:
            plus, minus = plus * self._variation, minus * self._variation
        if resistance is None:
            np.minimum(force, plus, out=work)
            np.maximum(work, minus, out=work)
        else:
            np.add(plus, resistance, out=work)
            np.minimum(work, force, out=work)
            np.subtract(minus, resistance, out=direction)
            np.maximum(work, direction, out=work)
        np.subtract(force, work, out=work)
        np.multiply(work, _TINY, out=work)
        np.add(work, velocity, out=work)
        np.sign(work, out=direction)

    def _select(self, direction: Array) -> None:
        """Take the coefficients of the direction of motion."""
        np.multiply(direction, self._velocity_half, out=self._of_velocity)
        np.add(self._of_velocity, self._velocity_mean, out=self._of_velocity)
        np.multiply(direction, self._force_half, out=self._of_force)
        np.add(self._of_force, self._force_mean, out=self._of_force)
        np.multiply(direction, self._level_half, out=self._level)
        np.add(self._level, self._level_mean, out=self._level)

    def _stop_and_reverse(self, axes: NDArray[np.intp], force_all: Array) -> None:
        """Redo the axes that came to rest within the step: up to the stop, then rest or the way back."""
        mass, force, net = self._mass[axes], force_all[axes], self._net[axes]
        velocity, position = self.state[:, axes]
        extra = 0.0 if self._resistance is None else self._resistance[axes]
        times = 1.0 if self._variation is None else self._variation[axes]
        viscous = self._viscous.along(velocity, axes)
        # Time to rest: (m/b) ln(1 - b v/N), which is -m v/N for b = 0.
        z = -viscous * velocity / net
        log_ratio = np.where(z < 1e-8, 1 - z / 2, np.log1p(z) / np.where(z == 0, 1.0, z))
        stop_s = np.minimum(-mass * velocity / net * log_ratio, self.time_s)
        _, _, p, q = coefficients(viscous, mass, stop_s)
        stopped_at = position + p * velocity + q * net
        back = np.sign(force)
        moves = np.abs(force) > times * self._breakaway.along(back, axes) + extra
        net_back = np.where(moves, force - back * (times * self._sliding.along(back, axes) + extra), 0.0)
        _, g, _, q = coefficients(self._viscous.along(back, axes), mass, self.time_s - stop_s)
        self._new[0, axes] = g * net_back
        self._new[1, axes] = stopped_at + q * net_back
