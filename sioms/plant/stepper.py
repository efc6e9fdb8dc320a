"""A bank of stepper motors driven by position, with a rotor that can fall out of step.

The windings turn a field to the commanded position, in microsteps; the rotor hangs on it as on a
sine-shaped spring whose period is four full steps (the electrical turn). The holding force falls
with the speed of the field above a corner, as the current does in the winding's inductance. So
pull-out, lost steps in multiples of four, a rotor that stays stalled while the field runs and locks
again once it stops follow from the physics; nothing is switched by hand.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .friction import Directed, FrictionStep

Array = NDArray[np.float64]

MAX_SUBSTEPS = 64
_PHASE_STEP = 0.5


@dataclass(frozen=True, slots=True)
class Stepper:
    """One stepper motor and its axis; force is N or N m, position m or rad, mass kg or kg m^2.

    Args:
        mass: moving mass or inertia.
        step: a full step [m or rad].
        microsteps: microsteps in a full step.
        hold_force: holding force at rest [N].
        corner_velocity: field velocity from which the force falls [m/s].
        coulomb: dry friction [N].
        damping_ratio: of the rotor's oscillation about the field, by viscous friction.
        load_force: constant force [N].
        limit_minus, limit_plus: the limit switches are on at and beyond these.
        home: the home switch is on at positions at and below this.
        start: true position at the start, where the field is too.
        encoder_step: resolution of an encoder on the rotor [m or rad]; 0: there is none.
    """

    mass: float
    step: float
    microsteps: int = 16
    hold_force: float = 1.0
    corner_velocity: float = math.inf
    coulomb: float = 0.0
    damping_ratio: float = 0.1
    load_force: float = 0.0
    limit_minus: float = -math.inf
    limit_plus: float = math.inf
    home: float = -math.inf
    start: float = 0.0
    encoder_step: float = 0.0

    @property
    def stiffness(self) -> float:
        """Stiffness of the rotor about the resting field [N/m]."""
        return self.hold_force * math.pi / (2 * self.step)


class StepperBank:
    """Steps n stepper motors by one tick at a time.

    Args:
        steppers: their parameters.
        tick_s: duration of a tick [s].
        substeps: least number of substeps of a tick; raised where the rotor's oscillation demands it.

    Raises:
        ValueError: a parameter out of its range.

    Attributes (shape (n,), overwritten by each tick):
        position, velocity: true motion of the rotor [m, m/s].
        field: where the field is [m].
        reading: what the drive knows [m]: the encoder's position, without one that of the field.
        stalled: the rotor is out of step with the field.
        lost_steps: full steps the rotor is behind the field since the start, counted when a stall ends.
        at_limit_minus, at_limit_plus, at_home: switches, at the true position.
    """

    def __init__(self, steppers: Sequence[Stepper], tick_s: float, substeps: int = 4) -> None:
        _check(steppers, tick_s)
        n = len(steppers)
        mass, self._step = _column(steppers, "mass"), _column(steppers, "step")
        stiffness = _column(steppers, "stiffness")
        self._rate = np.sqrt(stiffness / mass)
        rate = float(self._rate.max())
        self.substeps = max(substeps, math.ceil(rate * tick_s / _PHASE_STEP))
        if self.substeps > MAX_SUBSTEPS:
            raise ValueError(
                f"build steppers: rotor oscillation of {rate:.3g} rad/s needs {self.substeps} substeps of a "
                f"{tick_s:g} s tick; must be at most {MAX_SUBSTEPS}: more mass, less hold_force, a shorter tick"
            )
        viscous = 2 * _column(steppers, "damping_ratio") * np.sqrt(stiffness * mass)
        sliding = Directed.both(_column(steppers, "coulomb"))
        self._tick_s, self._substep_s = tick_s, tick_s / self.substeps
        self._state = np.zeros((2, n))
        self.velocity, self.position = self._state
        self.position[:] = _column(steppers, "start")
        self._rotor = FrictionStep(self._state, mass, Directed.both(viscous), sliding, sliding, self._substep_s)
        self._viscous, self._damping_of_move = viscous, viscous / tick_s
        self._micro = self._step / _column(steppers, "microsteps")
        self._wave_number = math.pi / (2 * self._step)
        self._hold, self._load = _column(steppers, "hold_force"), _column(steppers, "load_force")
        self._per_corner = 1 / _column(steppers, "corner_velocity")
        self.field = np.round(self.position / self._micro) * self._micro
        self._encoder_step = _column(steppers, "encoder_step")
        self._encoded = np.flatnonzero(self._encoder_step)
        self.reading = self.field.copy()
        self._switches = [_column(steppers, name) for name in ("limit_minus", "limit_plus", "home")]
        self.at_limit_minus, self.at_limit_plus, self.at_home = np.zeros((3, n), dtype=np.bool_)
        self.stalled, self._flag = np.zeros((2, n), dtype=np.bool_)
        self._in_step = np.ones(n)
        self._rested = False
        self.lost_steps = np.zeros(n)
        self._goal, self._move, self._field, self._force, self._work, self._strength = np.zeros((6, n))
        self._sense()

    def advance(self, position: Array) -> None:
        """Turn the fields to a commanded position [m or rad], shape (n,), evenly over one tick."""
        goal, move = self._goal, self._move
        np.divide(position, self._micro, out=goal)
        np.round(goal, out=goal)
        np.multiply(goal, self._micro, out=goal)
        np.subtract(goal, self.field, out=move)
        # Rotors that rest on a resting field stay there: their force stays below stiction.
        if np.count_nonzero(move) or np.count_nonzero(self.velocity) or not self._rested:
            self._turn()
        self._rested = not np.count_nonzero(move)
        np.copyto(self.field, goal)
        self._sense()

    def _turn(self) -> None:
        """Turn the fields by the move, with the force left at its speed: 1/sqrt(1 + (v/corner)^2)."""
        work = self._work
        np.multiply(self._move, self._per_corner, out=work)
        np.divide(work, self._tick_s, out=work)
        np.multiply(work, work, out=work)
        np.add(work, 1.0, out=work)
        np.sqrt(work, out=work)
        np.divide(self._hold, work, out=self._strength)
        for index in range(self.substeps):
            self._substep((index + 0.5) / self.substeps)

    def _substep(self, share: float) -> None:
        """Step the rotors under the field at the middle of the substep."""
        field, force, work = self._field, self._force, self._work
        np.multiply(self._move, share, out=field)
        np.add(field, self.field, out=field)
        np.multiply(self.velocity, self._substep_s / 2, out=force)
        np.add(force, self.position, out=force)
        np.subtract(field, force, out=force)
        np.multiply(force, self._wave_number, out=force)
        # Mean of the sine over the substep: no false locking where the field slips far in one.
        np.multiply(self._move, self._wave_number / (2 * self.substeps), out=work)
        np.multiply(self.velocity, self._wave_number * self._substep_s / 2, out=field)
        np.subtract(work, field, out=work)
        np.divide(work, math.pi, out=work)
        np.sin(force, out=force)
        np.multiply(force, np.sinc(work), out=force)
        np.multiply(force, self._strength, out=force)
        np.add(force, self._load, out=force)
        self._damp_against_field()
        self._rotor.step(force)

    def _damp_against_field(self) -> None:
        """Damp rotors in step against the field, with its force at most, instead of against the ground.

        The friction step brakes by b v; adding clip(b (v_field - v)) + b v leaves the clipped part.
        """
        brake, relative = self._field, self._work
        np.multiply(self.velocity, self._viscous, out=brake)
        np.multiply(self._move, self._damping_of_move, out=relative)
        np.subtract(relative, brake, out=relative)
        np.minimum(relative, self._strength, out=relative)
        np.add(brake, relative, out=brake)
        np.add(relative, self._strength, out=relative)
        np.minimum(relative, 0.0, out=relative)
        np.subtract(brake, relative, out=brake)
        np.multiply(brake, self._in_step, out=brake)
        np.add(self._force, brake, out=self._force)

    def _sense(self) -> None:
        """Set reading, step loss and switches."""
        np.copyto(self.reading, self.field)
        if self._encoded.size:
            rows, step = self._encoded, self._encoder_step[self._encoded]
            self.reading[rows] = np.round(self.position[rows] / step) * step
        lag, work = self._field, self._work
        np.subtract(self.field, self.position, out=lag)
        np.divide(lag, self._step, out=lag)
        np.subtract(lag, self.lost_steps, out=work)
        np.abs(work, out=work)
        # Half an electrical turn behind: the field pulls backwards.
        np.greater(work, 2.0, out=self._flag)
        np.logical_or(self.stalled, self._flag, out=self.stalled)
        if np.count_nonzero(self.stalled):
            self._lock_again(lag)
        minus, plus, home = self._switches
        np.less_equal(self.position, minus, out=self.at_limit_minus)
        np.greater_equal(self.position, plus, out=self.at_limit_plus)
        np.less_equal(self.position, home, out=self.at_home)

    def _lock_again(self, lag: Array) -> None:
        """End the stall of rotors that rest under a resting field; the steps behind it are lost."""
        calm = np.abs(self.velocity) < 0.1 * self._step * self._rate
        locked = self.stalled & (self._move == 0.0) & calm
        self.stalled[locked] = False
        self.lost_steps[locked] = 4 * np.round(lag[locked] / 4)
        np.logical_not(self.stalled, out=self._in_step)


def _column(steppers: Sequence[Stepper], name: str) -> Array:
    return np.array([getattr(stepper, name) for stepper in steppers], dtype=np.float64)


def _check(steppers: Sequence[Stepper], tick_s: float) -> None:
    if not steppers or not 0 < tick_s < 1:
        raise ValueError(f"build steppers: {len(steppers)} motors, tick {tick_s:g} s; want 1 or more, and 0 to 1 s")
    for axis, motor in enumerate(steppers):
        for name in ("mass", "step", "microsteps", "hold_force", "corner_velocity"):
            value = getattr(motor, name)
            if not value > 0:
                raise ValueError(f"build stepper {axis}: {name} {value:g}; must be positive")
        if not motor.encoder_step >= 0:
            raise ValueError(f"build stepper {axis}: encoder_step {motor.encoder_step:g}; must be 0 or more")
        if not 0 <= motor.coulomb + abs(motor.load_force) < motor.hold_force or motor.damping_ratio < 0:
            raise ValueError(
                f"build stepper {axis}: coulomb {motor.coulomb:g}, load_force {motor.load_force:g}, damping_ratio "
                f"{motor.damping_ratio:g}; friction and load must stay below hold_force {motor.hold_force:g}"
            )
