"""The world of simulated axes: motors, steppers and beams, the bank that moves them, and how far they have come.

Its own part of a tick is here; what a driver publishes, and when, is not.

Concurrency: one thread.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from sioms.motion import SWITCH_HOME, SWITCH_MINUS, SWITCH_PLUS, AxisBank, AxisKind
from sioms.motion.types import MarkerPort
from sioms.plant.binary import Beam
from sioms.plant.motor import MotorBank
from sioms.plant.stepper import StepperBank
from sioms.protocol.flags import AxisStatus
from sioms.sdk.blocks import AnalogBlock, AxisBlock, BinaryBlock
from sioms.sdk.driver import InputNode

from .axes_table import Built, SimAxesSettings, axes_of, boxes, describe, late_max_s, stride
from .borne import Borne

# A profile takes some 20 us to plan; few at a time, so that a plan never delays a tick.
_PLANS, _SLACK_NS = 8, 300_000

_FAULT = int(AxisStatus.FAULT)

Array = NDArray[np.float64]


class AxesWorld:
    """Motors and steppers under their bank.

    Args:
        settings: of the device.
        built: what these make: plants, and settings of the bank.
        markers: that commands may signal.
        inputs: returns a node that tells loads, by its name.

    Attributes:
        bank: the motion bank.
        axes: its block.
        plant: block of what the world feels of the axes.
        port: block of the beams; None without any.
        inputs_ns: when the axes were measured last [ns].
        borne: loads that nodes tell; None without any.
        tick_ns: period of the bank [ns].
        late_ns: a later tick stops all motion [ns].
        stride: how many ticks may be made up for at once.
        command: what the bank has commanded last; None before its first tick.
        last_ns: where the world is [ns]: it goes by whole ticks.
        ahead: by how many ticks it has gone on beyond that.
        is_still: whether turns that are left out change nothing.
        found: what the steps have found in a tick that they have begun.
        seen, near: the command of the tick before, and how near the next must be to be the same.
    """

    def __init__(
        self, settings: SimAxesSettings, built: Built, markers: MarkerPort, inputs: Callable[[str], InputNode]
    ) -> None:
        axes, plant, *port = describe(settings).blocks
        self.servos, self.steppers, configured = built
        tick_s = 1 / settings.tick_hz
        self.tick_ns = round(1e9 / settings.tick_hz)
        self.bank = AxisBank(
            configured,
            tick_s=tick_s,
            markers=markers,
            capacity=settings.capacity,
            late_max_s=late_max_s(settings),
            makes_up=lambda: self.command is not None,
            leaves_out=self.leave_out_still,
        )
        self.axes, self.plant = AxisBlock(axes, self.bank), AnalogBlock(plant)
        self.port = BinaryBlock(port[0]) if port else None
        self.beams = [Beam(each) for each in boxes(settings)]
        n = len(configured)
        stepper = np.array([axis.kind is AxisKind.STEPPER for axis in configured])
        self.servo_rows, self.stepper_rows = np.flatnonzero(~stepper), np.flatnonzero(stepper)
        servos = [axis for axis in axes_of(settings) if axis.motor is not None]
        borne = None
        if self.servos is not None:
            borne = Borne(self.servos, servos, settings.carries, settings.world_age_max_s, tick_s, inputs)
        self.borne = borne if borne is not None and borne.any else None
        self.all = np.arange(n)
        self.late_ns = int(late_max_s(settings) * 1e9)
        self.stride = min(stride(axis, tick_s) for axis in settings.axis)
        self.has_effects = bool(settings.effects or settings.effects_file or any(a.model_file for a in settings.axis))
        self._reading = np.zeros(n)
        self._switches = np.zeros(n, dtype=np.int64)
        self.command: Array | None = None
        self.last_ns = self.inputs_ns = self.ahead = self.found = 0
        self.is_still = False
        self.seen = np.full(n, np.nan)
        # A stepper's command, and one with an integral in it, goes on if it does so at all; others only come to rest.
        self.near = np.array([0.0 if s.kind is AxisKind.STEPPER or s.ki else 1e-9 * s.force_max for s in configured])

    def bear(self, now_ns: int) -> None:
        """Take the loads; where they are not known any more, or not while axes are to move, all are in fault."""
        if self.borne is None:
            return
        was_known = self.borne.is_known
        why = self.borne.take(now_ns)
        if why and (was_known or not self.bank.is_idle(self.all)):
            fresh = np.flatnonzero((self.bank.arrays["latched"] & _FAULT) == 0)
            if fresh.size:
                self.bank.fault(fresh, why, now_ns)

    def leave_out_still(self, now_ns: int) -> int:
        """Leave out the ticks before now of a world that stands still, as they change nothing; return their time [ns].

        A verb does so before it acts: the tick behind it may be that of an instant long before, and what it begins is
        made up for from then on. The world keeps to its grid of ticks.
        """
        if not self.is_still:
            return 0
        self.is_still = False
        left_ns = max(0, now_ns - self.last_ns) // self.tick_ns * self.tick_ns
        self.last_ns += left_ns
        return left_ns

    def leave_out(self, now_ns: int) -> int:
        """Leave out the ticks that change nothing; return how many the world is behind then."""
        self.leave_out_still(now_ns - self.tick_ns)
        behind = round((now_ns - self.last_ns) / self.tick_ns) if self.command is not None else 0
        if behind > self.stride and self.is_at_rest():  # nor do those that were missed
            self.last_ns, behind, self.is_still = self.last_ns + (behind - 1) * self.tick_ns, 1, False
        return behind

    def turn(self, now_ns: int, ticks: int) -> bool:
        """Go on by some ticks, measure, and command anew; return whether beams may be looked at.

        Where the world is not at a whole tick it is read as it would be by then, and no beam is looked at.
        """
        beside_ns = 0
        if self.command is not None:
            for _ in range(self.ahead, min(ticks, self.stride)):  # what is later than may be made up for stands still
                self._advance(self.command)
            self.ahead = max(0, self.ahead - ticks)
            beside_ns = now_ns - self.last_ns - ticks * self.tick_ns
        if 20 * abs(beside_ns) < self.tick_ns or abs(beside_ns) > self.tick_ns:
            beside_ns = 0
        self.last_ns = now_ns - beside_ns  # where the world is: it goes by whole ticks, also when one came early
        self._measure()
        if beside_ns:
            self._shift(beside_ns * 1e-9)
        self.inputs_ns = time.monotonic_ns()
        self.command = self.bank.tick(now_ns, self._reading, self._switches)
        self.show()
        return not beside_ns

    def finish(self, found: int) -> None:
        """Finish a turn that steps have begun, with what they have found."""
        self.command = self.bank.finish_tick(found)
        self.show()

    def slack(self, until_ns: int) -> None:
        """Go on to the next tick, at ``until_ns``, which is sooner done then, and plan profiles while there is time."""
        if self.command is not None and not self.ahead:
            self._advance(self.command)
            self.ahead = 1
        if until_ns - time.monotonic_ns() > _SLACK_NS:
            self.bank.plan_ahead(_PLANS)

    def plan_early(self) -> bool:
        """Plan profiles ahead long before the next tick, or when that is late anyway; return whether there were any.

        Without the plans the late tick, and all after it, would be the loop's, and later still. Where ticks are always
        as near as that, each would be.
        """
        left_ns = self.last_ns + self.tick_ns - time.monotonic_ns()
        near_ns = 2 * _SLACK_NS if self.tick_ns > 2 * _SLACK_NS else self.tick_ns // 10
        return not 0 <= left_ns <= near_ns and self.bank.plan_ahead(_PLANS) > 0

    def is_at_rest(self) -> bool:
        """Whether world and command are at a fixed point; turns that are left out then need not be made up for."""
        if self.command is None or self.has_effects or self.borne is not None:
            return False
        with np.errstate(invalid="ignore"):
            still = bool((np.abs(self.command - self.seen) <= self.near).all())
        self.seen[:] = self.command
        worlds = [world for world in (self.servos, self.steppers) if world is not None]
        still = still and not any(np.count_nonzero(world.velocity) for world in worlds)
        self.is_still = still and self.bank.is_idle(self.all)
        return self.is_still

    def _advance(self, command: Array) -> None:
        motors = self.servos
        if motors is not None:
            forces = command[self.servo_rows]
            if self.borne is not None:
                self.borne.press(forces, self.bank.arrays["limp"][self.servo_rows])
            motors.advance(forces)
        if self.steppers is not None:
            self.steppers.advance(command[self.stepper_rows])

    def _measure(self) -> None:
        if self.servos is not None:
            self._reading[self.servo_rows] = self.servos.encoder.position
            self._switches[self.servo_rows] = _switch_bits(self.servos)
        if self.steppers is not None:
            self._reading[self.stepper_rows] = self.steppers.reading
            self._switches[self.stepper_rows] = _switch_bits(self.steppers)

    def _shift(self, by_s: float) -> None:
        """Let a tick that came early read what would be read by then."""
        if self.servos is not None:
            self._reading[self.servo_rows] += self.servos.velocity * by_s
        if self.steppers is not None:
            self._reading[self.stepper_rows] += self.steppers.velocity * by_s

    def show(self) -> None:
        """Let the plant tell where the loads are."""
        data = self.plant.data.reshape(-1, 2)
        if self.servos is not None:
            data[self.servo_rows, 0] = self.servos.load_position
            data[self.servo_rows, 1] = self.servos.contact_force
        if self.steppers is not None:
            data[self.stepper_rows, 0] = self.steppers.position


def _switch_bits(bank: MotorBank | StepperBank) -> NDArray[np.int64]:
    bits: NDArray[np.int64] = bank.at_limit_minus * SWITCH_MINUS
    bits += bank.at_limit_plus * SWITCH_PLUS
    bits += bank.at_home * SWITCH_HOME
    return bits
