"""From what a skill asks for to commands for the hand's node: pure, one call a tick.

x, y, psi, phi1 and phi2 are given velocities by proportional control; d goes by velocity in free space, and takes the
force in contact, where the law runs next to the data, in the driver.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from sioms.hand.control import Controller, Gains
from sioms.hand.kinematics import COORDINATES, UNITS
from sioms.hand.touch import Setpoint

Order = tuple[int, bool, float]
"""Axis of the hand's node, whether it is a force [N], else a velocity [m/s, rad/s], and how much."""

D = COORDINATES.index("d")
_TURNS = tuple(unit == "rad" for unit in UNITS)
_BAND = {"m": 3e-4, "rad": 0.01}
"""Errors that are let be while something is held [m, rad]. It sticks to the platen: rates that are to bring a small
error back add up to a set-point that is ever farther away, until it jumps, each time farther."""


class Follower:
    """Make commands of set-points.  One caller at a time.

    Args:
        gains: of the laws; the damper's are the driver's own.
        most: fastest rates of the axes [m/s, rad/s]: the node refuses what is beyond. Shape (6,), or none.
    """

    def __init__(self, gains: Gains = Gains(), most: Sequence[float] = (math.inf,) * 6) -> None:  # noqa: B008
        self._gains, self._controller, self._most = gains, Controller(gains), most

    def orders(self, setpoint: Setpoint, now: Sequence[float], force: float, sample_s: float) -> list[Order]:
        """Return what the six axes are to do until the next tick.

        Args:
            setpoint: of the skill; not frozen.
            now: the six coordinates as read.
            force: internal force as read [N].
            sample_s: time since the last call [s], > 0.
        """
        goal, along, k = setpoint.goal, setpoint.along, self._gains.position
        touches = self._controller.feel(force, sample_s)
        found: list[Order] = []
        for axis, (rate, to, at, turns) in enumerate(zip(along, goal, now, _TURNS, strict=True)):
            if axis != D:
                error = math.remainder(to - at, math.tau) if turns else to - at
                if touches:
                    error -= min(max(error, -_BAND[UNITS[axis]]), _BAND[UNITS[axis]])
                found.append((axis, False, rate + k * error))
            elif touches:
                found.append((axis, True, setpoint.force))
            else:
                found.append((axis, False, self._controller.opening(to, rate, at, setpoint.force, touches=False)))
        return [self._bounded(*order) for order in found]

    def _bounded(self, axis: int, presses: bool, value: float) -> Order:
        most = self._most[axis]
        return axis, presses, value if presses else min(max(value, -most), most)


def standing() -> list[Order]:
    """Return what makes the hand stand, and go on pressing as before."""
    return [(axis, False, 0.0) for axis in range(len(COORDINATES)) if axis != D]
