"""Forces on an axis as functions of its state: the effects of places MOTOR, LOAD and RESISTANCE, and walls.

Each force object adds to an array in place and is vectorised over all axes of a bank; an axis that
does not have the effect has neutral numbers. Resistances are levels of dry friction, at least 0: the
friction step applies them against the motion, so that however large they are they stop an axis and
never drive it.
"""

import math
from collections.abc import Callable
from typing import Protocol

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from .effects import Effect

Array = NDArray[np.float64]


class Motion(Struct, frozen=True):
    """What a force may depend on, at the mid-point of a substep, shape (n,) each, filled by the bank.

    Args:
        position, velocity: of the motor.
        load_position, load_velocity: of the load, the same arrays where no transmission gives.
        drive: force of the drive.
        variation: factor on dry friction; None where it varies on no axis.
    """

    position: Array
    velocity: Array
    load_position: Array
    load_velocity: Array
    drive: Array
    variation: Array | None = None


def middle_velocity(velocity: Array, last: Array, flag: NDArray[np.bool_], out: Array) -> None:
    """Extrapolate half a substep by the last change; never through zero, and zero at rest.

    Uses last and flag as work arrays.
    """
    np.subtract(velocity, last, out=out)
    np.multiply(out, 0.5, out=out)
    np.add(out, velocity, out=out)
    np.multiply(out, velocity, out=last)
    np.less_equal(last, 0.0, out=flag)
    np.copyto(out, 0.0, where=flag)


class Force(Protocol):
    """Adds a force, or a resistance."""

    def add(self, motion: Motion, total: Array) -> None:
        """Add to total [N], shape (n,)."""


class _Periodic:
    """sin(2 pi x/pitch + phase) of all axes."""

    def __init__(self, effect: Effect) -> None:
        self._wave_number = 2 * math.pi / effect.values["pitch"]
        self._phase = effect.values["phase"]
        self._work = np.zeros_like(self._phase)

    def sine(self, position: Array) -> Array:
        """Return the sine; the array is reused."""
        work = self._work
        np.multiply(position, self._wave_number, out=work)
        np.add(work, self._phase, out=work)
        return np.sin(work, out=work)


class Cogging(_Periodic):
    """Adds amplitude sin(2 pi x/pitch + phase)."""

    def __init__(self, effect: Effect, substep_s: float) -> None:
        super().__init__(effect)
        self._amplitude = effect.values["amplitude"]

    def add(self, motion: Motion, total: Array) -> None:
        """Add the force at the motor's position."""
        sine = self.sine(motion.position)
        np.multiply(sine, self._amplitude, out=sine)
        np.add(total, sine, out=total)


class Gravity(Cogging):
    """Adds the pendulum force -amplitude sin(2 pi x/pitch + phase) at the load's position."""

    def add(self, motion: Motion, total: Array) -> None:
        """Add the force."""
        sine = self.sine(motion.load_position)
        np.multiply(sine, self._amplitude, out=sine)
        np.subtract(total, sine, out=total)


class TorqueRipple(_Periodic):
    """Adds drive force x depth sin(2 pi x/pitch + phase)."""

    def __init__(self, effect: Effect, substep_s: float) -> None:
        super().__init__(effect)
        self._depth = effect.values["depth"]

    def add(self, motion: Motion, total: Array) -> None:
        """Add the deviation of the drive's force."""
        sine = self.sine(motion.position)
        np.multiply(sine, self._depth, out=sine)
        np.multiply(sine, motion.drive, out=sine)
        np.add(total, sine, out=total)


class Spring:
    """Adds -k d - k3 d^3, d the load's displacement from rest."""

    def __init__(self, effect: Effect, substep_s: float) -> None:
        self._values = effect.values
        self._work, self._force = np.zeros((2, effect.active.size))

    def add(self, motion: Motion, total: Array) -> None:
        """Add the force."""
        values, work, force = self._values, self._work, self._force
        np.subtract(motion.load_position, values["rest"], out=work)
        np.multiply(work, work, out=force)
        np.multiply(force, values["cubic"], out=force)
        np.add(force, values["stiffness"], out=force)
        np.multiply(force, work, out=force)
        np.subtract(total, force, out=total)


class Presliding:
    """LuGre friction without its damping, Dahl's where the level does not rise: relaxed exactly at the velocity of the
    substep.
    """

    def __init__(self, effect: Effect, substep_s: float) -> None:
        self._level, self._rise = effect.values["level"], effect.values["rise"]
        self._inverse = 1 / effect.values["velocity"]
        self._rate = np.where(effect.active, substep_s * effect.values["stiffness"], 0.0)
        self._force, self._goal, self._decay = np.zeros((3, effect.active.size))

    def add(self, motion: Motion, total: Array) -> None:
        """Relax towards the level in the direction of motion and add the friction."""
        force, goal, decay = self._force, self._goal, self._decay
        np.multiply(motion.velocity, self._inverse, out=goal)
        np.multiply(goal, goal, out=goal)
        np.negative(goal, out=goal)
        np.exp(goal, out=goal)
        np.multiply(goal, self._rise, out=goal)
        np.add(goal, self._level, out=goal)
        np.maximum(goal, 0.0, out=goal)  # a rise below minus the level would drive
        if motion.variation is not None:  # of the level; the stiffness stays
            np.multiply(goal, motion.variation, out=goal)
        np.abs(motion.velocity, out=decay)
        np.multiply(decay, self._rate, out=decay)
        np.divide(decay, goal, out=decay, where=goal > 0.0)
        np.negative(decay, out=decay)
        np.exp(decay, out=decay)
        np.copysign(goal, motion.velocity, out=goal)
        np.subtract(force, goal, out=force)
        np.multiply(force, decay, out=force)
        np.add(force, goal, out=force)
        np.subtract(total, force, out=total)


class Stribeck:
    """Adds rise exp(-(v/velocity)^2) to the dry friction."""

    def __init__(self, effect: Effect, substep_s: float) -> None:
        self._rise = effect.values["rise"]
        self._inverse = 1 / effect.values["velocity"]
        self._work = np.zeros_like(self._rise)

    def add(self, motion: Motion, total: Array) -> None:
        """Add the level."""
        work = self._work
        np.multiply(motion.velocity, self._inverse, out=work)
        np.multiply(work, work, out=work)
        np.negative(work, out=work)
        np.exp(work, out=work)
        np.multiply(work, self._rise, out=work)
        np.add(total, work, out=total)


class QuadraticDrag:
    """Adds coefficient v^2 to the dry friction."""

    def __init__(self, effect: Effect, substep_s: float) -> None:
        self._coefficient = effect.values["coefficient"]
        self._work = np.zeros_like(self._coefficient)

    def add(self, motion: Motion, total: Array) -> None:
        """Add the level."""
        np.multiply(motion.velocity, motion.velocity, out=self._work)
        np.multiply(self._work, self._coefficient, out=self._work)
        np.add(total, self._work, out=total)


class LoadFriction:
    """Adds coefficient |drive force| to the dry friction."""

    def __init__(self, effect: Effect, substep_s: float) -> None:
        self._coefficient = effect.values["coefficient"]
        self._work = np.zeros_like(self._coefficient)

    def add(self, motion: Motion, total: Array) -> None:
        """Add the level."""
        np.abs(motion.drive, out=self._work)
        np.multiply(self._work, self._coefficient, out=self._work)
        np.add(total, self._work, out=total)


class PositionFriction(_Periodic):
    """Adds level (1 + depth sin(2 pi x/pitch + phase)) to the dry friction."""

    def __init__(self, effect: Effect, substep_s: float) -> None:
        super().__init__(effect)
        self._level, self._depth = effect.values["level"], effect.values["depth"]

    def add(self, motion: Motion, total: Array) -> None:
        """Add the level."""
        sine = self.sine(motion.position)
        np.multiply(sine, self._depth, out=sine)
        np.add(sine, 1.0, out=sine)
        np.multiply(sine, self._level, out=sine)
        np.add(total, sine, out=total)


class FrictionVariation(_Periodic):
    """Factor 1 + depth sin(2 pi x/pitch + phase) on dry friction."""

    def __init__(self, effect: Effect) -> None:
        super().__init__(effect)
        self._depth = effect.values["depth"]

    def scale(self, motion: Motion, total: Array) -> None:
        """Multiply total by the factor at the motor's position."""
        sine = self.sine(motion.position)
        np.multiply(sine, self._depth, out=sine)
        np.add(sine, 1.0, out=sine)
        np.multiply(total, sine, out=total)


class EddyBrake:
    """Adds 2 force s/(1 + s^2), s = |v|/velocity, to the dry friction."""

    def __init__(self, effect: Effect, substep_s: float) -> None:
        self._twice = 2 * effect.values["force"]
        self._inverse = 1 / effect.values["velocity"]
        self._ratio, self._work = np.zeros((2, effect.active.size))

    def add(self, motion: Motion, total: Array) -> None:
        """Add the level."""
        ratio, work = self._ratio, self._work
        np.abs(motion.velocity, out=ratio)
        np.multiply(ratio, self._inverse, out=ratio)
        np.multiply(ratio, ratio, out=work)
        np.add(work, 1.0, out=work)
        np.divide(ratio, work, out=work)
        np.multiply(work, self._twice, out=work)
        np.add(total, work, out=total)


FORCES: dict[str, Callable[[Effect, float], Force]] = {
    "cogging": Cogging,
    "gravity": Gravity,
    "torque_ripple": TorqueRipple,
    "spring": Spring,
    "presliding": Presliding,
}
DRY: dict[str, Callable[[Effect, float], Force]] = {
    "stribeck": Stribeck,
    "load_friction": LoadFriction,
    "position_friction": PositionFriction,
}
DRAGS: dict[str, Callable[[Effect, float], Force]] = {
    "quadratic_drag": QuadraticDrag,
    "eddy_brake": EddyBrake,
}


class Walls:
    """An elastic, damped wall per axis that pushes and never pulls (Kelvin-Voigt).

    Args:
        position: where it is touched [m or rad], shape (n,); may be changed between ticks.
        stiffness: [N/m], 0 where there is no wall.
        damping: [N s/m].
        side: +1 where the wall is at greater positions than the axis, -1 at smaller.
    """

    def __init__(self, position: Array, stiffness: Array, damping: Array, side: Array) -> None:
        self.position = position
        self.stiffness, self.damping, self.side = stiffness, damping, side
        self._depth, self._rate = np.zeros((2, position.size))

    def press(self, position: Array, velocity: Array, out: Array) -> Array:
        """Return the force with which the axis presses on the wall [N], at least 0, in out."""
        depth, rate = self._depth, self._rate
        np.subtract(position, self.position, out=depth)
        np.multiply(depth, self.side, out=depth)
        np.multiply(velocity, self.side, out=rate)
        np.multiply(rate, self.damping, out=rate)
        np.multiply(depth, self.stiffness, out=out)
        np.add(out, rate, out=out)
        np.maximum(out, 0.0, out=out)
        np.greater(depth, 0.0, out=rate)
        return np.multiply(out, rate, out=out)

    def add(self, position: Array, velocity: Array, total: Array, out: Array) -> None:
        """Add the force of the wall on the axis to total; the pressing force goes to out."""
        self.press(position, velocity, out)
        np.multiply(out, self.side, out=self._depth)
        np.subtract(total, self._depth, out=total)
