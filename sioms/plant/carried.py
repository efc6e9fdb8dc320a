"""What motors carry on springs and that is simulated elsewhere: the springs' forces on the motors.

A spring between two simulations that see each other late pumps energy into what it joins: its force belongs to where
the motor was. Here the motor's simulation is told where the far end is and how stiff and damped the spring is, and
computes the force itself, with the motor's own position of the same instant. Then only the far end is late: a spring k
with a damper c between two ends that each see the other tau late is passive below the frequency 1/(2 tau) if

    c > k tau / 2                                                                                       (`most_late`)

(the real part of its impedance matrix [z, -z e^(-s tau); -z e^(-s tau), z], z = c + k/s, is not negative there), and
above it the masses of both ends have long taken over. What is left of the lateness is a drag of 2 k tau on the motion
of both ends together. Within a tick the force is that of the tick's end, by the
implicit rule, so that no stiffness is too high for the motor's own step.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class Carried:
    """Springs from n motors to what they carry.  One caller at a time.

    Args:
        mass: of the motors, shape (n,) [kg or kg m^2].
        tick_s: of their simulation.

    Attributes:
        far: rows place [m or rad], speed, stiffness and damping of the springs' far ends, shape (4, n).
    """

    def __init__(self, mass: Array, tick_s: float) -> None:
        self._mass, self._tick_s = mass, tick_s
        self.far = np.zeros((4, mass.size))

    def force(self, position: Array, velocity: Array, drive: Array) -> Array:
        """Return the springs' forces on the motors for the next tick, shape (n,) [N or N m].

        Args:
            position, velocity: of the motors.
            drive: all other force on them.
        """
        place, speed, stiffness, damping = self.far
        h, mass = self._tick_s, self._mass
        near = stiffness * (place - position) + damping * speed
        after = (mass * velocity + h * (drive + near)) / (mass + h * (damping + h * stiffness))
        found: Array = near - (damping + h * stiffness) * after
        return found


def most_late(stiffness: float, damping: float) -> float:
    """Return how late the ends of a spring may see each other [s] so that it stays passive."""
    return 2.0 * damping / stiffness if stiffness > 0.0 else math.inf
