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

_ACROSS = 0.5  # sine of the finger angle below which a link hardly moves its finger along the line of centres


@dataclass(frozen=True, slots=True)
class Gains:
    """Gains and bounds of the laws; immutable.

    Args:
        position: K [1/s], of x, y, psi, phi1 and phi2.
        spring_rate: K_d [1/s].
        spring: K_s [N/m].
        damper: K_v [m/(s N)]; `damped_limit` and `filtered_limit` tell where the loop becomes unstable.
        filter_s: time constant of the low-pass of the force and of what is wanted of it [s]; 0 for none. Without one
            the link rings on the rubber at 400 Hz long before the quasi-static limit.
        opening_max: largest |d'| [m/s].
        contact_n: force from which on there is contact [N], >= 0.
        link_m: in contact the links alone squeeze: d' turns them instead of moving the carriages, so that a finger does
            not turn on the object while the soft axis takes up the force. 0 for carriages that squeeze.
    """

    position: float = 5.0
    spring_rate: float = 5.0
    spring: float = 100.0
    damper: float = 0.4
    filter_s: float = 0.05
    opening_max: float = 0.1
    contact_n: float = 0.02
    link_m: float = 0.0

    def __post_init__(self) -> None:
        for name in self.__slots__:
            value, least = getattr(self, name), name in ("filter_s", "contact_n", "link_m")
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
        self._wanted: float | None = None  # after the filter
        self._share, self._squeezes = 1.0, False

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

        Raises:
            ValueError: a coordinate or force is not finite; the hand is to be stopped.
        """
        if not math.isfinite(sum(goal) + sum(along) + sum(now) + wanted + force):
            raise ValueError(
                f"move hand: a force of {force:g} N (wanted {wanted:g} N) at {', '.join(f'{q:g}' for q in now)}; "
                "want finite numbers"
            )
        gains = self.gains
        opening, touches = self.squeeze(goal[3], along[3], now[3], wanted, force, sample_s)
        k = gains.position
        x, y, psi, turn1, turn2 = self.by_links(opening, now) if touches and gains.link_m else (0.0,) * 5
        return (
            along[0] + k * (goal[0] - now[0]) + x,
            along[1] + k * (goal[1] - now[1]) + y,
            along[2] + k * math.remainder(goal[2] - now[2], math.tau) + psi,
            opening,
            along[4] + k * math.remainder(goal[4] - now[4], math.tau) + turn1,
            along[5] + k * math.remainder(goal[5] - now[5], math.tau) + turn2,
        )

    def feel(self, force: float, sample_s: float) -> bool:
        """Take a sample of the force [N]; return whether there is contact."""
        gains = self.gains
        self._share = 1.0 if gains.filter_s == 0.0 else -math.expm1(-sample_s / gains.filter_s)
        self.felt += self._share * (force - self.felt)
        if not self._squeezes:
            self._wanted = None
        self._squeezes = False
        return force > gains.contact_n or self.felt > gains.contact_n

    def squeeze(
        self, goal: float, along: float, now: float, wanted: float, force: float, sample_s: float
    ) -> tuple[float, bool]:
        """Return the rate of d [m/s], and whether there is contact; the arguments are those of `rates`, for d."""
        touches = self.feel(force, sample_s)
        return self.opening(goal, along, now, wanted, touches), touches

    def opening(self, goal: float, along: float, now: float, wanted: float, touches: bool) -> float:
        """Return the rate of d [m/s] for the force that was felt last.

        What is wanted is filtered as the force is, so that a step of it does not strike the link; not over a sample in
        which nothing was asked for.
        """
        gains, aim = self.gains, self._wanted
        aim = wanted if aim is None else aim + self._share * (wanted - aim)
        self._wanted, self._squeezes, error = aim, True, aim - self.felt
        spring = along + gains.spring_rate * (goal - now - error / gains.spring)
        opening = -gains.damper * error if touches else spring
        return min(max(opening, -gains.opening_max), gains.opening_max)

    def by_links(self, opening: float, now: Sequence[float]) -> tuple[float, float, float, float, float]:
        """Return what to add to the rates of x, y, psi, phi1, phi2, so that the carriages stay and the links open."""
        _, _, psi, d, phi1, phi2 = now
        length, half = self.gains.link_m, 0.5 * opening
        sin1, sin2 = max(math.sin(phi1), _ACROSS), max(math.sin(phi2), _ACROSS)
        side1, side2 = -half * math.cos(phi1) / sin1, half * math.cos(phi2) / sin2  # of the fingers, across the line
        shift, turn = 0.5 * (side1 + side2), (side2 - side1) / d
        return (
            -shift * math.sin(psi), shift * math.cos(psi), turn,
            turn + half / (length * sin1), turn + half / (length * sin2),
        )  # fmt: skip
