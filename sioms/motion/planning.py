"""Planning: the plan of a single command under the limits in force, and what the command puts in force as it begins.

Concurrency: that of the bank.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

from . import modes
from .arrival import Approach, plan_point
from .axis_step import FORCE, POSITION, RATE
from .commands import Command, is_point_move
from .law import ControlLaw
from .profile import Bounds, InfeasibleError, Plan, Planner, State, plan_force
from .queue import CommandQueue
from .settings import AxisSettings
from .store import PlanStore


class Planned(NamedTuple):
    """The plan of a command and its kind; whether the play is taken up at its end, and that is to be looked at."""

    plan: Plan
    kind: int
    taken: bool
    looked_at: bool


class Planning:
    """Plans commands of n axes.

    Args:
        settings: one per axis.
        queue: whose limits are in force.
        store: what the axes do now.
        law: where gains, offset and force limit of a command are put in force.
    """

    def __init__(
        self, settings: Sequence[AxisSettings], queue: CommandQueue, store: PlanStore, law: ControlLaw
    ) -> None:
        self._planner = Planner()
        self._limits, self._store, self._law = queue.limits, store, law
        self._velocity_limit, self._acceleration_limit = queue.in_force
        self._approaches = [Approach.of(s) for s in settings]
        self._start_velocity = [s.start_velocity for s in settings]

    def planned(self, axis: int, command: Command, state: State, taken: bool) -> Planned:
        """Return the plan of a command.

        Args:
            axis: whose.
            command: what is asked for.
            state: in which it begins.
            taken: the play of the axis is taken up, if it stands there.

        Raises:
            InfeasibleError: it is not possible.
        """
        mode = command.control_mode
        if mode & modes.ANY_FORCE:
            return Planned(self._plan_force(axis, command), FORCE, False, False)
        bounds, approach = self._bounds(axis, command), self._approaches[axis] if is_point_move(mode) else None
        if approach is not None:
            plan, taken, looked_at = plan_point(self._planner, command, state, bounds, approach, taken)
            return Planned(plan, POSITION, taken, looked_at)
        plan = self._planner.plan(command, state, bounds)
        return Planned(plan, POSITION if mode & modes.POSITION else RATE, False, False)

    def planned_again(self, axis: int, command: Command, measured: float, target: float, taken: bool) -> Planned | None:
        """Return the plan of a point move to its target from where the axis is measured to be, None where it has none.

        Raises:
            InfeasibleError: it is not possible.
        """
        approach = self._approaches[axis]
        if approach is None:
            return None
        command = command._replace(position=target, control_mode=command.control_mode & ~modes.RELATIVE)
        bounds, start = self._bounds(axis, command), (measured, 0.0, 0.0)
        plan = plan_point(self._planner, command, start, bounds, approach._replace(deadband=0.0), taken)
        return Planned(plan[0], POSITION, plan[1], plan[2])

    def drive(self, axis: int, velocity: float, state: State) -> Plan:
        """Return the plan that goes over to a velocity, outside the soft limits."""
        command = Command._make([0.0] * len(Command._fields))
        command = command._replace(control_mode=modes.VELOCITY, velocity=velocity)
        bounds = self._bounds(axis, command)._replace(minimum=-math.inf, maximum=math.inf)
        return self._planner.plan(command, state, bounds)

    def recalled(self, axis: int, command: Command, state: State, now_ns: int) -> float:
        """Return where a command begins now on an axis that the configured gains have held in this state."""
        place, v, a = state
        mode, low, high = command.control_mode, self._limits.minimum.item(axis), self._limits.maximum.item(axis)
        gains = (command.k, command.kz, command.kp, command.kb) if mode & modes.GAINS else None
        offset = command.force_offset if mode & modes.FORCE_OFFSET else None
        begins = self._law.recalled(axis, place, now_ns, gains, offset)
        begins = min(max(begins, min(place, low)), max(place, high))
        try:
            self.planned(axis, command, (begins, v, a), False)
        except InfeasibleError:  # it has been acknowledged for where the set-point was
            return place
        return begins

    def put_in_force(self, axis: int, command: Command | None) -> None:
        """Put the gains, offset and limits that a command specifies in force; they stay."""
        if command is None:
            return
        law, mode = self._law, command.control_mode
        if mode & modes.GAINS:
            law.command_gains(axis, (command.k, command.kz, command.kp, command.kb))
        if mode & modes.FORCE_OFFSET:
            law.offset[axis] = command.force_offset
        if mode & modes.MAX_FORCE:
            law.command_force(axis, command.max_force)
        if mode & modes.MAX_VEL_ACC:
            self._velocity_limit[axis] = command.max_velocity
            self._acceleration_limit[axis] = command.max_acceleration
            if law.kind[axis] == FORCE:
                law.speed_most[axis] = command.max_velocity

    def _bounds(self, axis: int, command: Command) -> Bounds:
        limits = self._limits
        if command.control_mode & modes.MAX_VEL_ACC:
            velocity, acceleration = command.max_velocity, command.max_acceleration
        else:
            velocity, acceleration = self._velocity_limit.item(axis), self._acceleration_limit.item(axis)
        jerk, low, high = limits.jerk.item(axis), limits.minimum.item(axis), limits.maximum.item(axis)
        return Bounds(velocity, acceleration, jerk, low, high, self._start_velocity[axis])

    def _plan_force(self, axis: int, command: Command) -> Plan:
        law, store = self._law, self._store
        limit = command.max_force if command.control_mode & modes.MAX_FORCE else law.commanded_force(axis)
        present = store.final[store.row[axis], 0] if law.kind[axis] == FORCE else law.output[axis]
        return plan_force(command, float(present), limit)
