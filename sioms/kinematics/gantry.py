"""A bridge on two parallel axes, with a carriage on it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

Three = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Gantry:
    """Joints (x, y1, y2): the carriage on the bridge, and the bridge's ends [m].  Coordinates (x, y, skew).

    y is that of the carriage in the middle of the bridge [m]; skew is the bridge's angle, atan((y2 - y1)/span) [rad].

    Args:
        span_m: distance of the two parallel axes, > 0.
        skew_max: largest |skew| [rad], above 0 and below pi/2; beyond it the bridge would jam.
    """

    span_m: float
    skew_max: float = 0.01

    def __post_init__(self) -> None:
        if not 1e-3 <= self.span_m <= 1e3:
            raise ValueError(f"describe gantry: span_m {self.span_m:g}; want 0.001 to 1000")
        if not 1e-9 <= self.skew_max < 0.5 * math.pi:
            raise ValueError(f"describe gantry: skew_max {self.skew_max:g} rad; want 1e-9 or more and below pi/2")

    def forward(self, joints: Sequence[float]) -> Three:
        """Return (x, y, skew) of joints; a bridge that is skewed too far still has a skew."""
        x, y1, y2 = joints
        return x, 0.5 * (y1 + y2), math.atan((y2 - y1) / self.span_m)

    def inverse(self, coordinates: Sequence[float]) -> Three:
        """Return the joints of (x, y, skew).

        Raises:
            ValueError: the skew is beyond `skew_max`.

        Example:
            >>> Gantry(span_m=1.0).inverse((0.2, 0.5, 0.0))
            (0.2, 0.5, 0.5)
        """
        x, y, skew = coordinates
        if not abs(skew) <= self.skew_max:
            raise ValueError(f"skew {skew:g} rad would jam the bridge; want at most {self.skew_max:g} rad")
        half = 0.5 * self.span_m * math.tan(skew)
        return x, y - half, y + half

    def joint_rates(self, coordinates: Sequence[float], rates: Sequence[float]) -> Three:
        """Return the joints' velocities."""
        vx, vy, turn = rates
        half = 0.5 * self.span_m * turn / math.cos(coordinates[2]) ** 2
        return vx, vy - half, vy + half
