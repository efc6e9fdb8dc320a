"""Simulated axes between two events, as steps."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from sioms.plant.binary import beams_record
from sioms.plant.motor_step import Motors
from sioms.plant.stepper_step import Steppers
from sioms.sdk.pages import Pages
from sioms.sdk.quiet_step import Page

from .axes_step import SimulatedAxes, advance_axes, brake_axes, rest_axes, tick_axes

if TYPE_CHECKING:
    from .axes import SimAxes


class QuietAxes:
    """The steps of motors and steppers that move and nothing else (QuietSteps).

    Args:
        driver: theirs.
        pages: of the process.
        instants: where steps note theirs.
    """

    tick = staticmethod(tick_axes)
    slack = staticmethod(advance_axes)
    rest = staticmethod(rest_axes)
    stop = staticmethod(brake_axes)

    def __init__(self, driver: SimAxes, pages: Pages, instants: NDArray[np.int64]) -> None:
        self._driver, self._axes, self._plant = driver, driver._axes, driver._plant
        plant, motors, steppers = self._plant, driver._servos, driver._steppers
        self._beams = beams_record(driver._beams, driver.bank.n)
        self.record = SimulatedAxes(
            period_ns=driver._tick_ns, late_ns=driver._late_ns, make_up_ns=driver.make_up_ns, stride=driver._stride,
            ahead=0, last_ns=0, found=0, plain=0, idle=0, may_rest=0, still=0, seen=driver._seen,
            near=driver._near, loop=driver.bank.loop, stopping=driver.bank.stopping,
            motors=motors.record if motors else Motors.empty(),
            steppers=steppers.record if steppers else Steppers.empty(), beams=self._beams,
            motor_rows=driver._servo_rows, stepper_rows=driver._stepper_rows,
            instants=instants, data=plant.data, offset=plant.offset, shown=plant.shown_data,
            flags=plant.flags, shown_flags=plant.shown_flags,
            axes=pages.record(self._axes), plant=pages.record(plant),
            port=pages.record(driver._port) if driver._port else Page.empty(),
        )  # fmt: skip

    def is_ready(self, watched: bool) -> bool:
        """Tell whether nothing but motion is to be expected."""
        driver, record = self._driver, self.record
        if driver._ahead > 1 or driver._found or not self._plant.is_plain:
            return False
        if not driver.bank.is_quiet() and not (driver.plan_early() and driver.bank.is_quiet()):
            return False
        for k, beam in enumerate(driver._beams):
            if beam.positions is None:
                return False
            self._beams.broken[k], self._beams.looked_ns = beam.broken, beam.stamp_ns
            for coordinate, position in enumerate(beam.positions):
                self._beams.before[coordinate] = position
        record.ahead, record.last_ns, record.found = driver._ahead, driver._last_ns, 0
        record.still = driver._is_still
        record.plain, record.idle = not driver._has_effects, driver.bank.is_idle(driver._all)
        record.may_rest = not watched and record.plain
        return True

    def resume(self) -> None:
        """Go on from where the steps have come."""
        driver, record = self._driver, self.record
        driver._ahead, driver._last_ns, driver._found = record.ahead, record.last_ns, record.found
        driver._is_still = bool(record.still)
        for beam in driver._beams:
            beam.pass_over([self._beams.before[i] for i in range(self._beams.m)], self._beams.looked_ns)
        driver.bank.after_quiet()
