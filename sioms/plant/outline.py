"""Convex outlines of planar objects: disk, ellipse, rectangle, polygon, closed spline.

An outline is a polygon fine enough that its sides leave the curve by less than a tolerance, anti-clockwise, with the
centroid at the origin.  Corners are sharp unless a radius is asked for.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import CubicSpline

Array = NDArray[np.float64]

TOLERANCE_M = 1e-6
_MOST_POINTS = 100_000


@dataclass(frozen=True, slots=True, eq=False)
class Outline:
    """A convex polygon about its centroid; immutable.

    Args:
        points: corners [m], anti-clockwise, shape (n, 2), n >= 3; moved so that the centroid is at the origin.

    Raises:
        ValueError: fewer than three corners, not anti-clockwise, or not convex.
    """

    points: Array

    def __post_init__(self) -> None:
        points = np.asarray(self.points, dtype=np.float64)
        if points.ndim != 2 or points.shape[1] != 2 or points.shape[0] < 3 or not np.all(np.isfinite(points)):
            raise ValueError(f"describe outline: points of shape {points.shape}; want three or more finite pairs")
        side = np.roll(points, -1, axis=0) - points
        after = np.roll(side, -1, axis=0)
        turn = side[:, 0] * after[:, 1] - side[:, 1] * after[:, 0]
        scale = float(np.hypot(*np.ptp(points, axis=0)))
        if not np.all(np.hypot(side[:, 0], side[:, 1]) > 1e-9 * scale):
            raise ValueError("describe outline: two neighbouring points coincide; leave one of them out")
        round_ = np.sum(np.arctan2(turn, np.sum(side * after, axis=1))) / math.tau
        if np.min(turn) < -1e-9 * scale**2 or abs(round_ - 1.0) > 1e-6:
            worst = points[(int(np.argmin(turn)) + 1) % len(points)]
            raise ValueError(
                f"describe outline: not convex at {worst[0]:.6g}, {worst[1]:.6g} m, or not anti-clockwise; want every "
                "corner to turn left"
            )
        object.__setattr__(self, "points", points - _centroid(points))

    @property
    def area(self) -> float:
        """Return the area [m^2]."""
        return float(np.sum(_cross(self.points)) / 2.0)

    @property
    def gyration_m(self) -> float:
        """Return the radius of gyration [m] of a plate of this outline about its centroid."""
        p, q = self.points, np.roll(self.points, -1, axis=0)
        polar = np.sum(_cross(p) * np.sum(p * p + p * q + q * q, axis=1)) / 12.0
        return math.sqrt(polar / self.area)

    @property
    def reach_m(self) -> float:
        """Return the distance of the farthest point from the centroid [m]."""
        return float(np.hypot(self.points[:, 0], self.points[:, 1]).max())

    @property
    def narrowest_m(self) -> float:
        """Return the least width [m]: across a side; of outlines of many sides the least of 360 of them."""
        side = np.roll(self.points, -1, axis=0) - self.points
        some = side[:: max(1, len(side) // 360)]
        across = np.stack([some[:, 1], -some[:, 0]]) / np.hypot(some[:, 0], some[:, 1])
        return float(np.min(np.ptp(self.points @ across, axis=0)))

    def width(self, direction: float) -> float:
        """Return the width [m] between the two supporting lines whose normal has this direction [rad]."""
        along = self.points @ np.array([math.cos(direction), math.sin(direction)])
        return float(np.ptp(along))

    def nearest(self, pose: Sequence[float], x: float, y: float) -> tuple[float, float]:
        """Return the point of the outline at `pose` (x [m], y [m], angle [rad]) that is nearest to (x, y) [m]."""
        c, s = math.cos(pose[2]), math.sin(pose[2])
        own = np.array([c * (x - pose[0]) + s * (y - pose[1]), c * (y - pose[1]) - s * (x - pose[0])])
        start = self.points
        side = np.roll(start, -1, axis=0) - start
        share = np.clip(np.sum((own - start) * side, axis=1) / np.sum(side * side, axis=1), 0.0, 1.0)
        foot = start + share[:, None] * side
        u, v = foot[int(np.argmin(np.sum((foot - own) ** 2, axis=1)))].tolist()
        return pose[0] + c * u - s * v, pose[1] + s * u + c * v


def disk(radius_m: float, tolerance_m: float = TOLERANCE_M) -> Outline:
    """Return a disk.

    Raises:
        ValueError: a size that is not positive, or a tolerance that needs more than 100,000 points.
    """
    return ellipse(radius_m, radius_m, tolerance_m)


def ellipse(half_x_m: float, half_y_m: float, tolerance_m: float = TOLERANCE_M) -> Outline:
    """Return an ellipse with half axes along x and y; raises as `disk`."""
    _check("ellipse", half_x_m=half_x_m, half_y_m=half_y_m)
    # the sagitta of a side over the step t of the parameter is at most max(a, b) t^2/8
    count = _count(math.tau / math.sqrt(8.0 * tolerance_m / max(half_x_m, half_y_m)))
    t = math.tau * np.arange(count) / count
    return Outline(np.stack([half_x_m * np.cos(t), half_y_m * np.sin(t)], axis=1))


def rectangle(size_x_m: float, size_y_m: float, corner_m: float = 0.0, tolerance_m: float = TOLERANCE_M) -> Outline:
    """Return a rectangle of full sizes along x and y, its corners rounded with `corner_m`; raises as `polygon`."""
    _check("rectangle", size_x_m=size_x_m, size_y_m=size_y_m)
    x, y = 0.5 * size_x_m, 0.5 * size_y_m
    return polygon([(-x, -y), (x, -y), (x, y), (-x, y)], corner_m, tolerance_m)


def polygon(corners: ArrayLike, corner_m: float = 0.0, tolerance_m: float = TOLERANCE_M) -> Outline:
    """Return a convex polygon through corners [m], anti-clockwise, shape (n, 2), rounded with the radius `corner_m`.

    Raises:
        ValueError: not convex, or the radius leaves nothing of a side.
    """
    sharp = Outline(np.asarray(corners, dtype=np.float64)).points
    if not 0.0 <= corner_m < math.inf:
        raise ValueError(f"describe polygon: corner radius is {corner_m} m; want 0 (sharp) or more")
    if corner_m == 0.0:
        return Outline(sharp)
    side = np.roll(sharp, -1, axis=0) - sharp
    length = np.hypot(side[:, 0], side[:, 1])
    direction = np.arctan2(side[:, 1], side[:, 0])
    turn = np.remainder(direction - np.roll(direction, 1), math.tau)
    cut = corner_m * np.tan(0.5 * turn)
    if np.any(cut + np.roll(cut, -1) >= (1.0 - 1e-9) * length):
        raise ValueError(f"describe polygon: a corner radius of {corner_m} m leaves nothing of a side; want less")
    points = []
    for at, before, bend, back in zip(sharp, np.roll(direction, 1), turn, cut, strict=True):
        start = at - back * np.array([math.cos(before), math.sin(before)])
        centre = start + corner_m * np.array([-math.sin(before), math.cos(before)])
        steps = _count(bend / math.sqrt(8.0 * tolerance_m / corner_m), 2)
        angle = before - 0.5 * math.pi + bend * np.arange(steps + 1) / steps
        points.append(centre + corner_m * np.stack([np.cos(angle), np.sin(angle)], axis=1))
    return Outline(np.concatenate(points))


def spline(points: ArrayLike, tolerance_m: float = TOLERANCE_M) -> Outline:
    """Return the closed cubic spline through points [m], anti-clockwise, shape (n, 2), n >= 4, by length of chord.

    Raises:
        ValueError: too few points, or a curve that is not convex.
    """
    through = np.asarray(points, dtype=np.float64)
    if through.ndim != 2 or through.shape[1] != 2 or through.shape[0] < 4 or not np.all(np.isfinite(through)):
        raise ValueError(f"describe spline: points of shape {through.shape}; want four or more finite pairs")
    closed = np.concatenate([through, through[:1]])
    chord = np.hypot(*np.diff(closed, axis=0).T)
    if not np.all(chord > 0.0):
        raise ValueError("describe spline: two neighbouring points coincide; leave one of them out")
    place = np.concatenate([[0.0], np.cumsum(chord)])
    curve = CubicSpline(place, closed, bc_type="periodic")
    dense = np.linspace(0.0, place[-1], 2000)
    bend = float(np.hypot(*curve(dense, 2).T).max())  # of a curve with nearly unit speed: its curvature
    count = _count(place[-1] / math.sqrt(8.0 * tolerance_m / max(bend, 1e-9)), len(through))
    return Outline(curve(place[-1] * np.arange(count) / count))


def _count(wanted: float, least: int = 3) -> int:
    count = max(least, math.ceil(wanted))
    if count > _MOST_POINTS:
        raise ValueError(f"describe outline: {count} points; at most {_MOST_POINTS}: want a larger tolerance")
    return count


def _check(what: str, **sizes: float) -> None:
    for name, value in sizes.items():
        if not 0.0 < value < math.inf:
            raise ValueError(f"describe {what}: {name} is {value} m; want more than 0, finite")


def _cross(points: Array) -> Array:
    after = np.roll(points, -1, axis=0)
    crossed: Array = points[:, 0] * after[:, 1] - points[:, 1] * after[:, 0]
    return crossed


def _centroid(points: Array) -> Array:
    origin = points[0]
    own = points - origin
    cross = _cross(own)
    centre: Array = origin + (own + np.roll(own, -1, axis=0)).T @ cross / (3.0 * np.sum(cross))
    return centre
