"""Plans: what one command makes an axis do, as polynomial segments in continuous time.

A segment is (duration [s], c0 .. c5), position = sum c_i t^i from its own start. Position commands
are time-optimal (Ruckig); velocity, acceleration and jerk commands are velocity profiles of Ruckig
with the command's own bounds, because each of them is "go towards that velocity, at most so fast";
a timed pass through (position, velocity, acceleration) is the quintic through both ends.
"""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any, NamedTuple

import ruckig

from . import modes
from .commands import LONGEST_MOVE_S, Command

MAX_SEGMENTS = 23
"""Two brake phases, seven of the profile, two of arrival; nine of a take-up; a hold, two to spare."""
SHORTEST_S = 1e-11
POSITION_INTERFACE = ruckig.ControlInterface.Position
VELOCITY_INTERFACE = ruckig.ControlInterface.Velocity
DONE = (ruckig.Result.Working, ruckig.Result.Finished)
BESIDE_EDGES = (0.0, 1e-10, 1e-8, 1e-6)
"""Parts by which the acceleration is reduced where no profile is found. At the border between two forms of profile, as
for a move of 2 a^3/j^2 from rest to rest, ruckig 0.19 finds neither for some limits, round ones among them.
"""
TIME_TOLERANCE_S = 1e-9

Segment = tuple[float, float, float, float, float, float, float]
State = tuple[float, float, float]
"""Position, velocity, acceleration."""


class InfeasibleError(Exception):
    """The command cannot be carried out within the limits from the state in which it begins."""


class Bounds(NamedTuple):
    """Limits that hold for a plan; jerk may be infinite, positions too. Speeds up to ``start`` are taken at once."""

    velocity: float
    acceleration: float
    jerk: float
    minimum: float
    maximum: float
    start: float = 0.0


class Plan(NamedTuple):
    """Segments of one command.

    duration is infinite for a command that lasts until the next; final is the state at the end of
    the last segment (for an infinite one the state it settles in, which is steady only when
    resting). guard asks for the stopping-distance check in every tick.
    """

    segments: list[Segment]
    duration: float
    final: State
    guard: bool


class Planner:
    """Makes plans. Holds Ruckig's objects, so one planner per thread."""

    def __init__(self) -> None:
        self._otg = ruckig.Ruckig(1)
        self._input = ruckig.InputParameter(1)
        self._trajectory = ruckig.Trajectory(1)
        # The first plan of a process takes milliseconds (page faults); not in a tick, then.
        self._optimal((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), Bounds(1.0, 1.0, 1.0, -math.inf, math.inf), None)

    def plan(self, command: Command, state: State, bounds: Bounds) -> Plan:
        """Return the plan of a position, velocity, acceleration or jerk command from a state.

        Raises:
            InfeasibleError: the sentence says what is not possible and what would be.
        """
        mode = command.control_mode
        if mode & modes.POSITION:
            return self._position(command, state, bounds)
        duration = command.time if mode & modes.TIME and command.time > 0 else math.inf
        velocity, limited = _velocity_goal(command, state, bounds)
        if bounds.start and mode & modes.VELOCITY and abs(state[1]) <= bounds.start:
            state = (state[0], math.copysign(min(bounds.start, abs(velocity)), velocity), 0.0)
        return self._velocity(velocity, duration, state, limited)

    def target(self, command: Command, state: State, bounds: Bounds) -> float:
        """Return where a position command leads.

        Raises:
            InfeasibleError: outside the soft limits.
        """
        target = command.position + (state[0] if command.control_mode & modes.RELATIVE else 0.0)
        if not bounds.minimum <= target <= bounds.maximum:
            raise InfeasibleError(
                f"position {target:g} is outside the soft limits; want {bounds.minimum:g} to {bounds.maximum:g}"
            )
        return target

    def reach(self, target: float, state: State, bounds: Bounds) -> Plan:
        """Return the time-optimal motion from a state to rest at a place."""
        return self._optimal(state, (target, 0.0, 0.0), bounds, None)

    def overshoots(self, target: float, side: float) -> bool:
        """Tell whether the last profile went beyond a place, on the side given by the sign of ``side``."""
        extent = self._trajectory.position_extrema[0]
        return bool(extent.max > target + 1e-9 if side > 0 else extent.min < target - 1e-9)

    def _position(self, command: Command, state: State, bounds: Bounds) -> Plan:
        mode = command.control_mode
        target = self.target(command, state, bounds)
        final = (
            target,
            command.velocity if mode & modes.VELOCITY else 0.0,
            command.acceleration if mode & modes.ACCELERATION else 0.0,
        )
        timed = bool(mode & modes.TIME) and command.time > 0
        if timed and mode & modes.VELOCITY:
            return self.timed_pass(state, final, bool(mode & modes.ACCELERATION), command.time, bounds)
        plan = self._optimal(state, final, bounds, command.time if timed else None)
        if mode & modes.TIME and command.time < 0:
            hold = (math.inf, target, 0.0, 0.0, 0.0, 0.0, 0.0)
            plan = Plan([*plan.segments, hold], math.inf, final, plan.guard)
        return plan

    def timed_pass(self, state: State, final: State, given_acceleration: bool, time: float, bounds: Bounds) -> Plan:
        """Return the motion from state to final in exactly ``time`` [s]: the quintic when it keeps the limits.

        Otherwise Ruckig's profile stretched to that time, which needs less velocity and acceleration.

        Raises:
            InfeasibleError: neither keeps the limits.
        """
        if not given_acceleration:
            end = pass_acceleration(state[0], state[1], final[0], final[1], time)
            final = (final[0], final[1], max(-bounds.acceleration, min(bounds.acceleration, end)))
        coefficients = quintic(state, final, time)
        reason = fault_of_pass(coefficients, time, bounds)
        if not reason:
            return Plan([(time, *coefficients)], time, final, False)
        try:
            return self._optimal(state, final, bounds, time)
        except InfeasibleError as e:
            raise InfeasibleError(f"the piece of {time:g} s to {final[0]:g} {reason} ({e})") from e

    def _optimal(self, state: State, final: State, bounds: Bounds, exact_s: float | None) -> Plan:
        given = self._input
        begin, end = _with_jumps(state, final, bounds) if bounds.start and exact_s is None else (state, final)
        given.control_interface = POSITION_INTERFACE
        given.target_position = [end[0]]
        given.target_velocity = [end[1]]
        given.target_acceleration = [end[2]]
        given.minimum_duration = exact_s
        segments = self._calculate(begin, bounds) or [(0.0, *final, 0.0, 0.0, 0.0)]
        duration = self._trajectory.duration
        if exact_s is not None:
            if duration > exact_s + TIME_TOLERANCE_S:
                shortest = self._trajectory.independent_min_durations[0]
                raise InfeasibleError(
                    f"time {exact_s:g} s is too short for {state[0]:g} to {final[0]:g}; want at least {shortest:g} s"
                )
            if duration < exact_s:
                segments.append((exact_s - duration, final[0], final[1], 0.5 * final[2], 0.0, 0.0, 0.0))
            duration = exact_s
        extent = self._trajectory.position_extrema[0]
        guard = extent.min < bounds.minimum - 1e-9 or extent.max > bounds.maximum + 1e-9
        return Plan(segments, duration, final, guard)

    def _velocity(self, goal: float, duration: float, state: State, bounds: Bounds) -> Plan:
        given = self._input
        given.control_interface = VELOCITY_INTERFACE
        given.target_velocity = [goal]
        given.target_acceleration = [0.0]
        given.minimum_duration = None
        segments = self._calculate(state, bounds)
        reached = sum(s[0] for s in segments)
        position = _end(segments[-1])[0] if segments else state[0]
        segments.append((math.inf, position, goal, 0.0, 0.0, 0.0, 0.0))
        if math.isinf(duration):
            return Plan(segments, duration, (position, goal, 0.0), True)
        segments = _truncated(segments, duration)
        final = _end(segments[-1])
        return Plan(segments, duration, (final[0], goal, 0.0) if duration >= reached else final, True)

    def _calculate(self, state: State, bounds: Bounds) -> list[Segment]:
        given = self._input
        given.current_position = [state[0]]
        given.current_velocity = [state[1]]
        given.current_acceleration = [state[2]]
        given.max_velocity = [bounds.velocity]
        given.max_jerk = [bounds.jerk]
        reason = ""
        for less in BESIDE_EDGES:
            given.max_acceleration = [bounds.acceleration * (1.0 - less)]
            try:
                result = self._otg.calculate(given, self._trajectory)
            except ruckig.RuckigError as error:
                reason = reason or str(error).replace("\n", " ").replace("[ruckig] ", "").strip()
            except ValueError:  # a result that its Python side has no name for: the duration
                reason = f"no profile of that duration; a move may last {LONGEST_MOVE_S:g} s at most"
            else:
                if result in DONE:
                    break
                reason = reason or f"no profile from velocity {state[1]:g} within the limits ({result.name})"
        else:
            raise InfeasibleError(reason)
        return _segments(self._trajectory.profiles[0][0])


def pass_acceleration(p0: Any, v0: Any, p1: Any, v1: Any, time: Any) -> Any:
    """Return the acceleration with which a timed pass ends when none is commanded (floats or arrays).

    It is that of the cubic through both positions and velocities (0 when it ends at rest): it
    depends on commanded values alone, so pieces of a sampled curve join with continuous
    acceleration and errors do not travel along.
    """
    return (v1 != 0.0) * ((2 * v0 + 4 * v1) / time - 6 * (p1 - p0) / time**2)


def quintic(state: tuple[Any, Any, Any], final: tuple[Any, Any, Any], time: Any) -> tuple[Any, ...]:
    """Return the coefficients c0 .. c5 of the quintic between two states in a time [s] (floats or arrays)."""
    p0, v0, a0 = state
    p1, v1, a1 = final
    d = p1 - p0
    c3 = (10 * d / time - 6 * v0 - 4 * v1) / time**2 - (3 * a0 - a1) / (2 * time)
    c4 = (-15 * d / time + 8 * v0 + 7 * v1) / time**3 + (3 * a0 - 2 * a1) / (2 * time**2)
    c5 = (6 * d / time - 3 * (v0 + v1)) / time**4 - (a0 - a1) / (2 * time**3)
    return p0, v0, 0.5 * a0, c3, c4, c5


def enclosures(c: tuple[Any, ...], t: Any) -> tuple[tuple[Any, ...], tuple[Any, ...], tuple[Any, ...]]:
    """Return the Bernstein coefficients of position, velocity and acceleration over [0, t].

    A polynomial lies between its smallest and its largest Bernstein coefficient, and begins and
    ends at the first and the last. Works on floats and on arrays.
    """
    p0, c1, c2, c3, c4, c5 = c[0], c[1] * t, c[2] * t**2, c[3] * t**3, c[4] * t**4, c[5] * t**5
    position = (
        p0,
        p0 + c1 / 5,
        p0 + 2 * c1 / 5 + c2 / 10,
        p0 + 3 * c1 / 5 + 3 * c2 / 10 + c3 / 10,
        p0 + 4 * c1 / 5 + 3 * c2 / 5 + 2 * c3 / 5 + c4 / 5,
        p0 + c1 + c2 + c3 + c4 + c5,
    )
    velocity = tuple(5 * (position[i + 1] - position[i]) / t for i in range(5))
    acceleration = tuple(4 * (velocity[i + 1] - velocity[i]) / t for i in range(4))
    return position, velocity, acceleration


def leaves(bernstein: tuple[float, ...], low: float, high: float, depth: int = 24) -> bool:
    """Tell whether a polynomial in Bernstein form leaves [low, high]; halves it until that is certain."""
    if max(bernstein) <= high and min(bernstein) >= low:
        return False
    if not low <= bernstein[0] <= high or not low <= bernstein[-1] <= high or depth == 0:
        return True
    left, right, row = [bernstein[0]], [bernstein[-1]], list(bernstein)
    while len(row) > 1:
        row = [0.5 * (a + b) for a, b in pairwise(row)]
        left.append(row[0])
        right.append(row[-1])
    return leaves(tuple(left), low, high, depth - 1) or leaves(tuple(reversed(right)), low, high, depth - 1)


def fault_of_pass(coefficients: tuple[float, ...], time: float, bounds: Bounds) -> str:
    """Return which limit a quintic piece breaks, empty when none."""
    position, velocity, acceleration = enclosures(coefficients, time)
    v, a = bounds.velocity * (1 + 1e-6), bounds.acceleration * (1 + 1e-6)
    if leaves(acceleration, -a, a):
        return f"needs more acceleration than {bounds.acceleration:g}"
    if leaves(velocity, -v, v):
        return f"needs more velocity than {bounds.velocity:g}"
    if leaves(position, bounds.minimum - 1e-9, bounds.maximum + 1e-9):
        return f"leaves the soft limits {bounds.minimum:g} to {bounds.maximum:g}"
    return ""


def _with_jumps(state: State, final: State, bounds: Bounds) -> tuple[State, State]:
    """Return the ends of a stepper's profile: at rest it takes its start velocity at once, and gives it up at once."""
    way = final[0] - state[0]
    jump = math.copysign(min(bounds.start, bounds.velocity), way)
    if way and abs(state[1]) <= bounds.start:
        state = (state[0], jump, 0.0)
    towards = state[1] * way > 0 and state[1] ** 2 <= 2 * bounds.acceleration * abs(way) + bounds.start**2
    if towards and final[1:] == (0.0, 0.0):
        final = (final[0], jump, 0.0)
    return state, final


def _velocity_goal(command: Command, state: State, bounds: Bounds) -> tuple[float, Bounds]:
    """Return the velocity that a v/a/j command drives at, and the bounds on the way there."""
    mode = command.control_mode
    if mode & modes.VELOCITY:
        if mode & modes.ACCELERATION:
            bounds = bounds._replace(acceleration=min(abs(command.acceleration), bounds.acceleration))
        return max(-bounds.velocity, min(bounds.velocity, command.velocity)), bounds
    if mode & modes.ACCELERATION and command.acceleration != 0:
        goal = math.copysign(bounds.velocity, command.acceleration)
        size = min(abs(command.acceleration), bounds.acceleration)
        return goal, bounds._replace(acceleration=size)
    if mode & modes.JERK and command.jerk != 0:
        goal = math.copysign(bounds.velocity, command.jerk)
        return goal, bounds._replace(jerk=min(abs(command.jerk), bounds.jerk))
    if mode & modes.JERK and state[2] != 0:
        goal = math.copysign(bounds.velocity, state[2])
        return goal, bounds._replace(acceleration=abs(state[2]))
    ramp = 0.0 if math.isinf(bounds.jerk) else state[2] * abs(state[2]) / (2 * bounds.jerk)
    return max(-bounds.velocity, min(bounds.velocity, state[1] + ramp)), bounds


def plan_force(command: Command, present: float, limit: float) -> Plan:
    """Return force over time as a plan: a constant, or a ramp up to a limit and on.

    Args:
        command: one of force.
        present: the force that a ramp begins from [N or Nm].
        limit: the largest force, >= 0.
    """
    mode, time = command.control_mode, command.time
    duration = time if mode & modes.TIME and time > 0 else math.inf
    if mode & modes.FORCE:
        level = command.force
        return Plan([(duration, level, 0.0, 0.0, 0.0, 0.0, 0.0)], duration, (level, 0.0, 0.0), True)
    present = max(-limit, min(limit, present))
    rate = command.force_velocity
    goal = math.copysign(limit, rate)
    ramp = (goal - present) / rate if rate else math.inf
    if ramp >= duration:
        end = present + rate * duration if rate else present
        return Plan([(duration, present, rate, 0.0, 0.0, 0.0, 0.0)], duration, (end, 0.0, 0.0), True)
    segments = [(ramp, present, rate, 0.0, 0.0, 0.0, 0.0), (duration - ramp, goal, 0.0, 0.0, 0.0, 0.0, 0.0)]
    return Plan(segments, duration, (goal, 0.0, 0.0), True)


def _segments(profile: ruckig.Profile) -> list[Segment]:
    segments: list[Segment] = []
    for part in (profile.brake, profile, profile.accel):
        durations = part.t
        if not any(durations):
            continue
        p, v, a, j = part.p, part.v, part.a, part.j
        for i, t in enumerate(durations):
            if t > SHORTEST_S:
                cubic = j[i] / 6 if math.isfinite(j[i]) else 0.0
                segments.append((t, p[i], v[i], 0.5 * a[i], cubic, 0.0, 0.0))
    return segments


def _end(segment: Segment) -> State:
    t, c0, c1, c2, c3, c4, c5 = segment
    return (
        c0 + t * (c1 + t * (c2 + t * (c3 + t * (c4 + t * c5)))),
        c1 + t * (2 * c2 + t * (3 * c3 + t * (4 * c4 + t * 5 * c5))),
        2 * c2 + t * (6 * c3 + t * (12 * c4 + t * 20 * c5)),
    )


def _truncated(segments: list[Segment], duration: float) -> list[Segment]:
    kept: list[Segment] = []
    left = duration
    for segment in segments:
        if segment[0] >= left:
            kept.append((left, *segment[1:]))
            break
        kept.append(segment)
        left -= segment[0]
    return kept
