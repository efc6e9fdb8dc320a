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

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from .friction_step import Friction, glide, keep

Array = NDArray[np.float64]

_SERIES_BELOW = 1e-2


class Directed(Struct, frozen=True):
    """A coefficient for motion in the positive and in the negative direction, shape (n,) each."""

    plus: Array
    minus: Array

    @classmethod
    def both(cls, value: Array) -> "Directed":
        """Return the same coefficient for both directions."""
        return cls(value, value)


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

    Attributes:
        resistance: as of ``step``, shape (n,) [N]; it stays until it is changed.
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
        time = np.full(n, time_s)
        plus = np.array(coefficients(viscous.plus, mass, time))
        minus = np.array(coefficients(viscous.minus, mass, time))
        # Rows (e, p) act on the old velocity, rows (g, q) on the net force.
        mean, half = (plus + minus) / 2, (plus - minus) / 2
        self.force, self.resistance = np.zeros((2, n))
        self._variation = np.ones(n)
        self.record = Friction(
            n=n, state=state, force=self.force, resistance=self.resistance, variation=self._variation,
            plus=breakaway.plus.copy(), minus=-breakaway.minus,
            sliding=(sliding.plus + sliding.minus) / 2, sliding_half=(sliding.plus - sliding.minus) / 2,
            velocity_mean=mean[[0, 2]], velocity_half=half[[0, 2]], force_mean=mean[[1, 3]], force_half=half[[1, 3]],
            fresh=np.zeros((2, n)), time_s=time_s, mass=mass.copy(),
            viscous_plus=viscous.plus.copy(), viscous_minus=viscous.minus.copy(),
        )  # fmt: skip

    def step(self, force: Array, resistance: Array | None = None, variation: Array | None = None) -> None:
        """Advance all masses.

        Args:
            force: [N], shape (n,), held over the step.
            resistance: further dry friction [N], at least 0, added to sliding and breakaway.
            variation: factor on sliding and breakaway, at least 0.
        """
        np.copyto(self.force, force)
        if resistance is not None:
            np.copyto(self.resistance, resistance)
        if variation is not None:
            np.copyto(self._variation, variation)
        glide(self.record)
        keep(self.record)
