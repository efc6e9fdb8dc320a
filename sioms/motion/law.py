"""Control laws, vectorised over the axes of a bank: servo and stepper in one pass.

Servo (dissertation, section F.2.4): ``u[n] = k (e[n] + kz e[n-1]) - kp tau[n-1] + kb v[n] + tau_o``,
``tau[n] = clip(u[n], -tau_m, tau_m)``; e desired minus actual position, v the filtered actual
velocity. In force mode ``u = force + kb v + tau_o``. Damping is ``kb < 0``. Where an axis is given an integral
gain ki, which the section does not have, u gets ``ki sum(e dt)``, bounded by tau_m and not growing while u is clipped.

Stepper: the same form slews the output position: e is desired minus output position, the law gives
the output velocity w (``kp`` acts on w[n-1], ``kb`` on the desired velocity), which is clipped to
the limits of velocity and acceleration, and to what can be braked, before it moves the output. k = 1/tick with the rest
zero
is dead beat: the output is on the set-point in every tick as long as the limits allow it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from .force_end import ForceEnds
from .settings import AxisKind, AxisSettings

Vector = NDArray[np.float64]


class ControlLaw:
    """State and gains of the laws of n axes. Gains and limits are arrays (n,), free to change between ticks.

    Args:
        settings: one per axis.
        tick_s: nominal period [s].
        gains: arrays k, kz, kp, kb (n,) to use, rows of the published fields.
    """

    def __init__(self, settings: Sequence[AxisSettings], tick_s: float, gains: Sequence[Vector]) -> None:
        n = len(settings)
        self.stepper = np.array([s.kind is AxisKind.STEPPER for s in settings], dtype=bool)
        self.k: Vector = gains[0]
        self.kz: Vector = gains[1]
        self.kp: Vector = gains[2]
        self.kb: Vector = gains[3]
        for given in settings:
            if given.kind is AxisKind.SERVO and given.k is None:
                raise ValueError(f"axis {given.name}: a servo needs the gain k; without it nothing holds its position")
        default = [1.0 / tick_s if s.kind is AxisKind.STEPPER else 0.0 for s in settings]
        self.k[:] = [d if s.k is None else s.k for s, d in zip(settings, default, strict=True)]
        self.kz[:] = [s.kz for s in settings]
        self.kp[:] = [s.kp for s in settings]
        self.kb[:] = [s.kb for s in settings]
        self.offset = np.array([s.force_offset for s in settings])
        self.force_limit = np.array([s.force_max for s in settings], dtype=np.float64)
        self.velocity_limit = np.array([s.velocity_max for s in settings], dtype=np.float64)
        self.acceleration_limit = np.array([s.acceleration_max for s in settings], dtype=np.float64)
        self._integral_gain = np.array([s.ki for s in settings], dtype=np.float64)
        self._any_integral = bool(self._integral_gain.any())
        self._integral = np.zeros(n)
        self.error = np.zeros(n)
        self.output = np.zeros(n)
        """tau[n-1] of servos, w[n-1] of steppers."""
        self.slewed = np.zeros(n)
        """Output position of steppers."""
        self.anchor = np.zeros(n)
        """What output positions count from: the raw output is slewed - anchor."""
        self._start_velocity = np.array([s.start_velocity for s in settings], dtype=np.float64)
        self._any_start = bool(self._start_velocity.any())
        self.saturated = np.zeros(n, dtype=bool)
        self.force_ends = ForceEnds(n)
        self.all_servo = not self.stepper.any()
        self.stepper_rows: slice | NDArray[np.int64] = np.flatnonzero(self.stepper)
        """The stepper rows as an index; a slice when all are, which copies nothing."""
        if self.stepper.all():
            self.stepper_rows = slice(None)
        self._old = np.zeros(n)
        self._u = np.zeros(n)
        self._term = np.zeros(n)
        self._low = np.zeros(n)
        self._last_velocity = np.zeros(n)

    def anchor_at(self, axis: int, position: float) -> None:
        """Call the place at which a stepper stands ``position``; the raw output does not change."""
        self.anchor[axis] += position - self.slewed[axis]
        self.slewed[axis] = position

    def shift(self, axis: int, by: float) -> None:
        """Add to the coordinate of an axis; the raw output does not change."""
        self.slewed[axis] += by
        self.anchor[axis] += by

    def step(
        self,
        desired: Vector,
        desired_velocity: Vector,
        actual: Vector,
        velocity: Vector,
        dt: float,
        force_rows: NDArray[np.bool_] | None = None,
    ) -> None:
        """Advance error and output of all axes by one tick.

        Args:
            desired: desired position; of axes in force mode the desired force (n,).
            desired_velocity: (n,), used by steppers only.
            actual: measured position (n,).
            velocity: filtered measured velocity (n,).
            dt: time since the last tick [s].
            force_rows: mask of the axes in force mode, None when there are none.
        """
        if not self.all_servo:
            rows = self.stepper_rows
            w_last, e_last = self.output[rows].copy(), self.error[rows].copy()
        self._servo(desired, actual, velocity)
        if self._any_integral:
            self._integrate(dt)
        if force_rows is not None:
            np.add(desired, self.kb * velocity, out=self._u, where=force_rows)
            np.add(self._u, self.offset, out=self._u, where=force_rows)
            self.error[force_rows] = self._integral[force_rows] = 0.0
            np.copyto(self.force_ends.asked, desired, where=force_rows)
        self._clip(velocity)
        if not self.all_servo:
            self._slew(desired, desired_velocity, w_last, e_last, dt)

    def _servo(self, desired: Vector, actual: Vector, velocity: Vector) -> None:
        e, old, u, term = self.error, self._old, self._u, self._term
        old[:] = e
        np.subtract(desired, actual, out=e)
        np.multiply(self.kz, old, out=u)
        u += e
        u *= self.k
        np.multiply(self.kp, self.output, out=term)
        u -= term
        np.multiply(self.kb, velocity, out=term)
        u += term
        u += self.offset

    def _integrate(self, dt: float) -> None:
        """Add the integral of the error, which does not wind up while the output is clipped (of the tick before)."""
        integral, term, limit = self._integral, self._term, self.force_limit
        np.multiply(self._integral_gain, self.error, out=term)
        term *= dt
        term[self.saturated & (term * self.output > 0)] = 0.0
        integral += term
        np.clip(integral, -limit, limit, out=integral)
        self._u += integral

    def relax(self, axes: NDArray[np.bool_]) -> None:
        """Let the outputs of axes (a mask) be zero, and forget what led to them."""
        self.output[axes] = self.error[axes] = self._integral[axes] = 0.0

    def give_way(self, axes: NDArray[np.int64]) -> None:
        """Forget the error of axes whose set-point has yielded: what it was before must not push back."""
        self.error[axes] = self._integral[axes] = 0.0

    def _clip(self, velocity: Vector) -> None:
        np.negative(self.force_limit, out=self._low)
        np.maximum(self._u, self._low, out=self.output)
        np.minimum(self.output, self.force_limit, out=self.output)
        if self.force_ends.any:
            self.force_ends.bound(self.output, velocity, self.velocity_limit, self.force_limit)
        np.not_equal(self.output, self._u, out=self.saturated)

    def _slew(self, desired: Vector, desired_velocity: Vector, w_last: Vector, e_last: Vector, dt: float) -> None:
        s = self.stepper_rows
        dv, limit = desired_velocity[s], self.acceleration_limit[s]
        e = desired[s] - self.slewed[s]
        free = self.k[s] * (e + self.kz[s] * e_last) - self.kp[s] * w_last + self.kb[s] * dv
        wish = self._brakable(free, e, dv, self._spare(limit, dv, s, dt), dt)
        # Rounding must not count as saturation: a profile at full acceleration is within the limits.
        v, a = self.velocity_limit[s] * (1 + 1e-6), limit * dt * (1 + 1e-6)
        low, high = w_last - a, w_last + a
        if self._any_start:
            low, high = self._jump_over(low, high, a, s)
        w = np.clip(np.clip(wish, low, high), -v, v)
        # Dead beat on a set-point that the limits allow to reach in this tick, however long it is.
        locked = (self.k[s] * dt >= 0.999) & (self.kz[s] == 0.0) & (self.kp[s] == 0.0) & (self.kb[s] == 0.0)
        locked &= (dv >= low) & (dv <= high) & (np.abs(dv) <= v)
        near = np.abs(e - w_last * dt) <= 0.5 * a * dt + 1e-12
        if self._any_start:
            near |= np.abs(e) <= (self._start_velocity[s] + a) * dt
        locked &= near
        self.slewed[s] = np.where(locked, desired[s], self.slewed[s] + w * dt)
        w = np.where(locked, dv, w)
        self.output[s] = w
        self.error[s] = e
        self.saturated[s] = ~locked & (np.abs(w - free) > 1e-3 * v)

    def _jump_over(self, low: Vector, high: Vector, a: Vector, s: slice | NDArray[np.int64]) -> tuple[Vector, Vector]:
        """Widen the velocities that can be had in this tick: those up to the start velocity follow from each other at
        once.
        """
        jump = self._start_velocity[s]
        within = (low <= jump) & (high >= -jump)
        return (
            np.where(within, np.minimum(low, -jump - a), low),
            np.where(within, np.maximum(high, jump + a), high),
        )

    def _spare(self, limit: Vector, desired_velocity: Vector, s: slice | NDArray[np.int64], dt: float) -> Vector:
        """Return the acceleration that is left to catch up with a set-point that accelerates itself."""
        own = np.abs(desired_velocity - self._last_velocity[s]) / dt
        self._last_velocity[s] = desired_velocity
        return np.maximum(limit - own, 0.05 * limit)

    @staticmethod
    def _brakable(free: Vector, e: Vector, desired_velocity: Vector, a: Vector, dt: float) -> Vector:
        """Bound the output velocity to what can still be braked on the way to the set-point.

        The lag that is not the set-point's own travel in this tick is closed at most within the
        tick, and at most as fast as half of the spare deceleration a can stop there; else an output
        that was clipped, or a tick that came late, would swing about the set-point for ever.
        """
        a = 0.5 * a
        lag = np.abs(e - desired_velocity * dt)
        half = 0.5 * a * dt
        most = np.minimum(lag / dt, np.sqrt(2 * a * lag + half * half) - half)
        return np.clip(free, desired_velocity - most, desired_velocity + most)
