"""How a point move arrives: from which side, after which rest, how near, and what happens when it missed.

A *point move* commands a position to be reached at rest, without a time of its own: POSITION, with or without
RELATIVE, and no VELOCITY, ACCELERATION or SPECIFIED_TIME. Take-up, settling and retries are part of it: the
command ends, and its marker is signalled, when they are over. Everything else is a trajectory, and goes where
it is told. A stop of any kind ends a point move where it stops: it never takes up, settles or tries again.

Take-up of play: the last stretch to the target, as long as the distance, is travelled in the direction of its
sign. A move that comes so by itself goes straight; another one first goes beyond the target by the distance.
An axis that stands at the end of a point move has its play taken up already, so small steps onwards are straight.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .commands import Command
from .profile import Bounds, InfeasibleError, Plan, Planner, State
from .settings import AxisSettings

CLOSE = 1 - 1e-9
"""Part of the distance that must be left for a straight move: what rounding takes away does not count."""


class Approach(NamedTuple):
    """What an axis does at the end of a point move: Backlash, Arrival and deadband with nothing left open."""

    distance: float
    velocity: float
    acceleration: float
    settle_s: float
    deadband: float

    @staticmethod
    def of(settings: AxisSettings) -> Approach | None:
        """Return the approach of an axis, None when its point moves end with their profiles."""
        backlash, arrival = settings.backlash, settings.arrival
        if backlash is None and arrival is None and not settings.deadband:
            return None
        return Approach(
            backlash.distance if backlash else 0.0,
            backlash.velocity or math.inf if backlash else math.inf,
            backlash.acceleration or math.inf if backlash else math.inf,
            arrival.settle_s if arrival else 0.0,
            settings.deadband,
        )

    def is_idle_for(self, target: float, position: float) -> bool:
        """Tell whether a target is so near to an axis at rest that it stays where it is."""
        return abs(target - position) < self.deadband

    def begin_of_take_up(self, target: float, lowest: float, highest: float) -> float:
        """Return where the last stretch to a target begins.

        Raises:
            InfeasibleError: outside the soft limits.
        """
        begin = target - self.distance
        if not lowest <= begin <= highest:
            raise InfeasibleError(
                f"position {target:g} is approached from {begin:g}, which is outside the soft limits; "
                f"want {lowest:g} to {highest:g}"
            )
        return begin

    def is_straight(self, target: float, position: float, taken: bool) -> bool:
        """Tell whether the way from a place of rest to a target ends with the last stretch by itself."""
        left = math.copysign(1.0, self.distance) * (target - position)
        return not self.distance or left >= CLOSE * abs(self.distance) or (taken and left >= 0)


class Arrivals:
    """How near the axes of a bank must come. Arrays (n,): ``tries`` of the last point move, ``misses`` since the
    start.
    """

    def __init__(self, settings: Sequence[AxisSettings]) -> None:
        given = [s.arrival for s in settings]
        self.tolerance = np.array([a.tolerance if a and a.tolerance else np.inf for a in given])
        self.most = np.array([a.retries if a else 0 for a in given], dtype=np.int64)
        self.tries, self.misses = np.zeros((2, len(settings)), dtype=np.int64)
        self.watched = bool(np.isfinite(self.tolerance).any())

    def judge(
        self, axes: NDArray[np.int64], distance: NDArray[np.float64]
    ) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Return which of these axes missed their targets for good, and which shall try again (counted here).

        Args:
            axes: that have settled.
            distance: to the target of each [unit].
        """
        missed = np.abs(distance) > self.tolerance[axes]
        again = missed & (self.tries[axes] < self.most[axes])
        self.tries[axes[again]] += 1
        self.misses[axes[missed & ~again]] += 1
        return missed & ~again, again

    def report(self, axes: NDArray[np.int64]) -> dict[str, list[float]]:
        """Return the counts of these axes by name."""
        return {"retries": self.tries[axes].tolist(), "misses": self.misses[axes].tolist()}


class PointPlan(NamedTuple):
    """A point move planned: whether its play is taken up at the end, and whether it is to be looked at there."""

    plan: Plan
    taken: bool
    looked_at: bool


def plan_point(
    planner: Planner, command: Command, state: State, bounds: Bounds, approach: Approach, taken: bool
) -> PointPlan:
    """Return the plan of a point move with its take-up and settling.

    Args:
        planner: makes the profiles.
        command: the point move.
        state: in which it begins.
        bounds: limits that hold.
        approach: of the axis.
        taken: the axis stands, and its play is taken up.

    Raises:
        InfeasibleError: the target, or the place from which it is approached, is outside the soft limits.
    """
    target = planner.target(command, state, bounds)
    at_rest = state[1:] == (0.0, 0.0)
    if at_rest and approach.is_idle_for(target, state[0]):
        return PointPlan(Plan([(0.0, state[0], 0.0, 0.0, 0.0, 0.0, 0.0)], 0.0, state, False), taken, False)
    begin = approach.begin_of_take_up(target, bounds.minimum, bounds.maximum)
    parts = [planner.reach(target, state, bounds)]
    straight = approach.is_straight(target, state[0], taken and at_rest)
    if not straight or (approach.distance and not at_rest and planner.overshoots(target, approach.distance)):
        slow = bounds._replace(
            velocity=min(bounds.velocity, approach.velocity),
            acceleration=min(bounds.acceleration, approach.acceleration),
        )
        parts = [planner.reach(begin, state, bounds), planner.reach(target, (begin, 0.0, 0.0), slow)]
    segments = [segment for part in parts for segment in part.segments]
    if approach.settle_s:
        segments.append((approach.settle_s, target, 0.0, 0.0, 0.0, 0.0, 0.0))
    duration = sum(part.duration for part in parts) + approach.settle_s
    guard = any(part.guard for part in parts)
    return PointPlan(Plan(segments, duration, (target, 0.0, 0.0), guard), bool(approach.distance), True)
