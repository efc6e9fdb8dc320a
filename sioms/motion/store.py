"""Plans of all axes as arrays.

Every axis has two rows: the plan that runs and the one made ahead. Starting a plan made ahead
flips the row and copies nothing. Instants are integer nanoseconds plus a fraction in [0, 1) that
is carried from command to command, so that a trajectory of many pieces does not drift.
"""

from __future__ import annotations

import math
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from .profile import MAX_SEGMENTS, Plan

NEVER_NS = 2**62
UNCUT_NS = 2**63 - 1
FEW = 4
"""Axes up to which one by one is quicker than as arrays: segments of different axes seldom end together."""
Axes = NDArray[np.int64]
Number = TypeVar("Number", float, NDArray[np.float64])


class PlanStore:
    """Two plans per axis and the segment of the running one that holds now.

    Arrays (n,): ``start_ns``, ``start_fraction`` begin of the running plan; ``segment_ns`` and
    ``end_ns`` begin and end of its present segment; ``cut_ns`` where the plan is made to end. ``final`` (2n, 3),
    ``duration`` (2n,) belong to rows; ``present`` (6, n) are the coefficients of the present segments;
    ``row`` (n,) is the running row of an axis, ``row ^ 1`` the other.
    """

    def __init__(self, n: int) -> None:
        self.row = 2 * np.arange(n, dtype=np.int64)
        self.start_ns = np.zeros(n, dtype=np.int64)
        self.start_fraction = np.zeros(n)
        self.segment_ns = np.zeros(n, dtype=np.int64)
        self.end_ns = np.full(n, NEVER_NS, dtype=np.int64)
        self.cut_ns = np.full(n, UNCUT_NS, dtype=np.int64)
        self.next_ns = NEVER_NS
        self.duration = np.full(2 * n, np.inf)
        self.final = np.zeros((2 * n, 3))
        self._segment = np.zeros(n, dtype=np.int64)
        self._count = np.ones(2 * n, dtype=np.int64)
        self._ends = np.full((2 * n, MAX_SEGMENTS), np.inf)
        self._coefficients = np.zeros((2 * n, MAX_SEGMENTS, 6))
        self.present = np.zeros((6, n))

    @property
    def segments(self) -> dict[str, NDArray[Any]]:
        """The arrays of segments, as the steps of a stop call them."""
        return {
            "segment": self._segment, "count": self._count, "ends": self._ends, "coefficients": self._coefficients
        }  # fmt: skip

    def put(self, row: int, plan: Plan) -> None:
        """Write a plan into a row."""
        count = len(plan.segments)
        table = np.array(plan.segments)
        self._coefficients[row, :count] = table[:, 1:]
        np.cumsum(table[:, 0], out=self._ends[row, :count])
        self._ends[row, count - 1] = plan.duration
        self._count[row] = count
        self.duration[row] = plan.duration
        self.final[row] = plan.final

    def put_hold(self, rows: Axes, position: NDArray[np.float64]) -> None:
        """Write 'rest at position until something comes' into rows."""
        self._coefficients[rows, 0] = 0.0
        self._coefficients[rows, 0, 0] = position
        self._ends[rows, 0] = np.inf
        self._count[rows] = 1
        self.duration[rows] = np.inf
        self.final[rows] = 0.0
        self.final[rows, 0] = position

    def put_brake(
        self,
        rows: Axes,
        position: NDArray[np.float64],
        velocity: NDArray[np.float64],
        deceleration: NDArray[np.float64],
    ) -> None:
        """Write 'stop from (position, velocity) at constant deceleration > 0' into rows."""
        duration = np.abs(velocity) / deceleration
        self._coefficients[rows, 0] = 0.0
        self._coefficients[rows, 0, 0] = position
        self._coefficients[rows, 0, 1] = velocity
        self._coefficients[rows, 0, 2] = -0.5 * np.copysign(deceleration, velocity)
        self._ends[rows, 0] = duration
        self._count[rows] = 1
        self.duration[rows] = duration
        self.final[rows] = 0.0
        self.final[rows, 0] = position + 0.5 * velocity * duration

    def begin(self, axes: Axes, start_ns: NDArray[np.int64], fraction: NDArray[np.float64]) -> None:
        """Let the plans in the running rows of these axes begin at start + fraction [ns]."""
        self.start_ns[axes] = start_ns
        self.start_fraction[axes] = fraction
        self._segment[axes] = 0
        self.segment_ns[axes] = start_ns
        self.cut_ns[axes] = UNCUT_NS
        self._load(axes)

    def flip(self, axes: Axes) -> None:
        """Make the other row the running one; begin() follows."""
        self.row[axes] ^= 1

    def shift(self, axes: Axes, by: float) -> None:
        """Add to the position of all plans of these axes, running and made ahead."""
        for rows in (self.row[axes], self.row[axes] ^ 1):
            self._coefficients[rows, :, 0] += by
            self.final[rows, 0] += by
        self.present[0, axes] += by

    def advance(self, axes: Axes) -> Axes:
        """Go to the next segment of axes whose segment ended; return those whose plan ended."""
        if axes.size <= FEW:
            return np.array([axis for axis in axes.tolist() if not self._advance_one(axis)], dtype=np.int64)
        cut = self.end_ns[axes] >= self.cut_ns[axes]
        if cut.any():
            self._end_here(axes[cut])
        more = ~cut & (self._segment[axes] + 1 < self._count[self.row[axes]])
        going = axes[more]
        if going.size:
            self.segment_ns[going] = self.end_ns[going]
            self._segment[going] += 1
            self._load(going)
        return axes[~more]

    def _advance_one(self, axis: int) -> bool:
        """Go to the next segment of an axis; tell whether there is one."""
        end_ns = self.end_ns[axis]
        if end_ns >= self.cut_ns[axis]:
            self._end_one(axis)
            return False
        if self._segment[axis] + 1 >= self._count[self.row[axis]]:
            return False
        self.segment_ns[axis] = end_ns
        self._segment[axis] += 1
        self._load_one(axis)
        return True

    def _end_here(self, axes: Axes) -> None:
        rows, cut_ns = self.row[axes], self.cut_ns[axes]
        self.final[rows] = self.state(axes, cut_ns)
        self.start_ns[axes] = cut_ns
        self.start_fraction[axes] = 0.0
        self.duration[rows] = 0.0

    def _end_one(self, axis: int) -> None:
        """Do what _end_here() does for one axis."""
        row, cut_ns = self.row[axis], int(self.cut_ns[axis])
        t = (cut_ns - int(self.segment_ns[axis])) * 1e-9
        self.final[row] = _evaluate(t, *self.present[:, axis].tolist())
        self.start_ns[axis] = cut_ns
        self.start_fraction[axis] = 0.0
        self.duration[row] = 0.0

    def _load_one(self, axis: int) -> None:
        """Do what _load() does for one axis."""
        row, segment = self.row[axis], self._segment[axis]
        present = self._coefficients[row, segment]
        self.present[:, axis] = present
        end = float(self._ends[row, segment]) * 1e9 + float(self.start_fraction[axis])
        end_ns = NEVER_NS if end >= NEVER_NS else min(int(self.start_ns[axis]) + math.ceil(end), NEVER_NS)
        end_ns = min(end_ns, int(self.cut_ns[axis]))
        self.end_ns[axis] = end_ns
        self.next_ns = min(self.next_ns, end_ns)

    def _load(self, axes: Axes) -> None:
        if axes.size <= FEW:
            for axis in axes.tolist():
                self._load_one(axis)
            return
        rows, segment = self.row[axes], self._segment[axes]
        present = self._coefficients[rows, segment]
        self.present[:, axes] = present.T
        end = np.minimum(self._ends[rows, segment] * 1e9 + self.start_fraction[axes], float(NEVER_NS))
        # The fraction decides nothing here: it is below a nanosecond, and carried by finish().
        end_ns = np.minimum(self.start_ns[axes] + np.ceil(end).astype(np.int64), NEVER_NS)
        self.end_ns[axes] = np.minimum(end_ns, self.cut_ns[axes])
        self.next_ns = min(self.next_ns, int(self.end_ns[axes].min()))

    def due(self, now_ns: int) -> Axes:
        """Return the axes whose segment has ended, and note when the next one ends."""
        axes = np.flatnonzero(self.end_ns <= now_ns)
        if not axes.size:
            self.next_ns = int(self.end_ns.min())
        return axes

    def look_ahead(self) -> None:
        """Note when the next segment ends: others have changed that."""
        self.next_ns = int(self.end_ns.min())

    def ended_at(self, axes: Axes) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Return the exact instants, ns and fraction, at which the running plans end."""
        total = self.start_fraction[axes] + self.duration[self.row[axes]] * 1e9
        whole = np.floor(total)
        return self.start_ns[axes] + whole.astype(np.int64), total - whole

    def cut(self, axes: Axes, end_ns: int) -> None:
        """Let running plans end exactly at end_ns (not in the past of their segments), whatever they do then."""
        self.cut_ns[axes] = end_ns
        self.end_ns[axes] = np.minimum(self.end_ns[axes], end_ns)
        self.next_ns = min(self.next_ns, end_ns)

    def uncut(self, axes: Axes) -> None:
        """Let running plans go on to their own ends: what they were cut for is no more."""
        cut = axes[self.cut_ns[axes] != UNCUT_NS]
        if cut.size:
            self.cut_ns[cut] = UNCUT_NS
            self._load(cut)

    def state(self, axes: Axes, now_ns: int | NDArray[np.int64]) -> NDArray[np.float64]:
        """Return position, velocity, acceleration (m, 3) of the present segments at now."""
        t = (now_ns - self.segment_ns[axes]) * 1e-9
        return np.array(_evaluate(t, *self.present[:, axes])).T


def _evaluate(
    t: Number, c0: Number, c1: Number, c2: Number, c3: Number, c4: Number, c5: Number
) -> tuple[Number, Number, Number]:
    """Return position, velocity and acceleration of a polynomial at t."""
    position = c0 + t * (c1 + t * (c2 + t * (c3 + t * (c4 + t * c5))))
    velocity = c1 + t * (2 * c2 + t * (3 * c3 + t * (4 * c4 + t * 5 * c5)))
    acceleration = 2 * c2 + t * (6 * c3 + t * (12 * c4 + t * 20 * c5))
    return position, velocity, acceleration
