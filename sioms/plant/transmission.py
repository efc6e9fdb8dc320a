"""Elastic transmission: the load as a second mass behind a spring, with or without a gap.

The effects ``elastic`` and ``backlash``. Friction of the axis stays at the motor; forces of the
environment (gravity, springs, walls) act on the load. Stepped with the motor by the leapfrog method.
"""

import math

import numpy as np
from numpy.typing import NDArray

from .effects import Effect, EffectsError
from .forces import Motion, middle_velocity

Array = NDArray[np.float64]


class Transmission:
    """Springs between motors and loads of n axes; an axis without one is rigid.

    Args:
        effects: the transmission effects of the bank, at most one for an axis.
        mass: motor and load together [kg], shape (n,).
        position: where motor and load rest at the start [m or rad].

    Raises:
        EffectsError: more than one transmission for an axis.
    """

    def __init__(self, effects: tuple[Effect, ...], mass: Array, position: Array) -> None:
        count = np.sum([effect.active for effect in effects], axis=0)
        if np.any(count > 1):
            axis = int(np.argmax(count))
            raise EffectsError(f"build transmission of axis {axis}: {count[axis]} effects; must be one at most")
        n = mass.size
        self.elastic = count == 1
        self._rigid = ~self.elastic
        fraction, frequency, damping, gap = np.full(n, 0.5), np.zeros(n), np.zeros(n), np.zeros(n)
        for effect in effects:
            on = effect.active
            fraction[on] = effect.values["load_fraction"][on]
            frequency[on] = effect.values["frequency_hz"][on]
            damping[on] = effect.values["damping"][on]
            if "gap" in effect.values:
                gap[on] = effect.values["gap"][on]
        self.motor_mass = np.where(self.elastic, mass * (1 - fraction), mass)
        self.load_mass = mass * fraction
        reduced = self.motor_mass * self.load_mass / mass
        # The free resonance of both masses: (2 pi f)^2 = k / reduced mass.
        self.stiffness = np.where(self.elastic, (2 * math.pi * frequency) ** 2 * reduced, 0.0)
        self.damping = np.where(self.elastic, 2 * damping * np.sqrt(self.stiffness * reduced), 0.0)
        self._half_gap = gap / 2
        self.position = position.copy()
        self.velocity, self._last_velocity = np.zeros((2, n))
        self._flag = np.zeros(n, dtype=np.bool_)
        self._twist, self._rate, self._force, self._engaged = np.zeros((4, n))

    def predict(self, motion: Motion, time_s: float) -> None:
        """Set the load's motion at the mid-point of a step; the motor's where rigid."""
        position, velocity = motion.load_position, motion.load_velocity
        np.multiply(self.velocity, time_s / 2, out=position)
        np.add(position, self.position, out=position)
        middle_velocity(self.velocity, self._last_velocity, self._flag, velocity)
        np.copyto(self._last_velocity, self.velocity)
        np.copyto(position, motion.position, where=self._rigid)
        np.copyto(velocity, motion.velocity, where=self._rigid)

    def couple(self, motion: Motion, motor_force: Array, load_force: Array) -> None:
        """Add the spring's force to both sides; a rigid axis gets the load's force at the motor."""
        twist, force = self._twist, self._force
        np.subtract(motion.position, motion.load_position, out=twist)
        np.clip(twist, -self._half_gap, self._half_gap, out=force)
        np.subtract(twist, force, out=twist)
        np.not_equal(twist, 0.0, out=self._engaged)
        np.subtract(motion.velocity, motion.load_velocity, out=self._rate)
        np.multiply(self._rate, self.damping, out=self._rate)
        np.multiply(self._rate, self._engaged, out=self._rate)
        np.multiply(twist, self.stiffness, out=force)
        np.add(force, self._rate, out=force)
        # Across a gap the flanks push only.
        np.copyto(force, 0.0, where=(self._half_gap > 0) & (force * twist < 0))
        np.subtract(motor_force, force, out=motor_force)
        np.multiply(load_force, self._rigid, out=self._rate)
        np.add(motor_force, self._rate, out=motor_force)
        np.add(load_force, force, out=load_force)

    def kick(self, load_force: Array, motor_state: Array, time_s: float) -> None:
        """Step the load under its force; a rigid load goes with its motor (velocity, position)."""
        change = load_force / self.load_mass * time_s
        self.position += time_s * (self.velocity + change / 2)
        self.velocity += change
        np.copyto(self.velocity, motor_state[0], where=self._rigid)
        np.copyto(self.position, motor_state[1], where=self._rigid)
