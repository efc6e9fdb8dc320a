"""What can be known at the write: where each command begins, and whether its time suffices.

A position command ends in a known state, so the command after it begins in a known state, and a
timed piece that no profile can carry out is refused with the array it came in (ERANGE). Where the
beginning is not known yet (after a velocity, a force, a replaced motion) the planner decides when
the command is next; then an infeasible one is a latched fault.
"""

from __future__ import annotations

import errno
from collections.abc import Generator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from . import modes
from .commands import Command, Limits, Validator
from .profile import Bounds, InfeasibleError, Planner, State, enclosures, pass_acceleration, quintic
from .types import RecordError

Floats = NDArray[np.float64]
SUFFICIENT = 1.06
"""d/v + v/a + a/j is at least 3/3.175 of the shortest rest-to-rest time, so 1.06 of it suffices."""


TRIALS = 8
"""Profiles tried in one go, at 10 to 20 us each."""


class Tail(NamedTuple):
    """What is known of the end of each axis' buffer: state (n, 3), NaN where unknown, and limits (n,)."""

    state: Floats
    velocity: Floats
    acceleration: Floats

    def rows(self, axes: NDArray[np.int64]) -> Tail:
        """Return a copy of the rows of some axes."""
        return Tail(self.state[axes], self.velocity[axes], self.acceleration[axes])

    def set_rows(self, axes: NDArray[np.int64], rows: Tail) -> None:
        """Overwrite the rows of some axes."""
        for held, new in zip(self, rows, strict=True):
            held[axes] = new

    def equals(self, other: Tail) -> bool:
        """Tell whether both know the same."""
        return all(np.array_equal(a, b, equal_nan=True) for a, b in zip(self, other, strict=True))


class Feasibility:
    """Checks admitted commands against the known end of the buffers. Pure; concurrency: that of the bank."""

    def __init__(self, limits: Limits, validator: Validator) -> None:
        self._limits = limits
        self._validator = validator
        self._planner = Planner()

    def check(self, commands: NDArray[Any], tail: Tail) -> Generator[None, None, None]:
        """Refuse what is known to be infeasible, and bring the tail up to date; yields between trials.

        Raises:
            RecordError: ERANGE.
        """
        order = np.argsort(commands["axis"], kind="stable")
        c = commands[order]
        axis, mode = c["axis"].astype(np.int64), c["control_mode"]
        first = np.concatenate(([True], axis[1:] != axis[:-1]))
        velocity = _filled(c["max_velocity"], (mode & modes.MAX_VEL_ACC) != 0, first, tail.velocity[axis])
        acceleration = _filled(c["max_acceleration"], (mode & modes.MAX_VEL_ACC) != 0, first, tail.acceleration[axis])
        end, begin = self._states(c, first, tail, acceleration)
        self._check_reach(commands, order, c, end, velocity)
        bounds = np.stack(
            (
                velocity,
                acceleration,
                self._limits.jerk[axis],
                self._limits.minimum[axis],
                self._limits.maximum[axis],
            ),
            1,
        )
        doubtful = self._doubtful(c, begin, end, bounds)
        for tried, i in enumerate(np.flatnonzero(doubtful).tolist(), 1):
            self._try(commands, int(order[i]), c[i], begin[i], bounds[i])
            if tried % TRIALS == 0:
                yield
        last = np.flatnonzero(np.concatenate((first[1:], [True])))
        tail.set_rows(axis[last], Tail(end[last], velocity[last], acceleration[last]))

    def _states(self, c: NDArray[Any], first: NDArray[np.bool_], tail: Tail, limit: Floats) -> tuple[Floats, Floats]:
        """Return the states (m, 3) in which the commands end and begin, NaN where unknown."""
        mode, time = c["control_mode"], c["time"]
        timed = (mode & modes.TIME) != 0
        certain = ((mode & modes.POSITION) != 0) & ~(timed & (time < 0))
        relative = (mode & modes.RELATIVE) != 0
        before = tail.state[c["axis"]]
        end = np.full((len(c), 3), np.nan)
        end[:, 0] = _positions(c["position"], certain, relative, first, before[:, 0])
        end[:, 1] = np.where(certain, np.where((mode & modes.VELOCITY) != 0, c["velocity"], 0.0), np.nan)
        begin = np.where(first[:, None], before, np.roll(end, 1, axis=0))
        free = certain & timed & ((mode & modes.PASS) == modes.PASS) & ((mode & modes.ACCELERATION) == 0)
        with np.errstate(invalid="ignore", divide="ignore"):
            own = pass_acceleration(begin[:, 0], begin[:, 1], end[:, 0], end[:, 1], np.where(timed, time, 1.0))
        own = np.clip(own, -limit, limit)
        end[:, 2] = np.where(free, own, np.where((mode & modes.ACCELERATION) != 0, c["acceleration"], 0.0))
        begin = np.where(first[:, None], before, np.roll(end, 1, axis=0))
        return end, begin

    def _check_reach(
        self, commands: NDArray[Any], order: NDArray[np.int64], c: NDArray[Any], end: Floats, velocity: Floats
    ) -> None:
        """Relative targets inside the soft limits, passing velocities inside the specified maximum."""
        low, high = self._limits.reach(c["axis"], c["control_mode"])
        bad = (end[:, 0] < low) | (end[:, 0] > high)
        if bad.any():
            i = int(bad.argmax())
            raise self._refusal(commands, int(order[i]), (
                f"position {c['position'][i]:g} from here leads to {end[i, 0]:g}, outside the soft limits; "
                f"want {low[i]:g} to {high[i]:g}"
            ))  # fmt: skip
        bad = np.abs(end[:, 1]) > velocity
        if bad.any():
            i = int(bad.argmax())
            raise self._refusal(
                commands,
                int(order[i]),
                f"velocity {end[i, 1]:g} is above the max_velocity in force; want at most {velocity[i]:g}",
            )

    def _doubtful(self, c: NDArray[Any], begin: Floats, end: Floats, bounds: Floats) -> NDArray[np.bool_]:
        """Return which timed position commands from known states are not clearly feasible."""
        mode = c["control_mode"]
        known = np.isfinite(begin).all(axis=1) & np.isfinite(end[:, 0])
        timed = known & ((mode & modes.TIME) != 0) & (c["time"] > 0)
        doubtful = np.zeros(len(c), dtype=bool)
        passing = (mode & modes.VELOCITY) != 0
        rows = np.flatnonzero(timed & passing)
        if rows.size:
            b, e, t = begin[rows].T, end[rows].T, c["time"][rows]
            position, velocity, acceleration = enclosures(quintic((b[0], b[1], b[2]), (e[0], e[1], e[2]), t), t)
            v, a, _, low, high = bounds[rows].T
            doubtful[rows] = (
                (np.abs(velocity).max(axis=0) > v)
                | (np.abs(acceleration).max(axis=0) > a)
                | (np.min(position, axis=0) < low)
                | (np.max(position, axis=0) > high)
            )
        rows = np.flatnonzero(timed & ~passing)
        if rows.size:
            v, a, j = bounds[rows].T[:3]
            enough = SUFFICIENT * (np.abs(end[rows, 0] - begin[rows, 0]) / v + v / a + a / j)
            doubtful[rows] = (c["time"][rows] < enough) | (begin[rows, 1:] != 0).any(axis=1)
        return doubtful

    def _try(self, commands: NDArray[Any], i: int, record: Any, begin: Floats, bounds: Floats) -> None:
        state: State = (float(begin[0]), float(begin[1]), float(begin[2]))
        try:
            self._planner.plan(Command._make(record.item()), state, Bounds(*bounds.tolist()))
        except InfeasibleError as e:
            raise self._refusal(commands, i, str(e)) from None

    def _refusal(self, commands: NDArray[Any], i: int, what: str) -> RecordError:
        return self._validator.refuse(errno.ERANGE, commands, i, what)


def _filled(values: Floats, given: NDArray[np.bool_], first: NDArray[np.bool_], before: Floats) -> Floats:
    """Return the value in force at each record: the last one given on its axis, else that before the array."""
    index = np.arange(len(values))
    start = np.maximum.accumulate(np.where(first, index, 0))
    source = np.maximum.accumulate(np.where(given, index, -1))
    filled: Floats = np.where(source >= start, values[source], before)
    return filled


def _positions(
    position: Floats,
    certain: NDArray[np.bool_],
    relative: NDArray[np.bool_],
    first: NDArray[np.bool_],
    before: Floats,
) -> Floats:
    """Return absolute end positions; relative ones count from the last anchor before them on their axis."""
    if not (certain & relative).any():
        return np.where(certain, position, np.nan)
    ends = np.empty(len(position))
    present = np.nan
    for i, value in enumerate(position.tolist()):
        if first[i]:
            present = float(before[i])
        present = (present + value if relative[i] else value) if certain[i] else np.nan
        ends[i] = present
    return ends
