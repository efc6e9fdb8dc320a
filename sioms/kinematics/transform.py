"""What a map between joints and coordinates is, and what follows from it alone."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol


class Transform(Protocol):
    """A map between joints and as many coordinates; immutable, plain floats, microseconds a call."""

    def forward(self, joints: Sequence[float]) -> Sequence[float]:
        """Return the coordinates of joints.

        Raises:
            ValueError: the coordinates mean nothing there, with a sentence.
        """

    def inverse(self, coordinates: Sequence[float], /) -> Sequence[float]:
        """Return the joints of coordinates.

        Raises:
            ValueError: no joints have these coordinates, or the map is singular there, with a sentence.
        """

    def joint_rates(self, coordinates: Sequence[float], rates: Sequence[float], /) -> Sequence[float]:
        """Return the joints' velocities at coordinates that change at `rates`: the Jacobian times these."""


def forces(transform: Transform, coordinates: Sequence[float], joint_forces: Sequence[float]) -> list[float]:
    """Return the forces along coordinates [N, N m] that do the same work as those of the joints.

    Args:
        transform: the map.
        coordinates: where.
        joint_forces: force [N] or torque [N m] of each joint.
    """
    count = len(coordinates)
    unit = [0.0] * count
    found = []
    for column in range(count):
        unit[column] = 1.0
        rates = transform.joint_rates(coordinates, unit)
        unit[column] = 0.0
        found.append(sum(force * rate for force, rate in zip(joint_forces, rates, strict=True)))
    return found
