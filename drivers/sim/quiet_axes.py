"""Simulated axes between two events, as steps."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sioms.motion.plan_step import all_idle
from sioms.plant.binary import beams_record
from sioms.plant.motor_step import Motors
from sioms.plant.stepper_step import Steppers
from sioms.sdk.pages import Pages
from sioms.sdk.quiet_step import Page

from .axes_step import SimulatedAxes, advance_axes, brake_axes, rest_axes, tick_axes
from .axes_world import AxesWorld


class QuietAxes:
    """The steps of motors and steppers that move and nothing else (QuietSteps).

    Args:
        world: theirs.
        make_up_ns: how long a tick may make up for turns [ns].
        pages: of the process.
        instants: where steps note theirs.
    """

    tick = staticmethod(tick_axes)
    slack = staticmethod(advance_axes)
    rest = staticmethod(rest_axes)
    stop = staticmethod(brake_axes)

    def __init__(self, world: AxesWorld, make_up_ns: int, pages: Pages, instants: NDArray[np.int64]) -> None:
        self._world = world
        plant, motors, steppers = world.plant, world.servos, world.steppers
        self._beams = beams_record(world.beams, world.bank.n)
        self.record = SimulatedAxes(
            period_ns=world.tick_ns, late_ns=world.late_ns, make_up_ns=make_up_ns, stride=world.stride,
            ahead=0, last_ns=0, found=0, plain=0, idle=0, may_rest=0, still=0, seen=world.seen,
            near=world.near, loop=world.bank.loop, plans=world.bank.plans,
            motors=motors.record if motors else Motors.empty(),
            steppers=steppers.record if steppers else Steppers.empty(), beams=self._beams,
            motor_rows=world.servo_rows, stepper_rows=world.stepper_rows,
            instants=instants, data=plant.data, offset=plant.offset, shown=plant.shown_data,
            flags=plant.flags, shown_flags=plant.shown_flags,
            axes=pages.record(world.axes), plant=pages.record(plant),
            port=pages.record(world.port) if world.port else Page.empty(),
        )  # fmt: skip

    def is_ready(self, watched: bool, awaited: bool = False) -> bool:
        """Tell whether nothing but motion is to be expected."""
        world, record = self._world, self.record
        world.bank.plans.awaited = awaited
        if world.ahead > 1 or world.found or not world.plant.is_plain:
            return False
        if not world.bank.is_quiet() and not (world.plan_early() and world.bank.is_quiet()):
            return False
        for k, beam in enumerate(world.beams):
            if beam.positions is None:
                return False
            self._beams.broken[k], self._beams.looked_ns = beam.broken, beam.stamp_ns
            for coordinate, position in enumerate(beam.positions):
                self._beams.before[coordinate] = position
        record.ahead, record.last_ns, record.found = world.ahead, world.last_ns, 0
        record.still = world.is_still
        record.plain, record.idle = not world.has_effects, all_idle(world.bank.plans)
        record.may_rest = not watched and record.plain
        return True

    def resume(self) -> None:
        """Go on from where the steps have come."""
        world, record = self._world, self.record
        world.ahead, world.last_ns, world.found = record.ahead, record.last_ns, record.found
        world.is_still = bool(record.still)
        for beam in world.beams:
            beam.pass_over([self._beams.before[i] for i in range(self._beams.m)], self._beams.looked_ns)
        world.bank.after_quiet()
