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
from .stepper_step import Steppers, know, turn

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
        state = np.zeros((2, n))
        self.velocity, self.position = state
        self.position[:] = _column(steppers, "start")
        rotors = FrictionStep(state, mass, Directed.both(viscous), sliding, sliding, tick_s / self.substeps)
        micro = self._step / _column(steppers, "microsteps")
        self.field = np.round(self.position / micro) * micro
        self.reading, self.lost_steps, self._goal = self.field.copy(), np.zeros(n), np.zeros(n)
        self.at_limit_minus, self.at_limit_plus, self.at_home, self.stalled = np.zeros((4, n), dtype=np.bool_)
        self.record = Steppers(
            n=n, substeps=self.substeps, substep_s=tick_s / self.substeps, tick_s=tick_s, rested=0,
            rotors=rotors.record, goal=self._goal, field=self.field, move=np.zeros(n), strength=np.zeros(n),
            position=self.position, velocity=self.velocity, micro=micro, full_step=self._step,
            wave_number=math.pi / (2 * self._step), hold=_column(steppers, "hold_force"),
            load_force=_column(steppers, "load_force"), per_corner=1 / _column(steppers, "corner_velocity"),
            viscous=viscous, rate=self._rate, encoder_step=_column(steppers, "encoder_step"), reading=self.reading,
            stalled=self.stalled, lost_steps=self.lost_steps,
            limit_minus=_column(steppers, "limit_minus"), limit_plus=_column(steppers, "limit_plus"),
            home=_column(steppers, "home"), at_minus=self.at_limit_minus, at_plus=self.at_limit_plus,
            at_home=self.at_home,
        )  # fmt: skip
        know(self.record)

    def advance(self, position: Array) -> None:
        """Turn the fields to a commanded position [m or rad], shape (n,), evenly over one tick."""
        np.copyto(self._goal, position)
        turn(self.record)


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
