"""Map the joints of two modules to the six coordinates of the hand, and back.

Joints (x1, y1, th1, x2, y2, th2): a module's carriage [m] and the angle of its link [rad].  Hand (x, y, psi, d, phi1,
phi2): middle of the two finger centres [m], direction and length of the line from finger 1 to finger 2 [rad, m], and
the angle in each finger's own frame at which that line leaves the finger [rad].  x, y and psi move the object, d
squeezes it, phi1 and phi2 roll the fingers.

Plain floats: these maps run in every tick.  Source: dissertation, section 4.1.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Six = tuple[float, float, float, float, float, float]

LINK_M, LONGEST_M = 0.140, 10.0
COORDINATES = ("x", "y", "psi", "d", "phi1", "phi2")
UNITS = ("m", "m", "rad", "m", "rad", "rad")


def wrap(angle: float) -> float:
    """Return the angle within (-pi, pi] [rad]."""
    turned = math.remainder(angle, math.tau)
    return math.pi if turned <= -math.pi else turned


@dataclass(frozen=True, slots=True)
class Hand:
    """Two modules whose links carry the fingers; immutable, safe to share.

    Args:
        link1_m, link2_m: from the revolute axis of a module to its finger's centre, > 0.
        least_m: the least d [m] that the maps take, > 0; at d = 0 psi has no meaning.
    """

    link1_m: float = LINK_M
    link2_m: float = LINK_M
    least_m: float = 1e-6

    def __post_init__(self) -> None:
        for name in ("link1_m", "link2_m", "least_m"):
            if not 0.0 < getattr(self, name) <= LONGEST_M:
                raise ValueError(
                    f"describe hand: {name} is {getattr(self, name)} m; want more than 0, at most {LONGEST_M:g}"
                )

    def forward(self, joints: Sequence[float]) -> Six:
        """Return the hand coordinates of joints; psi and phi within (-pi, pi].

        Raises:
            ValueError: the fingers' centres coincide.

        Example:
            >>> deg = math.pi / 180
            >>> q = Hand().forward((0.100, 0.020, 70 * deg, 0.240, 0.035, 110 * deg))
            >>> [round(1e3 * q[0], 3), round(1e3 * q[3], 4), round(q[2] / deg, 4)]
            [170.0, 46.7084, 18.7319]
        """
        x1, y1, th1, x2, y2, th2 = joints
        ax, ay = x1 + self.link1_m * math.cos(th1), y1 + self.link1_m * math.sin(th1)
        bx, by = x2 + self.link2_m * math.cos(th2), y2 + self.link2_m * math.sin(th2)
        d = self._apart(math.hypot(bx - ax, by - ay))
        psi = math.atan2(by - ay, bx - ax)
        return 0.5 * (ax + bx), 0.5 * (ay + by), psi, d, wrap(psi - th1), wrap(psi - th2 + math.pi)

    def inverse(self, hand: Sequence[float]) -> Six:
        """Return the joints of hand coordinates; link angles follow psi and phi without being wrapped.

        Raises:
            ValueError: d is below `least_m`.
        """
        x, y, psi, d, phi1, phi2 = hand
        hx, hy = 0.5 * self._apart(d) * math.cos(psi), 0.5 * d * math.sin(psi)
        th1, th2 = psi - phi1, psi - phi2 + math.pi
        return (
            x - hx - self.link1_m * math.cos(th1),
            y - hy - self.link1_m * math.sin(th1),
            th1,
            x + hx - self.link2_m * math.cos(th2),
            y + hy - self.link2_m * math.sin(th2),
            th2,
        )

    def joint_rates(self, hand: Sequence[float], rates: Sequence[float]) -> Six:
        """Return the joints' velocities at hand coordinates that move at `rates`."""
        _, _, psi, d, phi1, phi2 = hand
        vx, vy, turn, opening, roll1, roll2 = rates
        c, s = math.cos(psi), math.sin(psi)
        hx, hy = 0.5 * (opening * c - d * s * turn), 0.5 * (opening * s + d * c * turn)
        th1, th2 = psi - phi1, psi - phi2 + math.pi
        w1, w2 = turn - roll1, turn - roll2
        return (
            vx - hx + self.link1_m * math.sin(th1) * w1,
            vy - hy - self.link1_m * math.cos(th1) * w1,
            w1,
            vx + hx + self.link2_m * math.sin(th2) * w2,
            vy + hy - self.link2_m * math.cos(th2) * w2,
            w2,
        )

    def hand_rates(self, joints: Sequence[float], rates: Sequence[float]) -> Six:
        """Return the hand's velocities at joints that move at `rates`.

        Raises:
            ValueError: as `forward`.
        """
        _, _, th1, _, _, th2 = joints
        vx1, vy1, w1, vx2, vy2, w2 = rates
        _, _, psi, d, _, _ = self.forward(joints)
        ax, ay = vx1 - self.link1_m * math.sin(th1) * w1, vy1 + self.link1_m * math.cos(th1) * w1
        bx, by = vx2 - self.link2_m * math.sin(th2) * w2, vy2 + self.link2_m * math.cos(th2) * w2
        c, s = math.cos(psi), math.sin(psi)
        turn = (c * (by - ay) - s * (bx - ax)) / d
        return 0.5 * (ax + bx), 0.5 * (ay + by), turn, c * (bx - ax) + s * (by - ay), turn - w1, turn - w2

    def jacobian(self, hand: Sequence[float]) -> Floats:
        """Return d joints / d hand, shape (6, 6): column j is what coordinate j moves.

        Forces map by its transpose: hand forces = jacobian.T @ joint forces, of the same power.
        """
        columns = [self.joint_rates(hand, [float(i == j) for i in range(6)]) for j in range(6)]
        return np.array(columns).T

    def _apart(self, d: float) -> float:
        if not self.least_m <= d < math.inf:
            raise ValueError(
                f"map hand: distance of the fingers' centres is {d} m; want at least {self.least_m} m, for the line "
                "through them has no direction at 0"
            )
        return d
