"""What touches can know of a polygon: a bound for planners of regrasps.

A parallel grasp lies on two features of the outline: a side and the corner opposite to it, two corners, or two
parallel sides. Who has touched both can go there; who has not can only guess. So a planner with two regrasps makes the
second one where it has touched both features before: by the first touch and the first regrasp, which it chooses by what
the first touch showed. `bound` draws many objects and asks, for each, how often the best regrasp of those that look
alike has touched both, out of a grid of directions and shifts.

It flatters planners: it takes for granted that of several features the right pair is chosen, that each is recognised,
and, where ``inferred`` is asked for, that two sides that have been touched are known to be neighbours and their corner
with them. It says nothing of rolls, nor of a grasp that is parallel by luck.

Geometry of rigid round fingers alone, in the frame of the object.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sioms.hand.contacts import FINGER_M, Grasp, grasp_of
from sioms.hand.trials import SHAPES, Subject, draw
from sioms.plant.outline import Outline

Array = NDArray[np.float64]
#: A side or a corner, and its number; corner i follows side i.
Feature = tuple[str, int]

TURNS = np.radians(np.arange(-84.0, 85.0, 12.0))
"""Directions of the first regrasp against the touch before it [rad]."""
SHIFTS = (-0.5, -0.3, -0.15, 0.0, 0.15, 0.3, 0.5)
"""How far it is shifted aside, in distances of the contacts."""
_SIDE_M = 1.2e-3  # pieces of an outline that are longer are sides, the others approximate a corner
_PARALLEL, _EDGE = math.radians(0.5), 1e-6
_LIKE = 60  # first touches that count as alike


@dataclass(frozen=True, slots=True)
class Met:
    """A finger on the outline: how far out on its line it stands [m], on what, and the normal there [rad]."""

    at_m: float
    feature: Feature
    normal: float


class Polygon:
    """A polygon by its sides and rounded corners.

    Args:
        outline: of a polygon.

    Attributes:
        pairs: the features of each of its parallel grasps.
    """

    def __init__(self, outline: Outline) -> None:
        start = outline.points
        along = np.roll(start, -1, axis=0) - start
        size = np.hypot(*along.T)
        sides = np.flatnonzero(size > _SIDE_M)
        self._start, self._along = start[sides], along[sides]
        self._normal = np.stack([along[sides, 1], -along[sides, 0]], axis=1) / size[sides, None]
        self._angle = np.arctan2(self._normal[:, 1], self._normal[:, 0])
        following, ends = np.roll(self._normal, -1, axis=0), self._start + self._along
        between = self._normal - following
        gap = ends - np.roll(self._start, -1, axis=0)
        self._round = np.sum(gap * between, axis=1) / np.sum(between * between, axis=1)
        self._corner = ends - self._round[:, None] * self._normal
        self.pairs = tuple(self._parallels())

    def __len__(self) -> int:
        return len(self._angle)

    def _has(self, corner: int, angle: float) -> bool:
        """Return whether a corner has a normal that is not that of a side."""
        first, last = self._angle[corner], self._angle[(corner + 1) % len(self)]
        return bool(_EDGE < (angle - first) % math.tau < (last - first) % math.tau - _EDGE)

    def _parallels(self) -> list[tuple[Feature, Feature]]:
        found: list[tuple[Feature, Feature]] = []
        for i in range(len(self)):
            found += [(("side", i), ("corner", j)) for j in range(len(self)) if self._faces(i, j)]
            found += [(("side", i), ("side", j)) for j in range(i + 1, len(self)) if self._beside(i, j)]
            for j in range(i + 1, len(self)):
                dx, dy = (self._corner[i] - self._corner[j]).tolist()
                angle = math.atan2(dy, dx)
                if self._has(i, angle) and self._has(j, angle + math.pi):
                    found.append((("corner", i), ("corner", j)))
        return found

    def _span(self, side: int, along: Array) -> tuple[float, float]:
        ends = [float(along @ self._start[side]), float(along @ (self._start[side] + self._along[side]))]
        return min(ends), max(ends)

    def _faces(self, side: int, corner: int) -> bool:
        """Return whether a corner stands above a side, its normal against it."""
        along = np.array([-self._normal[side, 1], self._normal[side, 0]])
        low, high = self._span(side, along)
        return self._has(corner, self._angle[side] + math.pi) and low <= float(along @ self._corner[corner]) <= high

    def _beside(self, one: int, other: int) -> bool:
        """Return whether two sides are parallel and stand above each other."""
        if abs(math.remainder(self._angle[one] - self._angle[other] - math.pi, math.tau)) > _PARALLEL:
            return False
        along = np.array([-self._normal[one, 1], self._normal[one, 0]])
        (low, high), (first, last) = self._span(one, along), self._span(other, along)
        return min(high, last) > max(low, first)

    def meet(self, origin: Array, direction: float) -> Met | None:
        """Return where a finger stands that comes along a line from far out; None where it meets nothing.

        Args:
            origin: of the line [m]; direction: out of it, from where the finger comes [rad].
        """
        u = np.array([math.cos(direction), math.sin(direction)])
        found: list[Met] = []
        off = self._start + FINGER_M * self._normal - origin
        with np.errstate(divide="ignore", invalid="ignore"):
            across = self._along[:, 0] * u[1] - self._along[:, 1] * u[0]
            at = (self._along[:, 0] * off[:, 1] - self._along[:, 1] * off[:, 0]) / across
            share = (u[0] * off[:, 1] - u[1] * off[:, 0]) / across
        for i in np.flatnonzero((share >= 0.0) & (share <= 1.0) & np.isfinite(at)).tolist():
            found.append(Met(float(at[i]), ("side", i), float(self._angle[i])))
        away = origin - self._corner
        middle = away @ u
        square = middle**2 - (np.sum(away * away, axis=1) - (self._round + FINGER_M) ** 2)
        for i in np.flatnonzero(square >= 0.0).tolist():
            out = float(-middle[i] + math.sqrt(square[i]))
            dx, dy = (origin + out * u - self._corner[i]).tolist()
            if self._has(i, math.atan2(dy, dx)):
                found.append(Met(out, ("corner", i), math.atan2(dy, dx)))
        return max(found, key=lambda one: one.at_m, default=None)

    def close(self, origin: Array, psi: float) -> tuple[Grasp, tuple[Feature, Feature]] | None:
        """Close two fingers along a line; return the grasp and what it touches, None where one meets nothing."""
        far, near = self.meet(origin, psi), self.meet(origin, psi + math.pi)
        if far is None or near is None or far.at_m + near.at_m <= 2.0 * FINGER_M:
            return None
        u = np.array([math.cos(psi), math.sin(psi)])
        one, two = origin - near.at_m * u, origin + far.at_m * u
        held = grasp_of(tuple(one), tuple(two), near.normal + math.pi, far.normal + math.pi)
        return held, (near.feature, far.feature)

    def knows(self, touched: Sequence[Feature], inferred: bool) -> bool:
        """Return whether both features of a parallel grasp have been touched.

        Args:
            inferred: two neighbouring sides count for the corner between them, too.
        """
        known, count = set(touched), len(self)
        if inferred:
            known |= {("corner", i) for i in range(count) if {("side", i), ("side", (i + 1) % count)} <= known}
        return any(known.issuperset(pair) for pair in self.pairs)


@dataclass(frozen=True, slots=True)
class Bound:
    """Shares of objects; immutable.

    Args:
        count: of objects.
        touched: both features of a parallel grasp belong to the first touch.
        chosen: after a regrasp chosen by the first touches of all others that look alike.
        best: the same, each judged by those that it was chosen from: more than any choice comes to.
    """

    count: int
    touched: float
    chosen: float
    best: float


def bound(count: int, seed: int = 1, inferred: bool = False) -> Bound:
    """Return what planners can know of polygons of the draw before their second regrasp."""
    first = SHAPES.index("polygon")
    seen = [look for number in range(count) if (look := _look(draw(len(SHAPES) * number + first, seed), inferred))]
    looks, known, before = (np.array(column) for column in zip(*seen, strict=True))
    chosen, best = 0.0, 0.0
    for i, look in enumerate(looks):
        apart = np.sum((looks - look) ** 2, axis=1)
        apart[i] = math.inf
        like = known[np.argsort(apart)[:_LIKE]].mean(axis=0)
        chosen, best = chosen + float(known[i, int(np.argmax(like))]), best + float(like.max())
    return Bound(len(seen), float(before.mean()), chosen / len(seen), best / len(seen))


def _look(subject: Subject, inferred: bool) -> tuple[Array, Array, bool] | None:
    """Return what the first touch of an object is like, which regrasps would know a parallel grasp, and whether it
    does; None where nothing is met.
    """
    x, y, turn = subject.pose
    c, s = math.cos(turn), math.sin(turn)
    outline = Polygon(subject.outline)
    met = outline.close(np.array([-c * x - s * y, s * x - c * y]), -turn)
    if met is None:
        return None
    held, features = met
    middle = 0.5 * (np.array(held.contact1) + np.array(held.contact2))
    known = []
    for angle in held.direction + TURNS:
        aside = held.apart_m * np.array([-math.sin(angle), math.cos(angle)])
        after = [outline.close(middle + shift * aside, float(angle)) for shift in SHIFTS]
        known += [outline.knows((*features, *(again[1] if again else ())), inferred) for again in after]
    kinds = [4.0 * (kind == "corner") for kind, _ in features]  # far from the other kind
    look = np.array([*kinds, 3.0 * held.eta1, 3.0 * held.eta2, held.apart_m / 0.02])
    return look, np.array(known, dtype=np.float64), outline.knows(features, inferred)
