"""An arm of two links in a plane, with a lift and a wrist: the joints of a SCARA."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

Four = tuple[float, float, float, float]


@dataclass(frozen=True, slots=True)
class Arm:
    """Joints (shoulder, elbow [rad], lift [m], wrist [rad]).  Coordinates (x, y, z [m], angle [rad]) of the tool.

    All angles are anti-clockwise, the elbow's from the upper arm, the wrist's from the forearm; z is the lift's own.
    x and y are of the wrist's axis, from the shoulder's; angle is the tool's against x. One side of the elbow is one
    arm: (x, y) has two postures, and neither is reached from the other without passing a singular one.

    Args:
        upper_m, fore_m: lengths of both links, > 0.
        elbow_left: whether the elbow's angle is positive.
        bend_rad: least angle by which the elbow must be away from stretched and from folded, above 0 and below pi/2.
            Nearer to these, one direction in the plane asks for joints without bound.
        facing_rad: the middle of the shoulder's travel, which is less than a turn.
    """

    upper_m: float
    fore_m: float
    elbow_left: bool = True
    bend_rad: float = 0.1
    facing_rad: float = 0.0

    def __post_init__(self) -> None:
        for name in ("upper_m", "fore_m"):
            if not 1e-3 <= getattr(self, name) <= 1e3:
                raise ValueError(f"describe arm: {name} {getattr(self, name):g}; want 0.001 to 1000")
        if not 1e-6 <= self.bend_rad < 0.5 * math.pi:
            raise ValueError(f"describe arm: bend_rad {self.bend_rad:g}; want 1e-6 or more and below pi/2")
        if not abs(self.facing_rad) <= math.tau:
            raise ValueError(f"describe arm: facing_rad {self.facing_rad}; want an angle within 2 pi")

    def forward(self, joints: Sequence[float]) -> Four:
        """Return (x, y, z, angle) of joints.

        Raises:
            ValueError: the elbow is bent to the other side.
        """
        shoulder, elbow, lift, wrist = joints
        if not self._sign * math.sin(elbow) >= 0.0:
            right, wrong = ("left", "right") if self.elbow_left else ("right", "left")
            raise ValueError(
                f"the elbow is at {elbow:.4g} rad, bent to the {wrong}; want it on the {right}, as configured"
            )
        outer = shoulder + elbow
        return (
            self.upper_m * math.cos(shoulder) + self.fore_m * math.cos(outer),
            self.upper_m * math.sin(shoulder) + self.fore_m * math.sin(outer), lift, outer + wrist,
        )  # fmt: skip

    def inverse(self, coordinates: Sequence[float]) -> Four:
        """Return the joints of (x, y, z, angle).

        Raises:
            ValueError: (x, y) is out of reach, or so near its edge that the arm is stretched or folded.

        Example:
            >>> shoulder, elbow, lift, wrist = Arm(0.3, 0.3).inverse((0.3, 0.3, 0.1, 0.0))
            >>> round(shoulder, 9), round(elbow, 6), lift, round(wrist, 6)
            (0.0, 1.570796, 0.1, -1.570796)
        """
        x, y, lift, angle = coordinates
        (least, most), distance = self.span_m, math.hypot(x, y)
        if not least <= distance <= most:
            raise ValueError(
                f"({x:.6g}, {y:.6g}) m is {distance:.6g} m from the shoulder; want {least:.6g} to {most:.6g} m, where "
                f"the elbow is at least {self.bend_rad:g} rad away from folded and from stretched"
            )
        shoulder, elbow = self._posture(x, y, distance)
        return shoulder, elbow, lift, angle - shoulder - elbow

    def joint_rates(self, coordinates: Sequence[float], rates: Sequence[float]) -> Four:
        """Return the joints' velocities.

        A posture nearer to a singular one than `bend_rad` counts as that far from it, which bounds its rates.
        """
        (x, y, *_), (vx, vy, lift, turn), (least, most) = coordinates, rates, self.span_m
        shoulder, elbow = self._posture(x, y, min(max(math.hypot(x, y), least), most))
        outer = shoulder + elbow
        size = self.upper_m * math.sin(elbow)
        shoulder_rate = (vx * math.cos(outer) + vy * math.sin(outer)) / size
        along = vx * math.cos(shoulder) + vy * math.sin(shoulder)
        outer_rate = -along / (self.fore_m * math.sin(elbow))
        return shoulder_rate, outer_rate - shoulder_rate, lift, turn - outer_rate

    @property
    def _sign(self) -> float:
        return 1.0 if self.elbow_left else -1.0

    @property
    def span_m(self) -> tuple[float, float]:
        """Least and largest distance of the wrist's axis from the shoulder's [m]."""
        squares, twice = self.upper_m**2 + self.fore_m**2, 2.0 * self.upper_m * self.fore_m * math.cos(self.bend_rad)
        return math.sqrt(squares - twice), math.sqrt(squares + twice)

    def _bent(self, distance_m: float) -> float:
        """Return the elbow's angle at a distance within the span [rad]."""
        level = (distance_m**2 - self.upper_m**2 - self.fore_m**2) / (2.0 * self.upper_m * self.fore_m)
        return self._sign * math.acos(min(max(level, -1.0), 1.0))

    def _posture(self, x: float, y: float, distance_m: float) -> tuple[float, float]:
        """Return the angles of shoulder and elbow that put the wrist at a distance, towards (x, y)."""
        elbow = self._bent(distance_m)
        outer_m, inner_m = self.fore_m * math.sin(elbow), self.upper_m + self.fore_m * math.cos(elbow)
        towards = math.atan2(y, x) - math.atan2(outer_m, inner_m)
        return self.facing_rad + math.remainder(towards - self.facing_rad, math.tau), elbow
