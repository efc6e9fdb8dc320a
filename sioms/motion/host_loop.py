"""AxisBank: axes whose loop the host closes.

A tick measures, advances plans, keeps limits, applies the control law and fills ``fields``; what verbs mean is in
bank.py, which plan an axis runs and what follows it in sequencer.py.
"""

from __future__ import annotations

import errno
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sioms.protocol.flags import AxisStatus

from .bank import FAULT, Axes, Bank
from .guard import LimitGuard
from .homing import HomingRuns
from .host_watch import HostWatch
from .law import ControlLaw
from .queue import LOST
from .sequencer import FORCE, HOLD, STOP, Sequencer
from .settings import SWITCH_MINUS, SWITCH_PLUS, AxisSettings
from .types import EventKind, Keeper, MarkerPort

HOMING, HOMED = int(AxisStatus.HOMING), int(AxisStatus.HOMED)
FOLLOWING_ERROR = int(AxisStatus.FOLLOWING_ERROR)


class AxisBank(Bank):
    """The axes of one device, closed by the host.

    Args:
        settings: one per axis.
        tick_s: nominal period [s].
        markers: seam to the marker table.
        capacity: commands that each axis' buffer holds.
        late_max_s: a tick that comes later than this after its predecessor stops all motion [s].

    ``stepper`` (n,) tells which entries of tick()'s answer are raw output positions; the others are forces or torques.

    Concurrency: one thread.
    """

    NOT_SEEN = "no position has been measured yet; wait for the first tick"
    DEFERS = True

    def __init__(
        self,
        settings: Sequence[AxisSettings],
        *,
        tick_s: float,
        markers: MarkerPort,
        capacity: int = 16384,
        late_max_s: float = 0.05,
    ) -> None:
        super().__init__(settings, markers, capacity, passing=True)
        n = self.n
        self._law = ControlLaw(settings, tick_s, [self.rows[name] for name in ("k", "kz", "kp", "kb")])
        self.stepper = self._law.stepper
        self._sequencer = Sequencer(
            settings, self._queue, self._law, self._arrivals, self._position, self._velocity, self._in_motion,
            tick_s,
        )  # fmt: skip
        self._guard = LimitGuard(self._queue, self._sequencer)
        self._homing = HomingRuns(settings, self._queue, self)
        self._motion_watch = HostWatch(settings, tick_s, self._law.velocity_limit)
        self._limp = np.zeros(n, dtype=bool)
        self._any_limp = False
        self._last_raw = np.zeros(n)
        self._actuator, self._scratch = np.zeros(n), np.zeros(n)
        self._flag = np.zeros(n, dtype=bool)
        self._filter = np.array([s.velocity_filter_s for s in settings])
        watched = [np.inf if s.following_error_max is None else s.following_error_max for s in settings]
        self._error_max = np.array(watched, dtype=np.float64)
        self._tick_s = tick_s
        self._late_ns = int(late_max_s * 1e9)

    def plan_ahead(self, count: int = 32) -> int:
        """Plan up to ``count`` next commands (10 to 20 us each), in the slack between ticks.

        Returns:
            how many axes were looked at; 0 when there is nothing to do.
        """
        return self._sequencer.plan_ahead(count, self._last_ns)

    # -- what the bank asks for ---------------------------------------------------------------

    def _instant(self, now_ns: int) -> int:
        """Return now, or the instant of the last tick when the next is late already.

        A late tick stops what moves where it was last put out; a verb that comes before it must not let
        the set-points run on to now.
        """
        return self._last_ns if self._seen and now_ns - self._last_ns > self._late_ns else now_ns

    def _catch_up(self, now_ns: int) -> int:
        now_ns = self._instant(now_ns)
        self._sequencer.advance(now_ns)
        return now_ns

    def _idle(self, axes: Axes) -> NDArray[np.bool_]:
        return self._sequencer.is_idle(axes)

    def _is_open_ended(self, axes: Axes) -> NDArray[np.bool_]:
        return self._sequencer.is_open_ended(axes)

    def _rest_positions(self) -> NDArray[np.float64]:
        return self._sequencer.rest_positions()

    def _begin(self, axes: Axes, now_ns: int, *, replace: bool) -> None:
        if replace:
            self._sequencer.replaced(axes, now_ns)
        else:
            self._sequencer.appended(axes, now_ns)

    def _drop(self, axes: Axes) -> None:
        self._sequencer.drop(axes)

    def _halt(self, axes: Axes, now_ns: int, *, fastest: bool) -> None:
        """Brake; in force mode the controlled stop holds, the fastest one lets go until reset()."""
        in_force = axes[self._sequencer.kind[axes] == FORCE] if fastest else axes[:0]
        self._homing.cancel(axes)
        self._sequencer.halt(axes, now_ns)
        if in_force.size:
            self._set_limp(in_force)

    def _let_go(self, axes: Axes) -> None:
        self._set_limp(axes[~self.stepper[axes]])

    def _set_limp(self, axes: Axes) -> None:
        self._limp[axes] = True
        self._any_limp = bool(self._limp.any())

    def _recover(self, axes: Axes, latched: Axes) -> None:
        lost = axes[self.stepper[axes] & ((latched & FOLLOWING_ERROR) != 0)]
        lost = lost[self._sequencer.kind[lost] == HOLD]
        if lost.size:
            for axis in lost.tolist():
                self._law.anchor_at(axis, float(self._position[axis]))
            self._sequencer.hold(lost, self._position[lost], self._last_ns)
        limp = axes[self._limp[axes]]
        if limp.size:
            self._limp[limp] = False
            self._any_limp = bool(self._limp.any())
            self._sequencer.hold(limp, self._position[limp], self._last_ns)

    def _is_too_late(self, start_ns: int, now_ns: int) -> bool:
        return now_ns - start_ns > self._tick_s * 1e9

    def _release(self, axes: Axes, start_ns: int) -> None:
        self._sequencer.release(axes, start_ns)

    def _show(self, axes: Axes) -> None:
        self._sequencer.refresh(axes)

    def _limits_changed(self, axes: Axes) -> None:
        held = self._queue.limits
        self._law.velocity_limit[axes] = held.velocity[axes]
        self._law.acceleration_limit[axes] = held.acceleration[axes]
        self._law.force_limit[axes] = held.force[axes]

    def _home(self, axes: Axes, now_ns: int) -> None:
        self._homing.begin(axes, now_ns)

    def _move_coordinates(self, axes: Axes, by: NDArray[np.float64]) -> None:
        for axis, way in zip(axes.tolist(), by.tolist(), strict=True):
            self.shift(axis, way)

    # -- what homing asks for (homing.Mover) --------------------------------------------------

    def shift(self, axis: int, by: float) -> None:
        """Add to the coordinate of an axis, moving or not: actual and commanded position alike."""
        self._offset[axis] += by
        self._position[axis] += by
        self._desired[axis] += by
        self._law.shift(axis, by)
        self._sequencer.store.shift(np.array([axis]), by)

    def drive(self, axis: int, velocity: float, now_ns: int) -> None:
        """Go over to a velocity."""
        self._sequencer.drive(axis, velocity, now_ns)

    def brake(self, axis: int, now_ns: int) -> None:
        """Stop at maximum deceleration."""
        one = np.array([axis])
        self._sequencer.brake(one, self._sequencer.state(one, now_ns), now_ns)

    def stands(self, axis: int) -> bool:
        """Tell whether an axis holds still."""
        return bool(self._sequencer.kind[axis] == HOLD)

    def measured(self, axis: int) -> float:
        """Return the measured position."""
        return float(self._position[axis])

    # -- the tick -----------------------------------------------------------------------------

    def tick(
        self, now_ns: int, position: NDArray[np.float64], switches: NDArray[np.int64] | None = None
    ) -> NDArray[np.float64]:
        """Advance all axes to now and return what the actuators shall do.

        Args:
            now_ns: instant at which the positions were measured [ns].
            position: measured raw positions (n,).
            switches: bits SWITCH_MINUS, SWITCH_PLUS, SWITCH_HOME of each axis (n,), or None.

        Returns:
            (n,) force or torque of servos, raw output position of steppers (see ``stepper``). The
            array is reused by the next tick.
        """
        last_ns = self._last_ns if self._seen else now_ns
        self._last_ns = now_ns
        dt = max((now_ns - last_ns) * 1e-9, 0.1 * self._tick_s) if self._seen else self._tick_s
        if now_ns - last_ns > self._late_ns:
            self._stop_late(last_ns, now_ns)
        self._measure(position, dt, now_ns)
        self._sequencer.begin_tick(dt)
        self._settle(now_ns)
        self._sequencer.release_held(now_ns)
        if self._queue.waits_for_markers:
            self._poll_markers(now_ns)
        sequencer = self._sequencer
        sequencer.advance(now_ns)
        sequencer.store.evaluate(now_ns, self._desired, self._desired_velocity)
        if sequencer.any_guard and self._guard.keep(self._desired, self._desired_velocity, last_ns, now_ns):
            sequencer.store.evaluate(now_ns, self._desired, self._desired_velocity)
        self._control(dt)
        self._watch(switches, now_ns)
        if self.keeper is not None:
            self._keep(self.keeper, now_ns)
        return self._actuator

    def _stop_late(self, last_ns: int, now_ns: int) -> None:
        """Stop what moved, from the state of the last tick: a late tick never catches up."""
        sequencer = self._sequencer
        moving = np.flatnonzero((sequencer.kind != HOLD) | (sequencer.store.cut_ns <= now_ns))
        if not moving.size:
            return
        after, most = (now_ns - last_ns) * 1e-6, self._late_ns * 1e-6
        text = f"the tick came {after:.1f} ms after the last; at most {most:g} ms"
        self._homing.cancel(moving)
        state = sequencer.state(moving, last_ns)
        sequencer.drop(moving)
        sequencer.brake(moving, state, now_ns)
        self._queue.emit(EventKind.DROPPED, moving, now_ns, errno.ETIME, text)
        self._queue.latch_fault(moving, text, now_ns, errno.ETIME)
        sequencer.refresh(moving)

    def _measure(self, position: NDArray[np.float64], dt: float, now_ns: int) -> None:
        raw, scratch, velocity, told = self._raw, self._scratch, self._velocity, position
        if not np.isfinite(position.sum()):
            position = self._refuse_measurement(position, now_ns)
        raw[:] = position
        np.add(raw, self._offset, out=self._position)
        if not self._seen:
            self._first_measurement(told, now_ns)
        np.subtract(raw, self._last_raw, out=scratch)
        if self._motion_watch.is_due(now_ns, scratch):
            self._look(now_ns)
        scratch /= dt
        scratch -= velocity
        scratch *= dt / (self._filter + dt)
        velocity += scratch
        self._last_raw[:] = raw

    def _look(self, now_ns: int) -> None:
        """Put axes in fault that move as nobody has told them."""
        found = self._motion_watch.look(
            now_ns,
            self._raw,
            self._last_raw,
            self._desired_velocity,
            self._sequencer.kind == HOLD,
            self._limp,
        )
        for finding in found:
            if not self._queue.latched[finding.axis] & (LOST if finding.lost else FAULT):
                (self.lose_place if finding.lost else self.fault)([finding.axis], finding.text, now_ns)

    def _first_measurement(self, told: NDArray[np.float64], now_ns: int) -> None:
        self._seen = True
        self._last_raw[:] = self._raw
        if self.keeper is not None:
            offset, homed = self.keeper.restored(told)
            self._offset[:] = offset
            np.add(self._raw, offset, out=self._position)
            self._queue.set_homed(np.flatnonzero(homed), True, now_ns)
        self._law.slewed[:] = self._position
        self._law.anchor[:] = self._offset
        self._sequencer.hold(np.arange(self.n), self._position, now_ns)

    def _refuse_measurement(self, position: NDArray[np.float64], now_ns: int) -> NDArray[np.float64]:
        bad = np.flatnonzero(~np.isfinite(position))
        self.fault(bad, "the measured position is not a finite number", now_ns)
        good = position.copy()
        good[bad] = self._last_raw[bad]
        return good

    def _poll_markers(self, now_ns: int) -> None:
        released, broken = self._queue.poll_markers()
        if released:
            self._sequencer.release(np.array(released), now_ns)
            self._sequencer.refresh(np.array(released))
        for axis, number in broken:
            self._abandon(np.array([axis]), now_ns, errno.EPIPE, f"marker {number} was freed while waited for")

    def _control(self, dt: float) -> None:
        law, desired = self._law, self._desired
        rows = self._sequencer.kind == FORCE if self._sequencer.any_force else None
        law.step(desired, self._desired_velocity, self._position, self._velocity, dt, rows)
        if rows is not None:
            self._follow_actual(rows)
        if law.force_ends.any:
            self._yield()
        if self._any_limp:
            law.relax(self._limp)
            self._follow_actual(self._limp)
        self._actuator[:] = law.output
        self._force[:] = law.output
        if not law.all_servo:
            s = law.stepper_rows
            self._actuator[s] = law.slewed[s] - law.anchor[s]
            self._force[s] = 0.0
            desired[s] = law.slewed[s]
        np.subtract(desired, self._position, out=self._following)

    def _yield(self) -> None:
        """Hold where they are the axes that would have to press harder than they were told to reach their set-point."""
        law = self._law
        axes = law.force_ends.look(self._velocity, law.velocity_limit, self._last_ns)
        if axes.size:
            law.give_way(axes)
            self._sequencer.hold(axes, self._position[axes], self._last_ns)
            self._sequencer.store.evaluate(self._last_ns, self._desired, self._desired_velocity)

    def _follow_actual(self, rows: NDArray[np.bool_]) -> None:
        """Where no position is commanded, the commanded position is the actual one."""
        self._desired[rows] = self._position[rows]
        self._desired_velocity[rows] = self._velocity[rows]

    # -- watching -----------------------------------------------------------------------------

    def _watch(self, switches: NDArray[np.int64] | None, now_ns: int) -> None:
        """Following error, saturation, switches: status bits and what they cause."""
        np.abs(self._following, out=self._scratch)
        np.greater(self._scratch, self._error_max, out=self._flag)
        if self._flag.any():
            self._lose(np.flatnonzero(self._flag & ~self._limp), now_ns)
        if switches is not None:
            self._keep_switches(switches, now_ns)
        if self._homing.active:
            for axis, reason in self._homing.tick(switches, now_ns):
                self.fault([axis], reason, now_ns)
            self._sequencer.refresh(np.arange(self.n))
        status = self._status
        np.multiply(self._law.saturated, int(AxisStatus.SATURATED), out=status)
        status |= self._sequencer.status
        if switches is not None:
            status |= (switches & (SWITCH_MINUS | SWITCH_PLUS)) * int(AxisStatus.SWITCH_MINUS)
        self._queue.count(self._buffered)

    def _lose(self, axes: Axes, now_ns: int) -> None:
        """Fault axes whose following error is too great; a stepper that does so has stalled."""
        bits = int(AxisStatus.FOLLOWING_ERROR)
        for axis in axes[(self._queue.latched[axes] & bits) == 0].tolist():
            self._queue.latched[axis] |= bits | (int(AxisStatus.STALLED) if self.stepper[axis] else 0)
            unit = self.settings[axis].unit
            text = f"following error {self._following[axis]:g} {unit}; at most {self._error_max[axis]:g} {unit}"
            self.fault([axis], text, now_ns)
            if not self.stepper[axis]:
                self._actuator[axis] = self._force[axis] = self._law.output[axis] = 0.0

    def _keep_switches(self, switches: NDArray[np.int64], now_ns: int) -> None:
        """Stop axes that run onto an end switch; leaving it is free."""
        if not (switches & (SWITCH_MINUS | SWITCH_PLUS)).any():
            return
        v, kind = self._desired_velocity, self._sequencer.kind
        hit = ((switches & SWITCH_MINUS) != 0) & (v < 0) | ((switches & SWITCH_PLUS) != 0) & (v > 0)
        hit &= (kind != STOP) & (kind != HOLD) & ((self._queue.latched & HOMING) == 0)
        if hit.any():
            self._abandon(np.flatnonzero(hit), now_ns, errno.ERANGE, "stopped by an end switch")

    def _keep(self, keeper: Keeper, now_ns: int) -> None:
        """Note where the axes are; before the actuators hear of a motion."""
        latched = self._queue.latched
        at_rest = (self._sequencer.kind == HOLD) & ~self._limp & ((latched & (HOMING | LOST)) == 0)
        keeper.note(at_rest, (latched & HOMED) != 0, self._raw, self._position, now_ns)
