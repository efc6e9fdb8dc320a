"""Where an object that stays where it is can be held parallel, by touches all round it: places and normals alone.

A touch so light that the object does not move tells where it is and its normal, no curvature. Two guesses of the
outline go through all touches: sides that meet in corners of one radius, and a smooth outline (`shape.Shape`). Each
guess says where fingers that come along a line meet the object; that which has been right more often is believed.

    around = Around(touches)
    one = around.next(direction)   # touch there next; where both normals fit it is held parallel there
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sioms.hand.contacts import FINGER_M
from sioms.hand.shape import Parallel, Shape, Touch, clipped

Array = NDArray[np.float64]

USUAL_M, MOST_M = 1.5e-3, 4e-3
"""Radius of corners that nobody knows, and the largest that is taken for one of a corner [m]."""
_BOX = 4.0  # distance of what bounds the object where nobody has been, in its size
_SAME_RAD, _SAME_M = math.radians(0.7), 0.12e-3
_CORNER_RAD = math.radians(5.0)
_AGREE_M = 0.15e-3
_AGAIN_RAD, _AGAIN_M = math.radians(0.35), 0.15e-3
_WRONG_RAD = math.radians(15.0)  # more than that is as wrong
_TURN_M = 2e-3  # of doubt, for each radian of turning
_UNKNOWN_M = 20e-3
_END_M, _EDGE_M = 2e-3, 4e-3
"""How near the end of a side a squeezed finger feels what is beyond it, and how much doubt that is worth."""
_ASIDE, _MEETS_M = 0.25, 6e-3  # of what was touched, along a line; a finger that is farther from it may pass
_MOVED_M = 0.25e-3


@dataclass(frozen=True, slots=True)
class Sides:
    """An outline of straight sides with corners of one radius; immutable.

    Args:
        corners: centres of the corners [m, m], anti-clockwise.
        owners: of the side that begins at each corner, numbers of the touches on it; empty where nobody has been.
        normals: of these sides, outward [rad].
        corner_m: radius of all corners.
        points: of all touches, moved in by that radius.
    """

    corners: Array
    owners: tuple[tuple[int, ...], ...]
    normals: tuple[float, ...]
    corner_m: float
    points: Array


def sides_through(touches: Sequence[Touch]) -> Sides:
    """Return the outline of straight sides that touches bound."""
    radius = _corner_radius(touches)
    points = np.array([touch.point for touch in touches])
    normals = np.array([touch.normal for touch in touches])
    out = np.stack([np.cos(normals), np.sin(normals)], axis=1)
    inner = points - radius * out
    middle = inner.mean(axis=0)
    reach = _BOX * max(float(np.hypot(*(inner - middle).T).max()), 5e-3)
    corners = [middle + reach * np.array(at) for at in ((-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0))]
    owners: list[int] = [-1] * 4
    groups = _grouped(inner, normals)
    lines = []
    for number, group in enumerate(groups):
        at, angle = _line(inner, normals, group)
        lines.append((group, angle))
        side = Touch((float(at[0]), float(at[1])), angle, math.inf, math.inf)
        left = clipped(corners, owners, number, side)
        if left[0]:  # else it contradicts the others: the object was moved, or is thinner than its corners are thought
            corners, owners = left
    named, angles = [], []
    for i, owner in enumerate(owners):
        along = corners[(i + 1) % len(corners)] - corners[i]
        named.append(lines[owner][0] if owner >= 0 else ())
        angles.append(lines[owner][1] if owner >= 0 else math.atan2(-along[0], along[1]))
    return Sides(np.array(corners), tuple(named), tuple(angles), radius, inner)


def _corner_radius(touches: Sequence[Touch]) -> float:
    """Return the radius that makes most pairs of touches on one corner agree."""
    found = []
    for i, one in enumerate(touches):
        for other in touches[:i]:
            dx, dy = one.point[0] - other.point[0], one.point[1] - other.point[1]
            ex, ey = math.cos(one.normal) - math.cos(other.normal), math.sin(one.normal) - math.sin(other.normal)
            square = ex * ex + ey * ey
            if square < _CORNER_RAD**2:
                continue
            radius = (dx * ex + dy * ey) / square
            if -_AGREE_M < radius <= MOST_M and math.hypot(dx - radius * ex, dy - radius * ey) < _AGREE_M:
                found.append(max(radius, 0.0))
    return float(np.median(found)) if found else USUAL_M


def _grouped(points: Array, normals: Array) -> list[tuple[int, ...]]:
    """Return which touches are on one side."""
    groups: list[list[int]] = []
    for i, (point, normal) in enumerate(zip(points, normals, strict=True)):
        for group in groups:
            first = group[0]
            off = point - points[first]
            middle = 0.5 * (normal + normals[first])
            if abs(math.remainder(normal - normals[first], math.tau)) < _SAME_RAD and (
                abs(off[0] * math.cos(middle) + off[1] * math.sin(middle)) < _SAME_M
            ):
                group.append(i)
                break
        else:
            groups.append([i])
    return [tuple(group) for group in groups]


def _line(points: Array, normals: Array, group: Sequence[int]) -> tuple[Array, float]:
    """Return a place on a side and its normal."""
    first = normals[group[0]]
    angle = first + float(np.mean([math.remainder(normals[i] - first, math.tau) for i in group]))
    return points[list(group)].mean(axis=0), angle


def met(corners: Array, radius_m: float, origin: Array, angle: float) -> float | None:
    """Return the outward normal [rad] where a round finger meets a convex outline along a line; None where it passes.

    Args:
        corners: of the outline, anti-clockwise [m].
        radius_m: of the finger.
        origin: of the line.
        angle: from where the finger comes [rad].
    """
    u = np.array([math.cos(angle), math.sin(angle)])
    along = np.roll(corners, -1, axis=0) - corners
    length = np.hypot(*along.T)
    normal = np.stack([along[:, 1], -along[:, 0]], axis=1) / np.maximum(length, 1e-12)[:, None]
    best, found = -math.inf, None
    off = corners + radius_m * normal - origin
    with np.errstate(divide="ignore", invalid="ignore"):
        across = along[:, 0] * u[1] - along[:, 1] * u[0]
        at = (along[:, 0] * off[:, 1] - along[:, 1] * off[:, 0]) / across
        share = (u[0] * off[:, 1] - u[1] * off[:, 0]) / across
    for i in np.flatnonzero((share >= 0.0) & (share <= 1.0) & np.isfinite(at)).tolist():
        if at[i] > best:
            best, found = float(at[i]), math.atan2(normal[i, 1], normal[i, 0])
    away = origin - corners
    middle = away @ u
    square = middle**2 - np.sum(away * away, axis=1) + radius_m**2
    for i in np.flatnonzero(square >= 0.0).tolist():
        out = float(-middle[i] + math.sqrt(square[i]))
        if out > best:
            best = out
            dx, dy = (origin + out * u - corners[i]).tolist()
            found = math.atan2(dy, dx)
    return found


class Spare(NamedTuple):
    """How far a touch is from the end of the side that it is on.

    Args:
        room_m: infinite for a touch on no side.
        way: along the side [m, m], of length 1, where it is not known farther than that; None where it ends.
    """

    room_m: float
    way: tuple[float, float] | None


class Around:
    """What touches all round an object let expect.

    Attributes:
        smooth: whether a smooth outline has been right more often than one of straight sides.
    """

    def __init__(self) -> None:
        self._touches: list[Touch] = []
        self._tried: list[tuple[float, float, float]] = []
        self._wrong = [0.0, 0.0]
        self._aside = _ASIDE
        self.smooth = False

    @property
    def size_m(self) -> float:
        """Return how far apart touches lie, at most about [m]."""
        points = [touch.point for touch in self._touches]
        return float(np.hypot(*np.ptp(points, axis=0))) if points else 0.0

    def missed(self, x: float, y: float, psi: float) -> None:
        """Take note of a line along which a finger met nothing."""
        self.tried(x, y, psi)
        self._aside *= 0.5

    def tried(self, x: float, y: float, psi: float) -> None:
        """Take note of a line that is not to be tried again."""
        self._tried.append((x, y, psi))

    def add(self, touches: Sequence[Touch], x: float, y: float, psi: float) -> None:
        """Add what fingers 1 and 2 felt that came along a line."""
        origin = np.array([x, y])
        if len(self._touches) >= 2:
            guesses = (self._sides_outline(), self._smooth_outline())
            for i, (corners, radius) in enumerate(guesses):
                for touch in touches:
                    side = psi if math.cos(touch.normal - psi) > 0.0 else psi + math.pi
                    guess = met(corners, radius, origin, side)
                    off = math.pi if guess is None else abs(math.remainder(guess - touch.normal, math.tau))
                    self._wrong[i] = 0.8 * self._wrong[i] + min(off, _WRONG_RAD)
        for touch in touches:  # also of the first of them, if that has moved the object
            self._touches = [old for old in self._touches if not _contradict(old, touch)] + [touch]
        self.tried(x, y, psi)
        self.smooth = self._wrong[1] < self._wrong[0]

    def spare(self, touches: Sequence[Touch]) -> Spare:
        """Return how far added touches lie from the nearest end of a side that they are on.

        Where nobody has met what ends a side, it is known no farther than it was touched.
        """
        found = Spare(math.inf, None)
        if self.smooth:
            return found
        sides, count = sides_through(self._touches), len(self._touches)
        for number, touch in enumerate(self._touches):
            for first, owners in enumerate(sides.owners):
                last = (first + 1) % len(sides.corners)
                along = sides.corners[last] - sides.corners[first]
                length = math.hypot(*along)
                if number not in owners or length <= _END_M or all(touch is not one for one in touches):
                    continue
                way = along / length
                at = [float((sides.points[i] - sides.corners[first]) @ way) for i in range(count)]
                for sign, end, beyond in ((-1.0, at[number], sides.owners[first - 1]), (
                    1.0, length - at[number], sides.owners[last]
                )):  # fmt: skip
                    felt = max(sign * (at[i] - at[number]) for i in owners)
                    room = max(end, 0.0) if beyond else felt
                    if room < found.room_m:
                        found = Spare(room, None if beyond else (sign * float(way[0]), sign * float(way[1])))
        return found

    def _sides_outline(self) -> tuple[Array, float]:
        sides = sides_through(self._touches)
        return sides.corners, FINGER_M + sides.corner_m

    def _smooth_outline(self) -> tuple[Array, float]:
        return Shape(self._touches).outline(), FINGER_M

    def next(self, direction: float, least_m: float = 0.0) -> Parallel | None:
        """Return where it would be held parallel next, nearest to a direction [rad]; None where no guess is left.

        Args:
            direction: of the hand.
            least_m: one that is narrower is returned only where no other is left.
        """
        if not self._touches:
            return None
        ways, narrow = [self._smooth, self._sided], None
        for way in ways if self.smooth else reversed(ways):
            for one in map(self._within, way(direction)):
                if not self._has_tried(one):
                    if one.apart_m >= least_m:
                        return one
                    narrow = narrow or one
        return narrow

    def _within(self, one: Parallel) -> Parallel:
        """Return a grasp so far aside at most that both fingers surely meet the object."""
        points = np.array([touch.point for touch in self._touches])
        c, s = math.cos(one.direction), math.sin(one.direction)
        at, aside = np.array([one.x, one.y]), min(self._aside * self.size_m, _MEETS_M)
        for way, more in ((np.array([-s, c]), aside), (np.array([c, s]), 0.0)):
            there, along = float(at @ way), points @ way
            at = at + (min(max(there, float(along.min()) - more), float(along.max()) + more) - there) * way
        return replace(one, x=float(at[0]), y=float(at[1]))

    def _has_tried(self, one: Parallel) -> bool:
        for x, y, psi in self._tried:
            turn = math.remainder(one.direction - psi, math.pi)
            aside = (one.y - y) * math.cos(psi) - (one.x - x) * math.sin(psi)
            if abs(turn) < _AGAIN_RAD and abs(aside) < _AGAIN_M:
                return True
        return False

    def _smooth(self, direction: float) -> list[Parallel]:
        return Shape(self._touches).parallels(direction)

    def _sided(self, direction: float) -> list[Parallel]:
        sides = sides_through(self._touches)
        found = [*_across(sides, direction), *_between(sides, direction)]
        return [one for _, one in sorted(found, key=lambda pair: pair[0])]


def _contradict(one: Touch, other: Touch) -> bool:
    """Return whether no convex object has both touches: one of them lies beyond the tangent of the other."""
    dx, dy = one.point[0] - other.point[0], one.point[1] - other.point[1]
    beyond = dx * math.cos(other.normal) + dy * math.sin(other.normal)
    before = -dx * math.cos(one.normal) - dy * math.sin(one.normal)
    return max(beyond, before) > _MOVED_M


def _aligned(psi: float, direction: float) -> float:
    return psi if math.cos(psi - direction) >= 0.0 else psi + math.pi


def _reached(sides: Sides, corner: int, t: Array) -> float:
    """Return how far aside along t the outline may support, for all that is known, from a corner [m]."""
    most = 0.0
    for side in (corner, corner - 1):
        owners = sides.owners[side]
        if not owners:
            return _UNKNOWN_M
        most = max(most, min(abs(float(t @ (sides.points[i] - sides.corners[corner]))) for i in owners))
    return most


def _across(sides: Sides, direction: float) -> list[tuple[float, Parallel]]:
    """Return grasps on a side and what lies opposite, each with how doubtful it is [m]."""
    found, count = [], len(sides.corners)
    for i in range(count):
        if not sides.owners[i]:
            continue
        angle = sides.normals[i]
        n = np.array([math.cos(angle), math.sin(angle)])
        t = np.array([-n[1], n[0]])
        depth = (sides.corners[i] - sides.corners) @ n
        far = int(np.argmax(depth))
        low, high = sorted(float(t @ sides.corners[j % count]) for j in (i, i + 1))
        at = float(t @ sides.corners[far])
        doubt = _reached(sides, far, t)
        for j in (far - 1, far):  # a side that is parallel to it: anywhere in common
            if abs(math.remainder(sides.normals[j] - angle - math.pi, math.tau)) < _SAME_RAD and sides.owners[j]:
                first, last = sorted(float(t @ sides.corners[k % count]) for k in (j, j + 1))
                own = [float(t @ sides.points[k]) for k in (*sides.owners[i], *sides.owners[j])]
                if max(low, first) < min(high, last):
                    common = max(low, first), min(high, last)
                    spare = min(_END_M, 0.5 * (common[1] - common[0]))
                    at = min(max(float(np.mean(own)), common[0] + spare), common[1] - spare)
                    doubt = 0.0
        if not low < at < high:
            continue
        own = sorted(float(t @ sides.points[k]) for k in sides.owners[i])
        beyond = max(own[0] - at, at - own[-1], 0.0)
        doubt += 0.5 * beyond if len(own) > 1 else min(beyond, 0.5 * beyond + 1e-3)
        doubt += _EDGE_M * max(1.0 - min(at - low, high - at) / _END_M, 0.0)
        psi = _aligned(angle, direction)
        turn = abs(math.remainder(psi - direction, math.tau))
        x, y = sides.corners[i] + (at - float(t @ sides.corners[i])) * t - 0.5 * depth[far] * n
        one = Parallel(float(x), float(y), psi, float(depth[far]) + 2.0 * sides.corner_m, 0.0)
        found.append((doubt + _TURN_M * turn, one))
    return found


def _between(sides: Sides, direction: float) -> list[tuple[float, Parallel]]:
    """Return grasps on two corners, each with how doubtful it is [m]."""
    found, count = [], len(sides.corners)
    for i in range(count):
        for j in range(i):
            dx, dy = (sides.corners[i] - sides.corners[j]).tolist()
            apart = math.hypot(dx, dy)
            if apart < 5e-3:
                continue
            angle = math.atan2(dy, dx)
            if not (_has(sides, i, angle) and _has(sides, j, angle + math.pi)):
                continue
            t = np.array([-dy, dx]) / apart
            doubt = _reached(sides, i, t) + _reached(sides, j, t)
            psi = _aligned(angle, direction)
            turn = abs(math.remainder(psi - direction, math.tau))
            x, y = 0.5 * (sides.corners[i] + sides.corners[j])
            found.append((doubt + _TURN_M * turn, Parallel(float(x), float(y), psi, apart + 2.0 * sides.corner_m, 0.0)))
    return found


def _has(sides: Sides, corner: int, angle: float) -> bool:
    first, last = sides.normals[corner - 1], sides.normals[corner]
    return (angle - first) % math.tau <= (last - first) % math.tau
