"""Objects between the fingers at a stated friction angle."""

from __future__ import annotations

import math
from dataclasses import dataclass

from sioms.hand.contacts import FINGER_M, Likeness
from sioms.hand.plane import PlaneHand, Rig
from sioms.hand.regrasp import NEUTRAL
from sioms.plant.outline import Outline, disk, rectangle
from sioms.plant.planar import Body, Mount

_SPARE_M = 12e-3  # of a side beyond its contacts: half a contact's width, and what a regrasp misses by


@dataclass(frozen=True, slots=True)
class Start:
    """An object between two fingers on the x axis, and its true friction angle when both touch; immutable.

    Args:
        likeness: disk or rectangle.
        size_m: radius of the disk, width of the rectangle between the sides that are touched.
        eta: friction angle at finger 1 [rad]; that at finger 2 is opposite for a disk and equal for a rectangle.
    """

    likeness: Likeness
    size_m: float
    eta: float

    @property
    def outline(self) -> Outline:
        """Return the object; a rectangle is long enough for contacts at this friction angle."""
        if self.likeness is Likeness.DISK:
            return disk(self.size_m)
        long = max(self.size_m * math.tan(abs(self.eta)) + 2.0 * _SPARE_M, self.size_m)
        return rectangle(self.size_m, long, min(1e-3, 0.1 * self.size_m))

    @property
    def pose(self) -> tuple[float, float, float]:
        """Return where the object lies: x, y [m], angle [rad]."""
        if self.likeness is Likeness.DISK:  # 4.3: the normals meet in its centre
            return 0.0, (self.size_m + FINGER_M) * math.sin(-self.eta), 0.0
        return 0.0, 0.0, self.tilt

    @property
    def tilt(self) -> float:
        """Return the direction tau of a rectangle's normal [rad]: tan eta = -d sin tau/w, d cos tau = w + 2 rb."""
        return math.atan(-self.size_m * math.tan(self.eta) / (self.size_m + 2.0 * FINGER_M))

    @property
    def distance_m(self) -> float:
        """Return d when both fingers touch [m]."""
        if self.likeness is Likeness.DISK:
            return 2.0 * (self.size_m + FINGER_M) * math.cos(self.eta)
        return (self.size_m + 2.0 * FINGER_M) / math.cos(self.tilt)

    @property
    def travel(self) -> float:
        """Return by how much the place of contact moves on each finger until the grasp is parallel [rad]."""
        if self.likeness is Likeness.DISK:
            return abs(self.eta) * self.size_m / FINGER_M
        return 0.5 * self.size_m * math.tan(abs(self.eta)) / FINGER_M

    def plane(
        self, rig: Rig, mount: Mount, seed: int, phi: tuple[float, float] = (NEUTRAL, NEUTRAL), mass: float = 0.1
    ) -> PlaneHand:
        """Return a hand about it, open by 20 mm, at places phi of the links [rad]; `mass` of the object [kg]."""
        first = (0.0, 0.0, 0.0, self.distance_m + 20e-3, *phi)
        return PlaneHand(Body(self.outline, mass), self.pose, rig, mount, seed, first)
