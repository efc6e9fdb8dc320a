"""Where the fingers go for a parallel grasp, from two contacts alone.

A disk (and what answers like one) is opened, turned on to the line of its present contacts and shifted on to its
centre (4.4 to 4.8); a rectangle is taken across the middle of its contacts, along its normal.
"""

from __future__ import annotations

import math

from sioms.hand.contacts import FINGER_M, Grasp
from sioms.hand.kinematics import Six, wrap

NEUTRAL = 0.5 * math.pi  # finger angle at which the link is across the line of contacts and its soft axis takes force


def disk_radii(grasp: Grasp) -> tuple[float, float]:
    """Return rc [m] by position, L = 2 rc cos eta, from each friction angle (4.8)."""
    return 0.5 * grasp.apart_m / math.cos(grasp.eta1), 0.5 * grasp.apart_m / math.cos(grasp.eta2)


def regrasp_disk(grasp: Grasp, radius_m: float, finger_m: float = FINGER_M) -> Six:
    """Return hand coordinates of the parallel grasp of a disk (4.4 to 4.7); d touches without squeezing.

    Args:
        grasp: the present one.
        radius_m: rc, by curvature or by `disk_radii`.
        finger_m: rb.
    """
    x = grasp.contact1[0] + radius_m * math.cos(grasp.normal1)
    y = grasp.contact1[1] + radius_m * math.sin(grasp.normal1)
    return x, y, grasp.direction, 2.0 * (radius_m + finger_m), NEUTRAL, NEUTRAL


def regrasp_rectangle(grasp: Grasp, finger_m: float = FINGER_M) -> Six:
    """Return hand coordinates of the parallel grasp of two parallel sides; d touches without squeezing.

    Both contacts tell the normal; their mean is used.
    """
    psi = grasp.normal1 + 0.5 * wrap(grasp.normal2 - math.pi - grasp.normal1)
    (x1, y1), (x2, y2) = grasp.contact1, grasp.contact2
    width = grasp.apart_m * math.cos(grasp.direction - psi)
    return 0.5 * (x1 + x2), 0.5 * (y1 + y2), wrap(psi), width + 2.0 * finger_m, NEUTRAL, NEUTRAL
