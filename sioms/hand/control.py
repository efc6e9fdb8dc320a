"""The laws that move a hand: proportional in its coordinates, a virtual spring on d in free space, a damper in contact.

    free space   q' = K (q_d - q_a),  d' = K_d (d_d - d_a - (f_d - f_a)/K_s)
    contact      d' = -K_v (f_d - f_a)

f > 0 squeezes; both signs follow from "too little force closes".  What comes out are rates of the six hand coordinates;
`Hand.joint_rates` makes joint velocities of them.  Source: dissertation, section 4.2; signs repaired.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from sioms.hand.kinematics import Six


@dataclass(frozen=True, slots=True)
class Gains:
    """Gains and bounds of the laws; immutable.

    Args:
        position: K [1/s], of x, y, psi, phi1 and phi2.
        spring_rate: K_d [1/s].
        spring: K_s [N/m].
        damper: K_v [m/(s N)]; `damper_limit` tells where the loop becomes unstable.
        filter_s: time constant of the force's low-pass [s]; 0 for none. Without one the link rings on the rubber at
            400 Hz long before the quasi-static limit.
        opening_max: largest |d'| [m/s].
        contact_n: force from which on there is contact [N], >= 0.
    """

    position: float = 5.0
    spring_rate: float = 5.0
    spring: float = 100.0
    damper: float = 0.4
    filter_s: float = 0.02
    opening_max: float = 0.1
    contact_n: float = 0.02

    def __post_init__(self) -> None:
        for name in self.__slots__:
            value, least = getattr(self, name), name in ("filter_s", "contact_n")
            if not ((value >= 0.0 if least else value > 0.0) and value < math.inf):
                wanted = "0 or more" if least else "more than 0"
                raise ValueError(f"describe gains of a hand: {name} is {value}; want {wanted}, finite")


class Controller:
    """Carry out the laws, sample by sample.  One caller at a time.

    Args:
        gains: of the laws.

    Attributes:
        felt: the force after the filter [N].
    """

    def __init__(self, gains: Gains) -> None:
        self.gains = gains
        self.felt = 0.0

    def rates(
        self, goal: Sequence[float], along: Sequence[float], now: Sequence[float], wanted: float, force: float,
        sample_s: float,
    ) -> Six:  # fmt: skip
        """Return the rates of x, y [m/s], psi [rad/s], d [m/s], phi1 and phi2 [rad/s] for the next sample.

        Args:
            goal: the six coordinates wanted now.
            along: the rates at which the goal itself moves; that of d counts in free space only.
            now: the six coordinates as measured.
            wanted: internal force f_d [N].
            force: internal force f_a as measured [N].
            sample_s: time since the last sample [s], > 0.
        """
        gains = self.gains
        share = 1.0 if gains.filter_s == 0.0 else -math.expm1(-sample_s / gains.filter_s)
        self.felt += share * (force - self.felt)
        error = wanted - self.felt
        if force > gains.contact_n or self.felt > gains.contact_n:
            opening = -gains.damper * error
        else:
            opening = along[3] + gains.spring_rate * (goal[3] - now[3] - error / gains.spring)
        opening = min(max(opening, -gains.opening_max), gains.opening_max)
        k = gains.position
        return (
            along[0] + k * (goal[0] - now[0]),
            along[1] + k * (goal[1] - now[1]),
            along[2] + k * math.remainder(goal[2] - now[2], math.tau),
            opening,
            along[4] + k * math.remainder(goal[4] - now[4], math.tau),
            along[5] + k * math.remainder(goal[5] - now[5], math.tau),
        )
