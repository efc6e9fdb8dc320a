"""Two blades that leave a gap between them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

Two = tuple[float, float]


@dataclass(frozen=True, slots=True)
class Slits:
    """Joints (left, right): the blades' edges [m].  Coordinates (centre, gap) [m].

    Args:
        least_m: the least gap that is commanded, >= 0: the blades must not touch.
    """

    least_m: float = 0.0

    def __post_init__(self) -> None:
        if not 0.0 <= self.least_m <= 1e3:
            raise ValueError(f"describe slits: least_m {self.least_m:g}; want 0 to 1000")

    def forward(self, joints: Sequence[float]) -> Two:
        """Return (centre, gap) of the blades."""
        left, right = joints
        return 0.5 * (left + right), right - left

    def inverse(self, coordinates: Sequence[float]) -> Two:
        """Return the blades' places.

        Raises:
            ValueError: the gap is below `least_m`.

        Example:
            >>> Slits().inverse((0.5, 0.25))
            (0.375, 0.625)
        """
        centre, gap = coordinates
        if not gap >= self.least_m:
            raise ValueError(f"gap {gap:g} m would make the blades touch; want at least {self.least_m:g} m")
        return centre - 0.5 * gap, centre + 0.5 * gap

    def joint_rates(self, coordinates: Sequence[float], rates: Sequence[float]) -> Two:
        """Return the blades' velocities."""
        shift, opening = rates
        return shift - 0.5 * opening, shift + 0.5 * opening
