"""Say what a grasp is like from where each finger feels its contact: normals, contact points, friction angles.

A finger's sensor tells the place of contact in the finger's own angle, phi_c.  With a = th + phi_c the normal, out of
the finger, is (cos a, sin a) and the contact lies rb along it from the finger's centre (4.1, 4.2).  The friction angle
eta is the direction to the OTHER contact less a (4.3): counted the other way round the regrasps turn the wrong way and
both rolling laws diverge.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum

from sioms.hand.kinematics import Hand, wrap

FINGER_M = 12.7e-3
LEAST_FRICTION = 1.4  # of HSII rubber, over all indenters: table 4.2


@dataclass(frozen=True, slots=True)
class Grasp:
    """Two contacts; immutable.

    Args:
        normal1, normal2: a, direction out of each finger at its contact [rad].
        contact1, contact2: places of contact [m, m].
        eta1, eta2: friction angles [rad], within (-pi, pi].
        apart_m: distance L of the contacts.
        direction: of the line from contact 1 to contact 2 [rad].
    """

    normal1: float
    normal2: float
    contact1: tuple[float, float]
    contact2: tuple[float, float]
    eta1: float
    eta2: float
    apart_m: float
    direction: float

    @property
    def quality(self) -> float:
        """Return max |eta| [rad]: 0 for a parallel grasp."""
        return max(abs(self.eta1), abs(self.eta2))

    def holds(self, friction: float = LEAST_FRICTION) -> bool:
        """Return whether both lines of force lie within the friction cone: no contact slides."""
        return self.quality < math.atan(friction)


def grasp(joints: Sequence[float], places: Sequence[float], hand: Hand, finger_m: float = FINGER_M) -> Grasp:
    """Return the grasp of fingers at `joints` that feel contacts at `places` (phi_c) [rad].

    Raises:
        ValueError: the two contacts coincide.
    """
    x1, y1, th1, x2, y2, th2 = joints
    first = (x1 + hand.link1_m * math.cos(th1), y1 + hand.link1_m * math.sin(th1))
    second = (x2 + hand.link2_m * math.cos(th2), y2 + hand.link2_m * math.sin(th2))
    return grasp_of(first, second, th1 + places[0], th2 + places[1], finger_m)


def grasp_of(
    finger1: Sequence[float], finger2: Sequence[float], normal1: float, normal2: float, finger_m: float = FINGER_M
) -> Grasp:
    """Return the grasp of fingers with centres [m, m] and contact normals [rad].

    Raises:
        ValueError: the two contacts coincide.
    """
    c1 = (finger1[0] + finger_m * math.cos(normal1), finger1[1] + finger_m * math.sin(normal1))
    c2 = (finger2[0] + finger_m * math.cos(normal2), finger2[1] + finger_m * math.sin(normal2))
    apart = math.hypot(c2[0] - c1[0], c2[1] - c1[1])
    if not apart > 0.0:
        raise ValueError(f"describe grasp: both contacts are at {c1[0]:g}, {c1[1]:g} m; want an object between them")
    direction = math.atan2(c2[1] - c1[1], c2[0] - c1[0])
    return Grasp(
        normal1,
        normal2,
        c1,
        c2,
        wrap(direction - normal1),
        wrap(direction + math.pi - normal2),
        apart,
        direction,
    )


def friction_angle_deviation(apart_m: float, place_rad: float, finger_m: float = FINGER_M) -> float:
    """Return the standard deviation of a friction angle [rad] for places of contact known to `place_rad` each.

    A place moves its own normal by as much, and the line through the contacts by rb/L times the share across it.
    """
    across = finger_m / apart_m
    return place_rad * math.hypot(1.0 + across, across)


class Likeness(Enum):
    """How an object answers rolling and regrasping."""

    DISK = "disk"
    RECTANGLE = "rectangle"
    PARALLEL = "parallel"


def classify(eta1: float, eta2: float, deviation: float) -> Likeness:
    """Tell a disk-like from a rectangle-like object by its friction angles' signs, opposite or equal.

    Args:
        eta1, eta2: friction angles [rad].
        deviation: their standard deviation [rad]; within 3 of 0 the grasp counts as parallel: roll first.
    """
    if min(abs(eta1), abs(eta2)) <= 3.0 * deviation:
        return Likeness.PARALLEL
    return Likeness.RECTANGLE if (eta1 > 0.0) == (eta2 > 0.0) else Likeness.DISK
