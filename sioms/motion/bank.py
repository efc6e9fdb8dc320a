"""AxisBank: the axes of one device whose loop the host closes.

Pure: no I/O and no clock; every call that depends on time takes ``now_ns`` (CLOCK_MONOTONIC), never
falling. Verbs act at their own now_ns; a tick measures, advances plans, keeps limits, applies the
control law and fills ``fields``.
"""

from __future__ import annotations

import errno
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sioms.protocol.flags import AxisStatus, NodeClass
from sioms.protocol.records import READ, read_rows

from .commands import WIRE_DTYPE
from .guard import LimitGuard
from .homing import HomingRuns
from .host_watch import HostWatch
from .inbox import Inbox
from .law import ControlLaw
from .plain import MOST
from .queue import LOST, AxesLike, CommandQueue, Judged, Judgement, LimitValue, verdict
from .sequencer import FORCE, HOLD, STOP, Sequencer
from .settings import SWITCH_MINUS, SWITCH_PLUS, AxisSettings
from .types import CommandError, Event, EventKind, Keeper, MarkerPort

Axes = NDArray[np.int64]
EMERGENCY_STOP, HOMING, HOMED = int(AxisStatus.EMERGENCY_STOP), int(AxisStatus.HOMING), int(AxisStatus.HOMED)
FOLLOWING_ERROR = int(AxisStatus.FOLLOWING_ERROR)
FAULT, POSITION_LOST = int(AxisStatus.FAULT), int(AxisStatus.POSITION_LOST)


class AxisBank:
    """The axes of one device, closed by the host.

    Args:
        settings: one per axis.
        tick_s: nominal period [s].
        markers: seam to the marker table.
        capacity: commands that each axis' buffer holds.
        late_max_s: a tick that comes later than this after its predecessor stops all motion [s].

    ``fields`` is (columns of AxisRead, n) float64, contiguous; ``rows`` are its rows by name, whole numbers as int64. ``stepper`` (n,) tells which entries of tick()'s answer are raw output
    positions; the others are forces or torques. ``keeper`` may be set before the first tick.

    Concurrency: one thread.
    """

    def __init__(
        self,
        settings: Sequence[AxisSettings],
        *,
        tick_s: float,
        markers: MarkerPort,
        capacity: int = 16384,
        late_max_s: float = 0.05,
    ) -> None:
        n = self.n = len(settings)
        self.settings = tuple(settings)
        self.fields = np.zeros((len(READ[NodeClass.AXIS]), n))
        rows = self.rows = read_rows(NodeClass.AXIS, self.fields)
        self._position, self._velocity, self._force = rows["position"], rows["velocity"], rows["force"]
        self._desired, self._desired_velocity = rows["commanded_position"], rows["commanded_velocity"]
        self._following, self._status, self._buffered = (
            rows["following_error"],
            rows["status"],
            rows["buffered"],
        )
        self._queue = CommandQueue(settings, markers, capacity)
        self._law = ControlLaw(settings, tick_s, [rows[name] for name in ("k", "kz", "kp", "kb")])
        self.stepper = self._law.stepper
        self._sequencer = Sequencer(
            settings, self._queue, self._law, self._position, self._velocity, rows["in_motion"],
            tick_s,
        )  # fmt: skip
        self._guard = LimitGuard(self._queue, self._sequencer)
        self._homing = HomingRuns(settings, self._queue, self)
        self._motion_watch = HostWatch(settings, tick_s, self._law.velocity_limit)
        self._limp = np.zeros(n, dtype=bool)
        self._any_limp = False
        self._offset = np.zeros(n)
        self._raw, self._last_raw = np.zeros(n), np.zeros(n)
        self._actuator, self._scratch = np.zeros(n), np.zeros(n)
        self._flag = np.zeros(n, dtype=bool)
        self._filter = np.array([s.velocity_filter_s for s in settings])
        watched = [np.inf if s.following_error_max is None else s.following_error_max for s in settings]
        self._error_max = np.array(watched, dtype=np.float64)
        self._tick_s = tick_s
        self._late_ns = int(late_max_s * 1e9)
        self._last_ns = 0
        self._seen = False
        self._inbox = Inbox(self._queue, self._sequencer, self._instant)
        self.keeper: Keeper | None = None

    # -- writing ------------------------------------------------------------------------------

    def append(self, records: NDArray[Any], axes: AxesLike, now_ns: int, *, replace: bool = False) -> None:
        """Append written records, all or none; axes that are free begin exactly at now.

        Args:
            records: structured array, numpy_dtype(NodeClass.AXIS).
            axes: bank axis of each node-local axis index.
            now_ns: instant of the write.
            replace: empty the buffers of the axes named in the records first, and re-plan from the
                present state without a jump.

        Raises:
            CommandError: EINVAL, ERANGE (outside limits, or known to be infeasible), EAGAIN (no
                room), EPERM (emergency stop, home required), EIO (fault), EBUSY (homing).
        """
        short = len(records) <= MOST and records.dtype == WIRE_DTYPE
        if not (short and self.offer(records.tolist(), axes, now_ns, replace=replace)):
            self.take(verdict(self.judge(records, axes, now_ns, replace=replace)), now_ns)

    def offer(
        self, records: Sequence[tuple[Any, ...]], axes: AxesLike, now_ns: int, *, replace: bool = False
    ) -> bool:
        """Take a short write at once; False, and nothing taken, when append() has to judge it.

        It is worked in by the next tick or verb, at its own instant.

        Args:
            records: up to MOST, each as a tuple of the fields of table F.3.
            axes, now_ns, replace: as append().
        """
        return self._seen and self._inbox.offer(records, axes, now_ns, replace=replace)

    def judge(
        self, records: NDArray[Any], axes: AxesLike, now_ns: int, *, replace: bool = False
    ) -> Judgement:
        """Judge a long write piece by piece, between ticks; what append() would refuse is refused here.

        Args, Raises: as append(). Returns, at its end: what take() takes.
        """
        if not self._seen:
            raise CommandError(errno.EIO, "write: no position has been measured yet; wait for the first tick")
        return (yield from self._queue.judge(records, axes, self._rest_positions(now_ns), replace=replace))

    def take(self, judged: Judged, now_ns: int) -> bool:
        """Append a judged write whole, at now; False when its axes have changed since: judge it again.

        Raises:
            CommandError: the axes take no commands any more, or have no room.
        """
        now_ns = self._instant(now_ns)
        if not self._queue.still_holds(judged, self._rest_positions(now_ns)):
            return False
        if judged.replace:
            self._sequencer.drop(judged.axes)
            self._sequencer.replaced(self._queue.append(judged), now_ns)
        elif judged.axes.size:
            self._sequencer.appended(self._queue.append(judged), now_ns)
        return True

    def _rest_positions(self, now_ns: int) -> NDArray[np.float64]:
        self._inbox.work_in()
        self._sequencer.advance(self._instant(now_ns))
        return self._sequencer.rest_positions()

    def room(self, axes: AxesLike) -> int:
        """Return how many further commands fit into the fullest buffer of these axes."""
        self._inbox.work_in()
        return int(self._queue.room_of_all()[np.asarray(axes)].min())

    def flush(self, axes: AxesLike) -> None:
        """Empty the buffers; the running command goes on to its end."""
        chosen = np.asarray(axes, dtype=np.int64)
        self._inbox.forget(chosen)
        waited = chosen[~self._sequencer.is_idle(chosen)]
        self._sequencer.drop(chosen)
        self._queue.emit(EventKind.IDLE, waited[self._sequencer.is_idle(waited)], self._last_ns)
        self._sequencer.refresh(chosen)

    def synch(self, axes: AxesLike, start_ns: int, now_ns: int) -> tuple[int, ...]:
        """Start the commands that wait for the external synch, all exactly at start_ns.

        A command is started when it holds its axis: it is the next, and what runs before it is a
        hold or lasts until the next command. Other axes are not affected. Axes for which start_ns
        passed more than a tick ago are stopped and their buffers dropped (ETIME), never hurried.

        Returns:
            the axes released.
        """
        self._inbox.work_in()
        self._sequencer.advance(self._instant(now_ns))
        chosen = np.asarray(axes, dtype=np.int64)
        chosen = chosen[self._queue.gated_synch[chosen] & self._sequencer.is_open_ended(chosen)]
        if chosen.size and now_ns - start_ns > self._tick_s * 1e9:
            text = f"the synch came {(now_ns - start_ns) * 1e-6:.3f} ms after its start time"
            self._abandon(chosen, now_ns, errno.ETIME, text)
            return ()
        self._queue.gated_synch[chosen] = False
        self._sequencer.release(chosen, start_ns)
        self._sequencer.refresh(chosen)
        return tuple(chosen.tolist())

    def plan_ahead(self, count: int = 32) -> int:
        """Plan up to ``count`` next commands (10 to 20 us each), in the slack between ticks.

        Returns:
            how many axes were looked at; 0 when there is nothing to do.
        """
        return self._sequencer.plan_ahead(count, self._last_ns)

    # -- stopping -----------------------------------------------------------------------------

    def stop(self, axes: AxesLike, now_ns: int) -> None:
        """Empty the buffers and stop at maximum deceleration; force mode goes over to holding."""
        chosen = np.asarray(axes, dtype=np.int64)
        self._inbox.forget(chosen)
        now_ns = self._instant(now_ns)
        self._sequencer.advance(now_ns)
        self._homing.cancel(chosen)
        self._sequencer.halt(chosen, now_ns)

    def emergency_stop(self, axes: AxesLike, now_ns: int) -> None:
        """Stop as stop() does, but outputs of axes in force mode go to zero and stay there until reset().

        Latched: writes are refused (EPERM) until reset().
        """
        chosen = np.asarray(axes, dtype=np.int64)
        fresh = chosen[(self._queue.latched[chosen] & EMERGENCY_STOP) == 0]
        if not fresh.size:
            return
        self._queue.latched[fresh] |= EMERGENCY_STOP
        self._sequencer.advance(self._instant(now_ns))
        in_force = fresh[self._sequencer.kind[fresh] == FORCE]
        self._abandon(fresh, now_ns, errno.ECANCELED, "emergency stop")
        self._set_limp(in_force)

    def fault(self, axes: AxesLike, text: str, now_ns: int | None = None) -> None:
        """Put axes in fault: buffers dropped, forces zero, steppers stopped; latched until reset()."""
        chosen = np.asarray(axes, dtype=np.int64)
        stamp = self._last_ns if now_ns is None else now_ns
        self._queue.latch_fault(chosen, text, stamp)
        self._abandon(chosen, stamp, errno.EIO, text)
        self._set_limp(chosen[~self.stepper[chosen]])

    def lose_place(self, axes: AxesLike, text: str, now_ns: int | None = None) -> None:
        """Put axes in fault whose device does not know where they are; see DriveBank.lose_place()."""
        self._queue.lose_places(np.asarray(axes, dtype=np.int64), text)
        self.fault(axes, text, now_ns)

    def fault_text(self, axis: int) -> str:
        """Return why an axis is in fault, empty when it is not."""
        return self._queue.fault_text(axis)

    def reset(self, axes: AxesLike) -> None:
        """Clear emergency stop and fault; axes without force, and steppers that lost steps, hold where they are.

        Nothing resumes.
        """
        chosen = np.asarray(axes, dtype=np.int64)
        lost = chosen[self.stepper[chosen] & ((self._queue.latched[chosen] & FOLLOWING_ERROR) != 0)]
        lost = lost[self._sequencer.kind[lost] == HOLD]
        self._queue.unlatch(chosen)
        if lost.size:
            for axis in lost.tolist():
                self._law.anchor_at(axis, float(self._position[axis]))
            self._sequencer.hold(lost, self._position[lost], self._last_ns)
        limp = chosen[self._limp[chosen]]
        if limp.size:
            self._limp[limp] = False
            self._any_limp = bool(self._limp.any())
            self._sequencer.hold(limp, self._position[limp], self._last_ns)
        self._sequencer.refresh(chosen)

    def _abandon(self, axes: Axes, now_ns: int, errno_: int, text: str) -> None:
        """Stop axes for a reason that is not their writer's, and tell those who wait for them."""
        self._inbox.forget(axes)
        self._queue.emit(EventKind.DROPPED, axes[~self._sequencer.is_idle(axes)], now_ns, errno_, text)
        self._homing.cancel(axes)
        self._sequencer.halt(axes, self._instant(now_ns))

    def _instant(self, now_ns: int) -> int:
        """Return the instant at which a verb acts: now, or that of the last tick when the next is late already.

        A late tick stops what moves where it was last put out; a verb that comes before it must not let
        the set-points run on to now.
        """
        return self._last_ns if self._seen and now_ns - self._last_ns > self._late_ns else now_ns

    def _set_limp(self, axes: Axes) -> None:
        self._limp[axes] = True
        self._any_limp = bool(self._limp.any())

    # -- coordinates, limits, homing ----------------------------------------------------------

    def calibrate(self, axes: AxesLike, positions: Sequence[float] | NDArray[np.float64]) -> None:
        """Give the present place of each axis a new coordinate, without motion.

        Soft limits keep their numbers: they belong to the coordinates so defined.

        Raises:
            CommandError: EBUSY while an axis moves, ERANGE outside its soft limits, EINVAL when not finite.
        """
        chosen, wanted = np.asarray(axes, dtype=np.int64), np.asarray(positions, dtype=np.float64)
        self._inbox.work_in()
        self._queue.check_calibration(chosen, wanted, self._sequencer.is_idle(chosen))
        self._queue.find_places(chosen)
        for axis, position in zip(chosen.tolist(), wanted.tolist(), strict=True):
            self.shift(axis, position - float(self._position[axis]))
            # A sum of differences rounds: the place that was named is the place that is read.
            self._offset[axis] = position - float(self._raw[axis])
            self._position[axis] = float(self._raw[axis]) + float(self._offset[axis])

    def zero(self, axes: AxesLike) -> None:
        """Make the present place of each axis position 0; see calibrate()."""
        self.calibrate(axes, np.zeros(len(axes)))

    def set_limits(self, axes: AxesLike, **limits: LimitValue) -> None:
        """Narrow the limits of axes, or with None return to the configured ones; see CommandQueue.set_limits()."""
        chosen = np.asarray(axes, dtype=np.int64)
        if not self.is_idle(chosen):
            raise CommandError(
                errno.EBUSY, "set limits: an axis moves or has commands; wait until it is idle"
            )
        self._queue.set_limits(chosen, limits, self._position)
        held = self._queue.limits
        self._law.velocity_limit[chosen] = held.velocity[chosen]
        self._law.acceleration_limit[chosen] = held.acceleration[chosen]
        self._law.force_limit[chosen] = held.force[chosen]

    def get_limits(self, axes: AxesLike) -> dict[str, list[float | None]]:
        """Return the limits in force by name, one entry per axis, None where there is none."""
        return self._queue.get_limits(axes)

    def home(self, axes: AxesLike, now_ns: int) -> None:
        """Start homing; HOMED and IDLE events tell the end, a fault that it failed. See homing.py.

        Raises:
            CommandError: EINVAL without homing, EBUSY while moving, EPERM or EIO when latched.
        """
        chosen = np.asarray(axes, dtype=np.int64)
        self._inbox.work_in()
        now_ns = self._instant(now_ns)
        self._sequencer.advance(now_ns)
        self._homing.begin(chosen, self._sequencer.is_idle(chosen), now_ns)
        self._sequencer.refresh(chosen)

    def set_homed(self, axes: AxesLike, homed: bool = True) -> None:
        """Note that a reference was found otherwise (absolute encoder, restored position) or lost."""
        chosen = np.asarray(axes, dtype=np.int64)
        self._queue.set_homed(chosen, homed, self._last_ns)
        self._sequencer.refresh(chosen)

    def shift(self, axis: int, by: float) -> None:
        """Add to the coordinate of an axis, moving or not: actual and commanded position alike."""
        self._offset[axis] += by
        self._position[axis] += by
        self._desired[axis] += by
        self._law.shift(axis, by)
        self._sequencer.store.shift(np.array([axis]), by)

    def drive(self, axis: int, velocity: float, now_ns: int) -> None:
        """Go over to a velocity (homing.Mover)."""
        self._sequencer.drive(axis, velocity, now_ns)

    def brake(self, axis: int, now_ns: int) -> None:
        """Stop at maximum deceleration (homing.Mover)."""
        one = np.array([axis])
        self._sequencer.brake(one, self._sequencer.state(one, now_ns), now_ns)

    def stands(self, axis: int) -> bool:
        """Tell whether an axis holds still (homing.Mover)."""
        return bool(self._sequencer.kind[axis] == HOLD)

    def measured(self, axis: int) -> float:
        """Return the measured position (homing.Mover)."""
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
        self._inbox.work_in(now_ns)
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
            if not self._queue.latched[finding.axis] & (POSITION_LOST if finding.lost else FAULT):
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
            self._abandon(
                np.array([axis]), now_ns, errno.EPIPE, f"marker {number} was freed while waited for"
            )

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
            text = (
                f"following error {self._following[axis]:g} {unit}; at most {self._error_max[axis]:g} {unit}"
            )
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

    # -- answers ------------------------------------------------------------------------------

    def is_idle(self, axes: AxesLike) -> bool:
        """Tell whether these axes hold still, have no commands and are not homing."""
        self._inbox.work_in()
        return bool(self._sequencer.is_idle(np.asarray(axes, dtype=np.int64)).all())

    def particulars(self, axes: AxesLike) -> dict[str, list[float]]:
        """Return what the readings do not tell of these axes, by name.

        Raw is what the device counts, offset what makes a position of it; retries belong to the last point
        move, misses are counted since the start.
        """
        chosen = np.asarray(axes)
        report = {"raw": self._raw[chosen].tolist(), "offset": self._offset[chosen].tolist()}
        return report | self._sequencer.arrivals.report(chosen)

    def take_events(self) -> list[Event]:
        """Return what happened since the last call, oldest first."""
        self._inbox.work_in()
        return self._queue.take_events()
