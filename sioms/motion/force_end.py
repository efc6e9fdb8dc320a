"""What follows a force command that ends without another command: the axis brakes and holds, and presses no harder than
it was told.

The place to be held follows from a profile of braking. Where something stands within that way, the control law would
press on it with all it has, although a few newtons were asked for. So the actuator may work against the motion with
all its force, but in the direction of the motion, or of the force when the axis stood, at most with the force that was
asked for, beside the offset. Where that is not enough to follow the set-point, the set-point yields: the axis holds
where it is. An axis that is thrown back is braked with a tenth of its force if that is more. At rest the bound is
lifted; what is held then is held against what pushes from outside. A load that the bound does not carry must not sink
or fall: it is lifted after a second, too, and from an axis that has gone back for as long as no bounce needs to come
free.

The same bound holds for an axis that is stopped while a command allows it less force than is configured.

Pure; concurrency: that of its bank.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .axis_step import REST, REST_NS

LONGEST_NS, BACK_NS = 1_000_000_000, 100_000_000
"""So long an axis is bounded at most, and while it goes back [ns]."""
RELIEFS = 5
"""So often an axis that is driven back is relieved of what drives it, by half; the last time of all."""


class ForceEnds:
    """Bounds of the output of axes that have left force mode.

    Args:
        n: number of axes.

    Attributes:
        any: whether there is a bound at all.
        asked: force that was commanded last, NaN before one was (n,).
    """

    def __init__(self, n: int) -> None:
        self.any = False
        self.asked = np.full(n, math.nan)
        self._direction = np.zeros(n)
        self._most = np.zeros(n)
        self._presses = np.zeros(n, dtype=bool)
        self._moved_ns = np.zeros(n, dtype=np.int64)
        self._forced = np.zeros(n, dtype=bool)
        self._since_ns = np.zeros(n, dtype=np.int64)
        self._ahead_ns = np.zeros(n, dtype=np.int64)
        self._kept = np.zeros(n)
        """Signs of the forces against their motion that stopped axes have kept; 0: none, or at rest."""
        self._back = np.zeros(n)
        self._reliefs = np.zeros(n, dtype=np.int64)
        self._went_ns = np.zeros(n, dtype=np.int64)

    def begin(self, axis: int, velocity: float, limit: float, offset: float) -> None:
        """Bound the output of an axis that leaves force mode.

        Args:
            axis: bank axis.
            velocity: measured [unit/s].
            limit: of the velocity [unit/s].
            offset: force that is added to every command.
        """
        asked = float(self.asked[axis])
        if math.isnan(asked):  # it was over before any tick put it out
            return
        direction = math.copysign(1.0, velocity if abs(velocity) > REST * limit else asked)
        self.hold_back(axis, direction, max(0.0, asked * direction) + offset * direction)
        self._forced[axis] = True

    def hold_back(self, axis: int, direction: float, most: float) -> None:
        """Bound the output of an axis in a direction (its sign) until it has come to rest."""
        self._direction[axis] = math.copysign(1.0, direction)
        self._most[axis], self._moved_ns[axis], self._since_ns[axis] = most, 0, 0
        self.asked[axis], self._forced[axis] = math.nan, False
        self.any = True

    def keep(self, axes: NDArray[np.int64], signs: NDArray[np.float64]) -> None:
        """Note that axes, which move, are stopped with a force against their motion, of these signs (m,)."""
        self._kept[axes], self._back[axes], self._went_ns[axes], self._reliefs[axes] = signs, 0.0, 0, 0
        self.any = self.any or axes.size > 0

    def end(self, axes: NDArray[np.int64]) -> None:
        """Lift the bounds of axes: they are at rest, or have been given a command."""
        self._direction[axes], self.asked[axes], self._kept[axes] = 0.0, math.nan, 0.0
        self.any = bool(self._direction.any() or self._kept.any())

    def turned(
        self, velocity: NDArray[np.float64], limit: NDArray[np.float64], reach: NDArray[np.float64], now_ns: int
    ) -> tuple[NDArray[np.int64], NDArray[np.float64]]:  # fmt: skip
        """Return the axes that the force which they have kept drives back, ever faster: it carries nothing, or less;
        and which part of it each is to keep still: half of it, and at last nothing.

        Args:
            velocity: measured (n,).
            limit: of the velocity (n,).
            reach: from the axes to what they are driven to, as far as that matters (n,) [unit].
            now_ns: instant of the tick.
        """
        kept = self._kept != 0.0
        back = velocity * self._kept
        found = np.flatnonzero((self._kept * reach > 0.0) & (back > REST * limit) & (back > self._back))
        self._back[:] = back
        self._reliefs[found] += 1
        part = np.where(self._reliefs[found] < RELIEFS, 0.5, 0.0)
        self._kept[found[part == 0.0]] = 0.0
        moves = kept & ((np.abs(velocity) > REST * limit) | (self._went_ns == 0))
        self._went_ns[moves] = now_ns
        self._kept[kept & (now_ns - self._went_ns > REST_NS)] = 0.0
        self.any = bool(self._direction.any() or self._kept.any())
        return found, part

    def is_bound(self, axes: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Tell which axes are bounded: they have not come to rest yet."""
        bound: NDArray[np.bool_] = self._direction[axes] != 0.0
        return bound

    def has_left(self, axes: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Tell which axes are bounded because they have left force mode."""
        return self.is_bound(axes) & self._forced[axes]

    def goes_on(
        self, axes: NDArray[np.int64], velocity: NDArray[np.float64], limit: NDArray[np.float64]
    ) -> NDArray[np.bool_]:
        """Tell which axes go on in the direction in which they are bounded, by velocities and their limits (n,)."""
        along: NDArray[np.bool_] = velocity[axes] * self._direction[axes] > REST * limit[axes]
        return along

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return what the law bounds outputs by, by the names of its fields."""
        return {"asked": self.asked, "direction": self._direction, "most": self._most, "presses": self._presses}

    def look(self, velocity: NDArray[np.float64], limit: NDArray[np.float64], now_ns: int) -> NDArray[np.int64]:
        """Lift the bounds of axes at rest; return the axes whose set-point has to yield.

        Args:
            velocity: measured (n,).
            limit: of the velocity (n,).
            now_ns: instant of the tick.
        """
        bounded = self._direction != 0.0
        fresh = bounded & (self._since_ns == 0)
        self._since_ns[fresh] = now_ns
        self._ahead_ns[~bounded | fresh | (velocity * self._direction > -REST * limit)] = now_ns
        moves = bounded & ((np.abs(velocity) > REST * limit) | (self._moved_ns == 0))
        self._moved_ns[moves] = now_ns
        back = now_ns - self._ahead_ns > BACK_NS
        yields = np.flatnonzero(bounded & (self._presses | back))
        back |= (now_ns - self._since_ns > LONGEST_NS) | (now_ns - self._moved_ns > REST_NS)
        rested = np.flatnonzero(bounded & back)
        if rested.size:
            self.end(rested)
        return yields
