"""Where the fingers go for a parallel grasp, from two contacts alone.

A disk (and what answers like one) is opened, turned on to the line of its present contacts and shifted on to its
centre (4.4 to 4.8); a rectangle is taken across the middle of its contacts, along its normal.
"""

from __future__ import annotations

import math

from sioms.hand.contacts import FINGER_M, Grasp
from sioms.hand.kinematics import Six, wrap

NEUTRAL = 0.5 * math.pi  # finger angle at which the link is across the line of contacts and its soft axis takes force
_FLAT = 1e-3  # 1/m: flatter than this is a side
_BESIDE, _CORNER_M = 2.0, 1.5e-3  # how far beside, in friction angles, and the radius of a corner


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


def regrasp_convex(grasp: Grasp, curvatures: tuple[float, float], finger_m: float = FINGER_M) -> Six:
    """Return hand coordinates of the parallel grasp of two arcs: those that touch with these curvatures now.

    The line through both centres of curvature is a double normal of the two arcs. Of a disk the centres coincide, of a
    rectangle they are infinitely far away: there `regrasp_disk` and `regrasp_rectangle` know better.

    Args:
        grasp: the present one.
        curvatures: 1/rc at contact 1 and 2 [1/m]; 0 for a side, infinite for a corner.
        finger_m: rb.
    """
    bend1, bend2 = (max(bend, _FLAT) for bend in curvatures)
    middles = []
    for (x, y), normal, bend in ((grasp.contact1, grasp.normal1, bend1), (grasp.contact2, grasp.normal2, bend2)):
        middles.append((x + math.cos(normal) / bend, y + math.sin(normal) / bend))
    (x1, y1), (x2, y2) = middles
    psi = math.atan2(y2 - y1, x2 - x1)
    if math.cos(psi - grasp.direction) < 0.0:
        psi = wrap(psi + math.pi)
    ux, uy = math.cos(psi), math.sin(psi)
    fx, fy, gx, gy = x1 - ux / bend1, y1 - uy / bend1, x2 + ux / bend2, y2 + uy / bend2
    apart = (gx - fx) * ux + (gy - fy) * uy
    return 0.5 * (fx + gx), 0.5 * (fy + gy), psi, apart + 2.0 * finger_m, NEUTRAL, NEUTRAL


def beside(grasp: Grasp, curvatures: tuple[float, float], finger_m: float = FINGER_M) -> Six:
    """Return hand coordinates of the parallel grasp of two arcs, no farther away than its friction angles tell.

    For a grasp that touches have shown to be parallel and that is not when it is squeezed: a finger on a corner feels
    the side beside it. The arcs are those of there; where they lead far away they are not true.

    Args:
        grasp: the present one.
        curvatures: as of `regrasp_convex`.
        finger_m: rb.
    """
    x, y, psi, d, _, _ = regrasp_convex(grasp, curvatures, finger_m)
    x0, y0 = (0.5 * (a + b) for a, b in zip(grasp.contact1, grasp.contact2, strict=True))
    s, c = math.sin(grasp.direction), math.cos(grasp.direction)
    shift, turn = (y - y0) * c - (x - x0) * s, wrap(psi - grasp.direction)
    most = _BESIDE * grasp.quality
    share = min(1.0, most * (finger_m + _CORNER_M) / max(abs(shift), 1e-9), most / max(abs(turn), 1e-9))
    psi = wrap(grasp.direction + share * turn)
    return x0 - share * shift * s, y0 + share * shift * c, psi, d, NEUTRAL, NEUTRAL
