"""What touches tell of an outline that stays where it is: its support function, and where it can be held parallel.

h(theta) is how far the outline reaches in a direction. Where a finger touches with the outward normal theta, it tells
h = p.n, h' = p.t and, by the curvature, h + h'' = rho. Between the touches the outline is a random one: the radius of
curvature has independent harmonics that fall as 1/(k - 1)^2. So the estimate is linear, and has its uncertainty.

A parallel grasp in the direction psi has h'(psi) + h'(psi + pi) = 0.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sioms.hand.contacts import FINGER_M, Grasp
from sioms.hand.regrasp import regrasp_convex

Array = NDArray[np.float64]

HARMONICS = 24
ROUGH = 1.0
"""Standard deviation of the harmonics of the radius of curvature, in the size of the object, times (k - 1)^2."""
PLACE_M = 0.05e-3
"""Standard deviation of a touched place [m]."""
_GRID = np.radians(np.arange(-90.0, 90.0, 0.5))


@dataclass(frozen=True, slots=True)
class Touch:
    """Where a finger touched; immutable.

    Args:
        point: [m, m].
        normal: outward of the object [rad].
        radius_m: of curvature of the object.
        radius_deviation_m: its standard deviation; infinite where nothing is known of it.
    """

    point: tuple[float, float]
    normal: float
    radius_m: float
    radius_deviation_m: float


@dataclass(frozen=True, slots=True)
class Parallel:
    """A parallel grasp that is to be expected; immutable.

    Args:
        x, y: middle of the contacts [m].
        direction: from contact 1 to contact 2 [rad].
        apart_m: distance of the contacts.
        deviation: standard deviation of the friction angles there [rad].
        known: whether few touches are enough to know it: of an ellipse, or of two parallel sides.
    """

    x: float
    y: float
    direction: float
    apart_m: float
    deviation: float
    known: bool = False


class Shape:
    """An outline as far as touches tell.

    Args:
        touches: two or more.
    """

    def __init__(self, touches: Sequence[Touch]) -> None:
        points = np.array([touch.point for touch in touches])
        self._middle = points.mean(axis=0)
        spread = points - self._middle
        size = max(float(np.hypot(*spread.T).max()), 1e-3)
        angles = np.array([touch.normal for touch in touches])
        n = np.stack([np.cos(angles), np.sin(angles)], axis=1)
        t = np.stack([-np.sin(angles), np.cos(angles)], axis=1)
        rows = [_row(angles), _row(angles, 1)]
        told = [np.sum(spread * n, axis=1), np.sum(spread * t, axis=1)]
        noise = [np.full(len(angles), PLACE_M), np.full(len(angles), PLACE_M)]
        known = np.array([math.isfinite(touch.radius_deviation_m) for touch in touches])
        if known.any():
            rows.append(_row(angles[known]) + _row(angles[known], 2))
            told.append(np.array([touch.radius_m for touch in touches])[known])
            noise.append(np.array([touch.radius_deviation_m for touch in touches])[known])
        a, y, sd = np.concatenate(rows), np.concatenate(told), np.concatenate(noise)
        k = np.arange(2, HARMONICS + 1)
        fall = ROUGH * size / ((k - 1.0) ** 2 * (k**2 - 1.0))
        prior = np.concatenate([[size], [size, size], np.repeat(fall, 2)]) ** 2
        mean = np.zeros(len(prior))
        mean[0] = size
        gain = prior[:, None] * a.T
        inner = np.linalg.inv(a @ gain + np.diag(sd**2))
        self._c: Array = mean + gain @ (inner @ (y - a @ mean))
        self._p: Array = np.diag(prior) - gain @ inner @ gain.T

    def parallels(self, direction: float) -> list[Parallel]:
        """Return the parallel grasps within a right angle of a direction [rad], by the angle to it."""
        psi = direction + _GRID
        rows = _row(psi, 1) + _row(psi + math.pi, 1)
        lean = rows @ self._c
        found = []
        for i in np.flatnonzero(lean[:-1] * lean[1:] <= 0.0).tolist():
            share = lean[i] / (lean[i] - lean[i + 1]) if lean[i] != lean[i + 1] else 0.5
            found.append(self._at(psi[i] + share * (psi[i + 1] - psi[i])))
        return sorted(found, key=lambda one: abs(math.remainder(one.direction - direction, math.tau)))

    def outline(self) -> Array:
        """Return points of it [m], anti-clockwise, shape (n, 2)."""
        angles = np.radians(np.arange(0.0, 360.0, 2.0))
        h, slope = _row(angles) @ self._c, _row(angles, 1) @ self._c
        c, s = np.cos(angles), np.sin(angles)
        points: Array = np.stack([h * c - slope * s, h * s + slope * c], axis=1) + self._middle
        return points

    def _at(self, psi: float) -> Parallel:
        far, near = self._point(psi), self._point(psi + math.pi)
        row = _row(np.array([psi]), 1) + _row(np.array([psi + math.pi]), 1)
        apart = float(np.hypot(*(far - near)))
        x, y = 0.5 * (far + near) + self._middle
        deviation = math.sqrt(max(float((row @ self._p @ row.T).item()), 0.0)) / apart
        return Parallel(float(x), float(y), psi, apart, deviation)

    def _point(self, theta: float) -> Array:
        one = np.array([theta])
        h, slope = (_row(one) @ self._c).item(), (_row(one, 1) @ self._c).item()
        c, s = math.cos(theta), math.sin(theta)
        return np.array([h * c - slope * s, h * s + slope * c])


def _row(angles: Array, derivative: int = 0) -> Array:
    """Return the harmonics, or a derivative of them, at angles: 1, cos, sin, cos 2, ... (m, 1 + 2 HARMONICS)."""
    k = np.arange(1, HARMONICS + 1)
    turned = np.multiply.outer(angles, k) + 0.5 * math.pi * derivative
    out = np.empty((len(angles), 1 + 2 * HARMONICS))
    out[:, 0] = 0.0 if derivative else 1.0
    out[:, 1::2] = np.cos(turned) * k.astype(float) ** derivative
    out[:, 2::2] = np.sin(turned) * k.astype(float) ** derivative
    return out


class Oval:
    """An ellipse, by its support function about a middle: h = sqrt(p + q cos 2t + r sin 2t).

    Args:
        x, y: its middle [m].
        p, q, r: as above [m^2]; p > |(q, r)|.
    """

    def __init__(self, x: float, y: float, p: float, q: float, r: float) -> None:
        self.x, self.y, self.p, self.q, self.r = x, y, p, q, r

    def told(self, angle: float) -> tuple[float, float, float]:
        """Return h, h' about the origin and the radius of curvature [m] where the outward normal is `angle` [rad]."""
        c, s, c2, s2 = math.cos(angle), math.sin(angle), math.cos(2.0 * angle), math.sin(2.0 * angle)
        h = math.sqrt(self.p + self.q * c2 + self.r * s2)
        slope = (self.r * c2 - self.q * s2) / h
        squares = self.p**2 - self.q**2 - self.r**2
        return self.x * c + self.y * s + h, self.y * c - self.x * s + slope, squares / h**3

    def parallels(self, direction: float) -> list[Parallel]:
        """Return its two parallel grasps within a right angle of a direction [rad], by the angle to it."""
        axis = 0.5 * math.atan2(self.r, self.q)
        found = []
        for turn in (axis, axis + 0.5 * math.pi):
            psi = turn if math.cos(turn - direction) > 0.0 else turn + math.pi
            h = math.sqrt(self.p + self.q * math.cos(2.0 * psi) + self.r * math.sin(2.0 * psi))
            found.append(Parallel(self.x, self.y, psi, 2.0 * h, 0.0, True))
        return sorted(found, key=lambda one: abs(math.remainder(one.direction - direction, math.tau)))


def fitted_oval(touches: Sequence[Touch]) -> Oval | None:
    """Return the ellipse that agrees with all touches; None where none does.

    Two touches tell eight numbers, an ellipse has five. By Gauss and Newton, from the disk about the touches.
    """
    points = np.array([touch.point for touch in touches])
    middle = points.mean(axis=0)
    size = 0.5 * float(np.hypot(*np.ptp(points, axis=0)))
    radii = [touch for touch in touches if 0.0 < touch.radius_m < SIDE_M]
    if len(radii) < len(touches) or not size > 1e-3:
        return None
    scale = np.array([size, size, size**2, size**2, size**2])

    def off(at: Array) -> Array | None:
        x, y, p, q, r = (at * scale).tolist()
        if not p > 1.001 * math.hypot(q, r):
            return None
        oval, found = Oval(x, y, p, q, r), []
        for touch, (px, py) in zip(touches, (points - middle).tolist(), strict=True):
            c, s = math.cos(touch.normal), math.sin(touch.normal)
            h, slope, radius = oval.told(touch.normal)
            found += [(h - px * c - py * s) / PLACE_M, (slope + px * s - py * c) / PLACE_M]
            found.append((radius - touch.radius_m) / touch.radius_deviation_m)
        return np.array(found)

    at = np.array([0.0, 0.0, 1.0, 0.0, 0.0])
    now = off(at)
    for _ in range(_ROUNDS):
        if now is None:
            return None
        columns = [off(at + step) for step in 1e-6 * np.eye(5)]
        if any(column is None for column in columns):
            return None
        slopes = np.stack([(column - now) * 1e6 for column in columns if column is not None], axis=1)
        way = np.linalg.lstsq(slopes, -now, rcond=None)[0]
        after = None
        for share in (1.0, 0.5, 0.25, 0.1, 0.02):
            after = off(at + share * way)
            if after is not None and after @ after < now @ now:
                at, now = at + share * way, after
                break
        else:
            break
    if now is None or now @ now > _AGREES * (len(now) - 5):
        return None
    x, y, p, q, r = (at * scale).tolist()
    return Oval(x + float(middle[0]), y + float(middle[1]), p, q, r)


_ROUNDS = 40
_AGREES = 4.0  # chi-squared for each number that is told beyond five

SIDE_M, CORNER_M = 0.2, 4e-3
"""Radii of curvature from which on a touch is one of a straight side, and up to which it is one of a corner [m]."""
ROUND_M = 8e-3
"""Radius up to which a touch may be one of a corner that is felt together with a side [m]."""
_APART = math.radians(5.0)  # of the normals of two touches of one corner
_AGREE_M = 0.2e-3
_USUAL_M = 1.5e-3  # radius of a corner that nobody has touched
_ASIDE = 0.3
_PARALLEL = math.radians(1.0)
_ENDS = math.radians(10.0)  # by which the felt normal of a side that ends may be off, at most


def expected(touches: Sequence[Touch], held: Grasp) -> list[Parallel]:
    """Return the parallel grasps that are to be expected of an object, by the angle to the present grasp.

    Args:
        touches: all since the object has moved last, those of the present grasp at the end.
        held: the present grasp.
    """
    touches = with_corners(touches)
    if (between := _between_sides(touches, held.direction)) is not None:
        return [between]
    if (beside := _beside_ends(touches, held.direction)) is not None:
        return [beside]
    new = touches[-2:]
    sides = [touch.radius_m > SIDE_M for touch in new]
    if all(sides):
        return across_sides(touches, held.direction) or [_thicker(held)]
    if any(sides) or any(touch.radius_m < CORNER_M for touch in new):
        bends = [0.0 if side else 1.0 / touch.radius_m for side, touch in zip(sides, new, strict=True)]
        x, y, psi, d, _, _ = regrasp_convex(held, (bends[0], bends[1]))
        return [Parallel(x, y, psi, d - 2.0 * FINGER_M, math.inf)]
    if (oval := fitted_oval(touches)) is not None:
        return oval.parallels(held.direction)
    return Shape(touches).parallels(held.direction)


def with_corners(touches: Sequence[Touch]) -> list[Touch]:
    """Return the touches, of those on one corner the radius that makes them agree: p - r n is its centre for both.

    A touch near the end of a side feels a corner rounder than it is; two places and normals tell its radius better.
    """
    found = list(touches)
    for i, one in enumerate(found):
        for j, other in enumerate(found[:i]):
            dx, dy = one.point[0] - other.point[0], one.point[1] - other.point[1]
            ex, ey = math.cos(one.normal) - math.cos(other.normal), math.sin(one.normal) - math.sin(other.normal)
            square = ex * ex + ey * ey
            if max(one.radius_m, other.radius_m) > ROUND_M or square < _APART**2:
                continue
            radius = (dx * ex + dy * ey) / square
            if not 0.0 <= radius <= CORNER_M or math.hypot(dx - radius * ex, dy - radius * ey) > _AGREE_M:
                continue
            deviation = PLACE_M / math.sqrt(square)
            found[i] = replace(one, radius_m=max(radius, 1e-5), radius_deviation_m=deviation)
            found[j] = replace(other, radius_m=max(radius, 1e-5), radius_deviation_m=deviation)
    return found


def _between_sides(touches: Sequence[Touch], direction: float) -> Parallel | None:
    """Return the grasp across two parallel sides that have been touched, in the middle of where they were."""
    sides = [touch for touch in touches if touch.radius_m > SIDE_M]
    for i, one in enumerate(sides):
        for other in sides[i + 1 :]:
            tilt = math.remainder(other.normal - one.normal - math.pi, math.tau)
            if abs(tilt) > _PARALLEL:
                continue
            psi = one.normal + 0.5 * tilt
            if math.cos(psi - direction) < 0.0:
                psi += math.pi
            x, y = (0.5 * (a + b) for a, b in zip(one.point, other.point, strict=True))
            across = (one.point[0] - other.point[0]) * math.cos(psi) + (one.point[1] - other.point[1]) * math.sin(psi)
            return Parallel(x, y, psi, abs(across), 0.0, True)
    return None


def _beside_ends(touches: Sequence[Touch], direction: float) -> Parallel | None:
    """Return the grasp across a side that was touched before, where the present one meets the ends of two sides.

    Of a side that ends under a finger neither normal nor radius is felt. The side that is known tells the direction;
    the place is half the way back to where it was touched.
    """
    *past, one, two = touches
    if not all(CORNER_M < touch.radius_m < SIDE_M for touch in (one, two)):
        return None
    for side in reversed(past):
        off = [abs(math.sin(touch.normal - side.normal)) for touch in (one, two)]
        if side.radius_m <= SIDE_M or max(off) > math.sin(_ENDS):
            continue
        psi = side.normal if math.cos(side.normal - direction) > 0.0 else side.normal + math.pi
        c, s = math.cos(psi), math.sin(psi)
        x, y = (0.5 * (a + b) for a, b in zip(one.point, two.point, strict=True))
        back = 0.5 * ((side.point[1] - y) * c - (side.point[0] - x) * s)
        across = (two.point[0] - one.point[0]) * c + (two.point[1] - one.point[1]) * s
        return Parallel(x - back * s, y + back * c, psi, abs(across), math.inf)
    return None


def _thicker(held: Grasp) -> Parallel:
    """Return where a wedge of two sides is to be touched next: further towards its thick end."""
    wedge = math.remainder(held.normal2 + math.pi - held.normal1, math.tau)
    psi = held.normal1 + 0.5 * wedge
    aside = math.copysign(_ASIDE * held.apart_m, -wedge)
    x, y = (0.5 * (a + b) for a, b in zip(held.contact1, held.contact2, strict=True))
    return Parallel(x - aside * math.sin(psi), y + aside * math.cos(psi), psi, held.apart_m, math.inf)


def across_sides(touches: Sequence[Touch], direction: float) -> list[Parallel]:
    """Return the grasps across straight sides that have been touched, from the corner that lies opposite, or the
    parallel side, by the angle to a direction [rad].

    The sides bound the object; corners in which two of them meet are taken for its own, rounded as the sharpest that
    has been touched: all sides are moved in by that radius, so that they meet in the corners' centres.
    """
    rounded = min((touch.radius_m for touch in touches if touch.radius_m < CORNER_M), default=_USUAL_M)
    sides = [_inset(touch, rounded) for touch in touches if touch.radius_m > SIDE_M]
    points = np.array([touch.point for touch in touches])
    middle = points.mean(axis=0)
    reach = 4.0 * float(np.hypot(*(points - middle).T).max())
    # corners, anti-clockwise, and the side that follows each; -1 of the box about it all
    corners = [middle + reach * np.array(at) for at in ((-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0))]
    owners = [-1, -1, -1, -1]
    for number, side in enumerate(sides):
        corners, owners = clipped(corners, owners, number, side)
    found = []
    for i, owner in enumerate(owners):
        if owner < 0:
            continue
        side = sides[owner]
        n = np.array([math.cos(side.normal), math.sin(side.normal)])
        t = np.array([-n[1], n[0]])
        depth = [-float(n @ (corner - corners[i])) for corner in corners]
        far = int(np.argmax(depth))
        if owners[far] < 0 or owners[far - 1] < 0:
            continue  # nobody has been there
        ends = sorted(float(t @ corners[j % len(corners)]) for j in (i, i + 1))
        at = float(t @ corners[far])
        if not ends[0] < at < ends[1]:
            continue
        x, y = corners[far] + 0.5 * depth[far] * n
        psi = side.normal if math.cos(side.normal - direction) > 0.0 else side.normal + math.pi
        found.append(Parallel(float(x), float(y), psi, depth[far] + 2.0 * rounded, 0.0))
    return sorted(found, key=lambda one: abs(math.remainder(one.direction - direction, math.tau)))


def _inset(side: Touch, by_m: float) -> Touch:
    x, y = side.point
    return replace(side, point=(x - by_m * math.cos(side.normal), y - by_m * math.sin(side.normal)))


def clipped(corners: list[Array], owners: list[int], number: int, side: Touch) -> tuple[list[Array], list[int]]:
    """Cut off what lies beyond a side."""
    n = np.array([math.cos(side.normal), math.sin(side.normal)])
    over = [float(n @ (corner - np.array(side.point))) for corner in corners]
    kept: list[Array] = []
    of: list[int] = []
    for i, corner in enumerate(corners):
        j = (i + 1) % len(corners)
        if over[i] <= 0.0:
            kept.append(corner)
            of.append(owners[i])
        if (over[i] <= 0.0) != (over[j] <= 0.0):
            share = over[i] / (over[i] - over[j])
            kept.append(corner + share * (corners[j] - corner))
            of.append(number if over[i] <= 0.0 else owners[i])
    return kept, of
