"""What joints let their coordinates do: where these may be, and how fast they go."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from .transform import Transform

_SLACK = 1e-7
"""What rounding may take a set-point beyond a limit [m or rad]."""
_FAR = 16
"""Doublings of a step within which coordinates that no joints have must come to some that joints have."""


@dataclass(frozen=True, slots=True)
class Joint:
    """An axis that is held.

    Args:
        name: for messages.
        unit: "m" or "rad".
        minimum, maximum: where it may be, infinite where there is no limit.
        velocity: fastest, > 0.
    """

    name: str
    unit: str = "m"
    minimum: float = -math.inf
    maximum: float = math.inf
    velocity: float = math.inf

    def beyond(self, position: float) -> float:
        """Return how far a position is beyond the limits, 0 within."""
        return max(self.minimum - position, position - self.maximum, 0.0)


class Reach:
    """Limits of joints as those of coordinates.

    Args:
        transform: the map.
        joints: in its order.
    """

    def __init__(self, transform: Transform, joints: Sequence[Joint]) -> None:
        self.transform, self.joints = transform, tuple(joints)

    def check(self, wanted: Sequence[float], present: Sequence[float], measured: Sequence[float]) -> None:
        """Look whether joints can be where coordinates want them.

        A joint that is beyond a limit already may come back, and so may coordinates that no joints have.

        Args:
            wanted: coordinates.
            present: where the coordinates are now.
            measured: where the joints are now: turns of a joint that the map does not count are taken from there.

        Raises:
            ValueError: no joints have these coordinates, or one would leave its limits, with a sentence.
        """
        try:
            here = self.transform.inverse(present)
        except ValueError:  # by as much as an encoder's step, or they were found so
            if self._comes_back(wanted, present):
                return
            raise
        found = self.transform.inverse(wanted)
        for joint, there, base, now in zip(self.joints, found, here, measured, strict=True):
            position = there - base + now
            if not joint.beyond(position) <= joint.beyond(now) + _SLACK:
                raise ValueError(
                    f"axis {joint.name} would be at {position:.6g} {joint.unit}; want {joint.minimum:g} to "
                    f"{joint.maximum:g} {joint.unit}"
                )

    def _comes_back(self, wanted: Sequence[float], present: Sequence[float]) -> bool:
        """Tell whether the way from coordinates that no joints have leads to some that joints have, and not away."""
        way = [to - at for to, at in zip(wanted, present, strict=True)]
        if not any(way):
            return True
        for step in (sign * 2.0**double for double in range(_FAR) for sign in (1.0, -1.0)):
            try:
                self.transform.inverse([at + step * by for at, by in zip(present, way, strict=True)])
            except ValueError:
                continue
            return step > 0.0
        return False

    def rates(self, coordinates: Sequence[float], wanted: Sequence[float]) -> tuple[list[float], float]:
        """Return the joints' velocities, and the part of the wanted rates that they are: 1 unless one is too fast."""
        rates = list(self.transform.joint_rates(coordinates, wanted))
        ways = [abs(rate) / joint.velocity for rate, joint in zip(rates, self.joints, strict=True)]
        share = 1.0 / max(1.0, *ways)
        most = [joint.velocity for joint in self.joints]  # what rounding leaves above it would be refused
        return [min(max(rate * share, -top), top) for rate, top in zip(rates, most, strict=True)], share
