"""AxisBank: buffers, profiles, limits and laws of the axes of one device whose loop the host closes.

Pure: no I/O and no clock; every call that depends on time takes ``now_ns`` (CLOCK_MONOTONIC), never
falling. One thread owns a bank. An axis always runs a *plan*: a hold at rest, the profile of a
command, a force, or a brake; plans are polynomials in continuous time (store.py), so between events
a tick is vector arithmetic only, and a command ends at its exact instant, not at a tick.
"""

from __future__ import annotations

import errno
from collections.abc import Sequence
from enum import IntEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sioms.protocol.flags import AxisStatus, ControlMode
from sioms.protocol.records import AXIS_READ_FIELDS

from .commands import Command
from .homing import HomingRuns
from .law import ControlLaw
from .profile import Bounds, InfeasibleError, Plan, Planner
from .queue import AxesLike, CommandQueue
from .store import UNCUT_NS, PlanStore
from .types import SWITCH_MINUS, SWITCH_PLUS, AxisSettings, CommandError, Event, EventKind, MarkerPort

M = ControlMode
Axes = NDArray[np.int64]
SPECIALS = M.SPECIFIED_GAINS | M.SPECIFIED_FORCE_OFFSET | M.SPECIFIED_MAX_VEL_ACC | M.SPECIFIED_MAX_FORCE
REST = 1e-9
ROW = {name: i for i, (name, _) in enumerate(AXIS_READ_FIELDS)}


class Kind(IntEnum):
    """What the running plan of an axis is."""

    HOLD = 0
    POSITION = 1
    RATE = 2
    """Velocity, acceleration or jerk command."""
    FORCE = 3
    BRAKE = 4
    STOP = 5
    """A brake that was asked for or forced by a limit."""


class AxisBank:
    """The axes of one device, closed by the host.

    Args:
        settings: one per axis.
        tick_s: nominal period [s].
        markers: seam to the marker table.
        capacity: commands that each axis' buffer holds.
        late_max_s: a tick that comes later than this after its predecessor stops all motion [s].

    ``fields`` is (13, n) float64 in the order of AXIS_READ_FIELDS; integer rows are the same memory
    seen as int64. ``stepper`` (n,) tells which entries of tick()'s answer are positions, not forces.

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
        self.fields = np.zeros((len(AXIS_READ_FIELDS), n))
        integers = self.fields.view(np.int64)
        f = [self.fields[i] for i in range(len(AXIS_READ_FIELDS))]
        self._position, self._velocity, self._force = f[0], f[1], f[2]
        self._desired, self._desired_velocity, self._following = f[7], f[8], f[9]
        self._in_motion, self._status_word, self._buffered = integers[10], integers[11], integers[12]
        self._queue = CommandQueue(settings, markers, capacity)
        self._limits = self._queue.limits
        self._law = ControlLaw(settings, tick_s, f[3:7])
        self.stepper = self._law.stepper
        self._store = PlanStore(n)
        self._planner = Planner()
        self._homing = HomingRuns(settings, self._queue, _HomingMover(self))
        self._kind = np.zeros(n, dtype=np.int8)
        self._row_kind = np.zeros(2 * n, dtype=np.int8)
        self._guard = np.zeros(n, dtype=bool)
        self._row_guard = np.zeros(2 * n, dtype=bool)
        self._row_command: list[Command | None] = [None] * (2 * n)
        self._row_signals = np.zeros(2 * n, dtype=bool)
        self._row_special = np.zeros(2 * n, dtype=bool)
        self._ready = np.zeros(n, dtype=bool)
        self._limp = np.zeros(n, dtype=bool)
        self._limit_bits = np.zeros(n, dtype=np.int64)
        self._base_status = np.zeros(n, dtype=np.int64)
        self._velocity_limit = self._limits.velocity.copy()
        self._acceleration_limit = self._limits.acceleration.copy()
        self._todo: dict[int, None] = {}
        self._offset = np.zeros(n)
        self._raw = np.zeros(n)
        self._last_raw = np.zeros(n)
        self._actuator = np.zeros(n)
        self._scratch = np.zeros(n)
        self._filter = np.array([s.velocity_filter_s for s in settings])
        self._error_max = np.array(
            [np.inf if s.following_error_max is None else s.following_error_max for s in settings]
        )
        self._tick_s = tick_s
        self._late_ns = int(late_max_s * 1e9)
        self._last_ns: int | None = None
        self._seen = False
        self._any_force = False
        self._any_limp = False
        self._any_guard = False
        self._all = np.arange(n, dtype=np.int64)

    # -- writing ------------------------------------------------------------------------------

    def append(self, records: NDArray[Any], axes: AxesLike, now_ns: int, *, replace: bool = False) -> None:
        """Append written records, all or none; free axes begin at now.

        Args:
            records: structured array, numpy_dtype(NodeClass.AXIS).
            axes: bank axis of each node-local axis index.
            now_ns: instant of the write; a command that needs not wait begins exactly then.
            replace: empty the buffers of the axes named in the records first, and re-plan from the
                present state without a jump.

        Raises:
            CommandError: EINVAL, ERANGE, EAGAIN (no room), EPERM (emergency stop, home required),
                EIO (fault), EBUSY (homing), with the sentence for the writer.
        """
        commands = self._queue.admit(records, axes, replace=replace)
        if not self._seen:
            raise CommandError(errno.EIO, "write: no position has been measured yet; wait for the first tick")
        self._advance(now_ns)
        if replace:
            self._drop(np.unique(commands["axis"]).astype(np.int64))
        touched = self._queue.append(commands)
        if replace:
            self._row_signals[self._store.row[touched]] = False
            self._store.cut(touched, now_ns)
        else:
            self._release(touched, now_ns)
        self._todo.update(dict.fromkeys(touched[~self._ready[touched]].tolist()))
        self._advance(now_ns)
        self._refresh(touched)

    def room(self, axes: AxesLike) -> int:
        """Return how many further commands fit into the fullest buffer of these axes."""
        return int(self._queue.room_of_all()[np.asarray(axes)].min())

    def flush(self, axes: AxesLike) -> None:
        """Empty the buffers; the running command goes on."""
        self._drop(np.asarray(axes, dtype=np.int64))

    def synch(self, axes: AxesLike, start_ns: int, now_ns: int) -> tuple[int, ...]:
        """Start the commands that wait for the external synch, all exactly at start_ns.

        A command is started when it holds its axis: it is the next, and what runs before it is a
        hold or lasts until the next command. Others are not affected.

        Returns:
            the axes released.
        """
        self._advance(now_ns)
        chosen = np.asarray(axes, dtype=np.int64)
        open_ended = np.isinf(self._store.duration[self._store.row[chosen]])
        chosen = chosen[self._queue.gated_synch[chosen] & open_ended]
        self._queue.gated_synch[chosen] = False
        if chosen.size and now_ns - start_ns > self._tick_s * 1e9:
            text = f"the synch came {(now_ns - start_ns) * 1e-6:.3f} ms after its start time"
            self._abandon(chosen, now_ns, errno.ETIME, text)
            return ()
        self._release(chosen, start_ns)
        self._refresh(chosen)
        return tuple(chosen.tolist())

    def _release(self, axes: Axes, start_ns: int) -> None:
        """Let the heads of these axes, where no gate holds them, end an open-ended plan at start_ns."""
        queue, store = self._queue, self._store
        free = queue.has_head[axes] & ~queue.gated_synch[axes] & ~queue.gated_marker[axes]
        free &= np.isinf(store.duration[store.row[axes]]) & (store.cut_ns[axes] == UNCUT_NS)
        chosen = axes[free]
        if chosen.size:
            store.cut(chosen, start_ns)

    # -- stopping -----------------------------------------------------------------------------

    def stop(self, axes: AxesLike, now_ns: int) -> None:
        """Empty the buffers and stop at maximum deceleration; force mode goes over to holding."""
        self._advance(now_ns)
        self._halt(np.asarray(axes, dtype=np.int64), now_ns)

    def emergency_stop(self, axes: AxesLike, now_ns: int) -> None:
        """Stop as stop() does, but force outputs go to zero and stay there; latched until reset()."""
        chosen = np.asarray(axes, dtype=np.int64)
        self._advance(now_ns)
        fresh = chosen[(self._queue.latched[chosen] & int(AxisStatus.EMERGENCY_STOP)) == 0]
        if not fresh.size:
            return
        in_force = fresh[self._kind[fresh] == Kind.FORCE]
        had = self._queue.clear(fresh)
        self._queue.emit(EventKind.DROPPED, had, now_ns, errno.ECANCELED, "emergency stop")
        self._halt(fresh, now_ns)
        self._set_limp(in_force)
        self._queue.latched[fresh] |= int(AxisStatus.EMERGENCY_STOP)
        self._refresh(fresh)

    def reset(self, axes: AxesLike) -> None:
        """Clear emergency stop and fault; limp axes hold where they are. Nothing resumes."""
        chosen = np.asarray(axes, dtype=np.int64)
        self._queue.unlatch(chosen)
        limp = chosen[self._limp[chosen]]
        if limp.size:
            self._limp[limp] = False
            self._any_limp = bool(self._limp.any())
            self._hold(limp, self._position[limp], self._last_ns or 0)
        self._refresh(chosen)

    def fault(self, axes: AxesLike, text: str, now_ns: int | None = None) -> None:
        """Put axes in fault: buffers dropped, forces zero, steppers stopped; latched until reset()."""
        chosen = np.asarray(axes, dtype=np.int64)
        stamp = self._last_ns or 0 if now_ns is None else now_ns
        self._abandon(chosen, stamp, errno.EIO, text)
        self._set_limp(chosen[~self.stepper[chosen]])
        self._queue.latch_fault(chosen, text, stamp)
        self._refresh(chosen)

    def fault_text(self, axis: int) -> str:
        """Return why an axis is in fault, empty when it is not."""
        return self._queue.fault_text(axis)

    def _set_limp(self, axes: Axes) -> None:
        self._limp[axes] = True
        self._any_limp = bool(self._limp.any())

    def _abandon(self, axes: Axes, now_ns: int, errno_: int, text: str) -> None:
        """Stop axes for a reason of our own and tell their waiters."""
        busy = axes[~self._idle(axes)]
        self._queue.clear(axes)
        self._queue.emit(EventKind.DROPPED, busy, now_ns, errno_, text)
        self._halt(axes, now_ns)

    def _halt(self, axes: Axes, now_ns: int) -> None:
        """Empty buffers and brake from the present state."""
        self._homing.cancel(axes)
        self._drop(axes)
        moving = axes[(self._kind[axes] != Kind.HOLD) & (self._kind[axes] != Kind.STOP)]
        if moving.size:
            self._brake(moving, self._state(moving, now_ns), now_ns, Kind.STOP)
            self._advance(now_ns)

    def _drop(self, axes: Axes) -> None:
        self._queue.clear(axes)
        self._ready[axes] = False
        for axis in axes.tolist():
            self._todo.pop(axis, None)

    # -- coordinates and limits ---------------------------------------------------------------

    def calibrate(self, axes: AxesLike, positions: Sequence[float] | NDArray[np.float64]) -> None:
        """Give the present place of each axis a new coordinate, without motion.

        Raises:
            CommandError: EBUSY while an axis moves, ERANGE outside its soft limits, EINVAL when not finite.
        """
        chosen, wanted = np.asarray(axes, dtype=np.int64), np.asarray(positions, dtype=np.float64)
        self._queue.check_calibration(chosen, wanted, self._idle(chosen))
        for axis, by in zip(chosen.tolist(), (wanted - self._position[chosen]).tolist(), strict=True):
            self.shift(axis, by)

    def zero(self, axes: AxesLike) -> None:
        """Make the present place of each axis position 0; see calibrate()."""
        self.calibrate(axes, np.zeros(len(axes)))

    def set_limits(self, axes: AxesLike, **limits: float | None) -> None:
        """Narrow the limits of axes, or with None return to the configured ones; see CommandQueue.set_limits()."""
        if not self.is_idle(axes):
            raise CommandError(errno.EBUSY, "set limits: an axis moves or has commands; wait until it is idle")
        self._queue.set_limits(axes, limits, self._position)
        chosen = np.asarray(axes, dtype=np.int64)
        self._velocity_limit[chosen] = self._limits.velocity[chosen]
        self._acceleration_limit[chosen] = self._limits.acceleration[chosen]
        self._law.force_limit[chosen] = self._limits.force[chosen]

    def get_limits(self, axis: int) -> dict[str, float | None]:
        """Return the limits of an axis in force, None where there is none."""
        return self._queue.get_limits(axis)

    def home(self, axes: AxesLike, now_ns: int) -> None:
        """Start homing: fast to the switch, slowly off it, that edge is the reference; see homing.py."""
        chosen = np.asarray(axes, dtype=np.int64)
        self._advance(now_ns)
        self._homing.begin(chosen, self._idle(chosen), now_ns)
        self._refresh(chosen)

    def shift(self, axis: int, by: float) -> None:
        """Add to the coordinate of an axis, moving or not: actual and commanded position alike."""
        one = self._all[axis : axis + 1]
        self._offset[axis] += by
        self._position[axis] += by
        self._desired[axis] += by
        self._law.slewed[axis] += by
        self._store.shift(one, by)

    def drive(self, axis: int, velocity: float, now_ns: int) -> None:
        """Go over to a velocity from the present state, outside the buffer and the soft limits (homing)."""
        one = self._all[axis : axis + 1]
        command = Command._make([0.0] * len(Command._fields))._replace(control_mode=M.VELOCITY, velocity=velocity)
        state = self._state(one, now_ns)[0].tolist()
        bounds = self._bounds(axis, command)._replace(minimum=-np.inf, maximum=np.inf)
        self._store.put(int(self._store.row[axis]), self._planner.plan(command, tuple(state), bounds))
        self._set_kind(one, Kind.RATE)
        self._store.begin(one, np.array([now_ns]), np.zeros(1))
        self._refresh(one)

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
        last_ns = now_ns if self._last_ns is None else self._last_ns
        dt = self._elapsed(now_ns)
        self._measure(position, dt)
        if self._queue.waits_for_markers:
            self._poll_markers(now_ns)
        if now_ns >= self._store.next_ns:
            self._advance(now_ns)
        self._store.evaluate(now_ns, self._desired, self._desired_velocity)
        if self._any_guard:
            self._keep_limits(last_ns, now_ns)
        self._control(dt)
        self._watch(now_ns, switches)
        return self._actuator

    def _elapsed(self, now_ns: int) -> float:
        last = self._last_ns
        self._last_ns = now_ns
        if last is None:
            return self._tick_s
        elapsed = now_ns - last
        if elapsed > self._late_ns:
            self._stop_late(last, now_ns)
        return max(elapsed * 1e-9, 0.1 * self._tick_s)

    def _stop_late(self, last_ns: int, now_ns: int) -> None:
        """Stop what moved, from the state of the last tick: a late tick never catches up."""
        moving = np.flatnonzero(self._kind != Kind.HOLD)
        if not moving.size:
            return
        text = f"the tick came {(now_ns - last_ns) * 1e-6:.1f} ms after the last; at most {self._late_ns * 1e-6:g} ms"
        state = self._state(moving, last_ns)
        self._drop(moving)
        self._brake(moving, state, now_ns, Kind.STOP)
        self._queue.emit(EventKind.DROPPED, moving, now_ns, errno.ETIME, text)
        self._queue.latch_fault(moving, text, now_ns, errno.ETIME)
        self._refresh(moving)

    def _measure(self, position: NDArray[np.float64], dt: float) -> None:
        raw, scratch, velocity = self._raw, self._scratch, self._velocity
        if not np.isfinite(position.sum()):
            position = self._refuse_measurement(position)
        raw[:] = position
        np.add(raw, self._offset, out=self._position)
        if not self._seen:
            self._seen = True
            self._last_raw[:] = raw
            self._law.slewed[:] = self._position
            idle = self._all[self._idle(self._all)]
            self._hold(idle, self._position[idle], self._last_ns or 0)
        np.subtract(raw, self._last_raw, out=scratch)
        scratch /= dt
        scratch -= velocity
        scratch *= dt / (self._filter + dt)
        velocity += scratch
        self._last_raw[:] = raw

    def _refuse_measurement(self, position: NDArray[np.float64]) -> NDArray[np.float64]:
        bad = np.flatnonzero(~np.isfinite(position))
        self.fault(bad, "the measured position is not a finite number")
        good = position.copy()
        good[bad] = self._last_raw[bad]
        return good

    def _control(self, dt: float) -> None:
        law, desired = self._law, self._desired
        rows = self._kind == Kind.FORCE if self._any_force else None
        law.step(desired, self._desired_velocity, self._position, self._velocity, dt, rows)
        if rows is not None:
            self._follow_actual(rows)
        if self._any_limp:
            law.output[self._limp] = 0.0
            law.error[self._limp] = 0.0
            self._follow_actual(self._limp)
        out = self._actuator
        out[:] = law.output
        self._force[:] = law.output
        if not law.all_servo:
            s = self.stepper
            out[s] = law.slewed[s] - self._offset[s]
            self._force[s] = 0.0
            desired[s] = law.slewed[s]
        np.subtract(desired, self._position, out=self._following)

    def _follow_actual(self, rows: NDArray[np.bool_]) -> None:
        """Where no position is commanded, the commanded position is the actual one."""
        self._desired[rows] = self._position[rows]
        self._desired_velocity[rows] = self._velocity[rows]

    def _watch(self, now_ns: int, switches: NDArray[np.int64] | None) -> None:
        """Following error, saturation, switches: status bits and what they cause."""
        status = self._status_word
        np.multiply(self._law.saturated, int(AxisStatus.SATURATED), out=status)
        status |= self._base_status
        np.abs(self._following, out=self._scratch)
        over = self._scratch > self._error_max
        if over.any():
            self._lose(np.flatnonzero(over & ~self._limp), now_ns)
        if self._homing.active:
            self._home_on(switches, now_ns)
        if switches is not None:
            status |= (switches & 3) * int(AxisStatus.SWITCH_MINUS)
            self._keep_switches(switches, now_ns)
        self._queue.count(self._buffered)

    def _lose(self, axes: Axes, now_ns: int) -> None:
        fresh = axes[(self._queue.latched[axes] & int(AxisStatus.FOLLOWING_ERROR)) == 0]
        for axis in fresh.tolist():
            one = np.array([axis])
            bits = AxisStatus.FOLLOWING_ERROR | (AxisStatus.STALLED if self.stepper[axis] else AxisStatus(0))
            self._queue.latched[axis] |= int(bits)
            text = (
                f"following error {self._following[axis]:g} {self.settings[axis].unit}; "
                f"at most {self._error_max[axis]:g}"
            )
            self.fault(one, text, now_ns)
            if not self.stepper[axis]:
                self._actuator[axis] = self._force[axis] = self._law.output[axis] = 0.0

    # -- limits in every tick -----------------------------------------------------------------

    def _keep_limits(self, last_ns: int, now_ns: int) -> None:
        """Brake axes whose stopping distance v^2 / (2 a) no longer fits inside their soft limits.

        Set-points were last put out at last_ns, so the brake may begin at the instant in between at
        which the distance was just enough: the axis stands at the limit, however long the tick was.
        """
        axes = np.flatnonzero(self._guard)
        force = self._kind[axes] == Kind.FORCE
        state = np.stack((self._desired[axes], self._desired_velocity[axes]), axis=1)
        if force.any():
            state[force] = self._state(axes[force], now_ns)[:, :2]
        side = self._beyond(axes, state)
        fast = force & (np.abs(state[:, 1]) > self._limits.velocity[axes])
        hit = (side != 0) | fast
        if not hit.any():
            return
        for bit, sign in ((AxisStatus.LIMIT_MINUS, -1), (AxisStatus.LIMIT_PLUS, 1)):
            self._limit_bits[axes[side == sign]] |= int(bit)
        text = "stopped at the limit of position or, in force mode, of velocity"
        self._queue.emit(EventKind.DROPPED, axes[hit], now_ns, errno.ERANGE, text)
        self._drop(axes[hit])
        if (hit & force).any():
            free = axes[hit & force]
            self._brake(free, self._state(free, now_ns), now_ns, Kind.STOP)
        for axis in axes[hit & ~force].tolist():
            self._brake_at_limit(self._all[axis : axis + 1], last_ns, now_ns)
        self._advance(now_ns)
        self._store.evaluate(now_ns, self._desired, self._desired_velocity)

    def _beyond(self, axes: Axes, state: NDArray[np.float64]) -> NDArray[np.int64]:
        """Return -1 or +1 for the limit that an axis in this state would pass when braked, else 0."""
        v = state[:, 1]
        stand = state[:, 0] + v * np.abs(v) / (2 * self._limits.acceleration[axes])
        minus = (stand < self._limits.minimum[axes]) & (v < 0)
        plus = (stand > self._limits.maximum[axes]) & (v > 0)
        side: NDArray[np.int64] = plus.astype(np.int64) - minus
        return side

    def _brake_at_limit(self, axis: Axes, last_ns: int, now_ns: int) -> None:
        early, late = max(last_ns, int(self._store.segment_ns[axis[0]])), now_ns
        while late - early > 1:
            middle = (early + late) // 2
            if self._beyond(axis, self._store.state(axis, middle))[0]:
                late = middle
            else:
                early = middle
        self._brake(axis, self._store.state(axis, early), early, Kind.STOP)

    def _keep_switches(self, switches: NDArray[np.int64], now_ns: int) -> None:
        v = self._desired_velocity
        hit = ((switches & SWITCH_MINUS) != 0) & (v < -REST) | ((switches & SWITCH_PLUS) != 0) & (v > REST)
        hit &= (self._queue.latched & int(AxisStatus.HOMING)) == 0
        hit &= (self._kind != Kind.STOP) & (self._kind != Kind.HOLD)
        if hit.any():
            self._abandon(np.flatnonzero(hit), now_ns, errno.ERANGE, "stopped by an end switch")

    def _home_on(self, switches: NDArray[np.int64] | None, now_ns: int) -> None:
        for axis, reason in self._homing.tick(switches, now_ns):
            self.fault([axis], reason, now_ns)
        self._refresh(self._all)

    # -- transitions --------------------------------------------------------------------------

    def _advance(self, now_ns: int) -> None:
        """Carry out everything that was due until now, in order of the axes' own instants."""
        store = self._store
        while (axes := store.due(now_ns)).size:
            ended = store.advance(axes)
            if ended.size:
                self._finish(ended, now_ns)

    def _finish(self, axes: Axes, now_ns: int) -> None:
        """End the running plans of these axes and begin what follows, at their exact instants."""
        store, queue = self._store, self._queue
        rows = store.row[axes]
        start_ns, fraction = store.ended_at(axes)
        commanded = np.isin(self._row_kind[rows], (Kind.POSITION, Kind.RATE, Kind.FORCE))
        queue.emit(EventKind.ENDED, axes[commanded], now_ns)
        for row in rows[self._row_signals[rows]].tolist():
            self._signal(row, now_ns)
        lacking = axes[~queue.has_head[axes]]
        if lacking.size:
            queue.load_heads(lacking)
        free = queue.has_head[axes] & ~queue.gated_synch[axes] & ~queue.gated_marker[axes]
        for axis in axes[free & ~self._ready[axes]].tolist():
            self._plan_head(axis, self._end_state(axis), now_ns)
        go = free & self._ready[axes]
        if go.any():
            self._start(axes[go], start_ns[go], fraction[go], now_ns)
        if not go.all():
            self._rest(axes[~go], start_ns[~go], fraction[~go], now_ns)

    def _signal(self, row: int, now_ns: int) -> None:
        command = self._row_command[row]
        self._row_signals[row] = False
        if command is not None:
            self._queue.signal(command.signal_marker_number, command.signal_generation, now_ns)

    def _end_state(self, axis: int) -> tuple[float, float, float]:
        if self._kind[axis] == Kind.FORCE:
            return float(self._position[axis]), float(self._velocity[axis]), 0.0
        p, v, a = self._store.final[self._store.row[axis]].tolist()
        return p, v, a

    def _start(self, axes: Axes, start_ns: NDArray[np.int64], fraction: NDArray[np.float64], now_ns: int) -> None:
        store, queue = self._store, self._queue
        store.flip(axes)
        rows = store.row[axes]
        store.begin(axes, start_ns, fraction)
        self._ready[axes] = False
        self._kind[axes] = self._row_kind[rows]
        self._guard[axes] = self._row_guard[rows]
        self._limit_bits[axes] = 0
        queue.has_head[axes] = False
        self._todo.update(dict.fromkeys(axes.tolist()))
        for axis in axes[self._row_special[rows]].tolist():
            self._specify(axis)
        queue.emit(EventKind.STARTED, axes, now_ns)
        self._settle_masks()
        self._refresh(axes)

    def _specify(self, axis: int) -> None:
        """Put the gains, offset and limits that a command specifies in force; they stay."""
        c = self._row_command[int(self._store.row[axis])]
        if c is None:
            return
        law, mode = self._law, c.control_mode
        if mode & M.SPECIFIED_GAINS:
            law.k[axis], law.kz[axis], law.kp[axis], law.kb[axis] = c.k, c.kz, c.kp, c.kb
        if mode & M.SPECIFIED_FORCE_OFFSET:
            law.offset[axis] = c.force_offset
        if mode & M.SPECIFIED_MAX_VEL_ACC:
            self._velocity_limit[axis], self._acceleration_limit[axis] = c.max_velocity, c.max_acceleration
        if mode & M.SPECIFIED_MAX_FORCE:
            law.force_limit[axis] = c.max_force

    def _rest(self, axes: Axes, start_ns: NDArray[np.int64], fraction: NDArray[np.float64], now_ns: int) -> None:
        """Nothing follows: hold those at rest, brake the others."""
        store = self._store
        state = store.final[store.row[axes]]
        force = self._kind[axes] == Kind.FORCE
        if force.any():
            state = state.copy()
            state[force, 0] = self._position[axes[force]]
            state[force, 1] = self._velocity[axes[force]]
        still = np.abs(state[:, 1]) <= REST
        if still.any():
            chosen = axes[still]
            store.put_hold(store.row[chosen], state[still, 0])
            self._set_kind(chosen, Kind.HOLD)
            store.begin(chosen, start_ns[still], fraction[still])
            done = chosen[self._idle(chosen)]
            self._queue.emit(EventKind.IDLE, done, now_ns)
        moving = ~still
        if moving.any():
            chosen = axes[moving]
            limit = self._limits.acceleration[chosen]
            store.put_brake(store.row[chosen], state[moving, 0], state[moving, 1], limit)
            self._set_kind(chosen, Kind.BRAKE)
            store.begin(chosen, start_ns[moving], fraction[moving])
        self._settle_masks()
        self._refresh(axes)

    def _brake(self, axes: Axes, state: NDArray[np.float64], now_ns: int, kind: Kind) -> None:
        store = self._store
        store.put_brake(store.row[axes], state[:, 0], state[:, 1], self._limits.acceleration[axes])
        self._set_kind(axes, kind)
        store.begin(axes, np.full(axes.size, now_ns), np.zeros(axes.size))
        store.next_ns = 0
        self._settle_masks()
        self._refresh(axes)

    def _hold(self, axes: Axes, position: NDArray[np.float64], now_ns: int) -> None:
        if not axes.size:
            return
        store = self._store
        store.put_hold(store.row[axes], position)
        self._set_kind(axes, Kind.HOLD)
        store.begin(axes, np.full(axes.size, now_ns), np.zeros(axes.size))
        self._settle_masks()
        self._refresh(axes)

    def _set_kind(self, axes: Axes, kind: Kind) -> None:
        rows = self._store.row[axes]
        self._kind[axes] = self._row_kind[rows] = kind
        self._guard[axes] = False
        self._row_signals[rows] = False

    def _settle_masks(self) -> None:
        self._any_force = bool((self._kind == Kind.FORCE).any())
        self._any_guard = bool(self._guard.any())

    def _state(self, axes: Axes, now_ns: int) -> NDArray[np.float64]:
        """Return the set-point state (m, 3) at now; of force-mode axes the measured one."""
        state = self._store.state(axes, now_ns)
        force = self._kind[axes] == Kind.FORCE
        if force.any():
            state[force, 0] = self._position[axes[force]]
            state[force, 1] = self._velocity[axes[force]]
            state[force, 2] = 0.0
        return state

    def _poll_markers(self, now_ns: int) -> None:
        released, broken = self._queue.poll_markers()
        if released:
            self._release(np.array(released), now_ns)
        for axis, number in broken:
            self._abandon(np.array([axis]), now_ns, errno.EPIPE, f"marker {number} was freed while waited for")

    # -- planning -----------------------------------------------------------------------------

    def plan_ahead(self, count: int = 32) -> int:
        """Plan up to ``count`` next commands whose starting state is known, in the slack between ticks.

        Returns:
            how many axes were looked at; 0 when there is nothing to do.
        """
        done = 0
        self._store.settle_order()
        while self._todo and done < count:
            axis, _ = self._todo.popitem()
            done += 1
            one = self._all[axis : axis + 1]
            self._queue.load_heads(one)
            if self._queue.has_head[axis] and not self._ready[axis] and self._steady_end(axis):
                self._plan_head(axis, self._end_state(axis), self._last_ns or 0)
        return done

    def _steady_end(self, axis: int) -> bool:
        kind = self._kind[axis]
        finite = bool(np.isfinite(self._store.duration[self._store.row[axis]]))
        return bool(kind == Kind.HOLD or (finite and kind != Kind.FORCE))

    def _plan_head(self, axis: int, state: tuple[float, float, float], now_ns: int) -> None:
        """Plan the head of an axis from a state into its other row; a failure is a latched fault."""
        command = self._queue.heads[axis]
        if command is None:
            return
        mode = command.control_mode
        row = int(self._store.row[axis]) ^ 1
        try:
            if mode & (M.FORCE | M.FORCE_VELOCITY):
                plan, kind = self._plan_force(axis, command), Kind.FORCE
            else:
                plan = self._planner.plan(command, state, self._bounds(axis, command))
                kind = Kind.POSITION if mode & M.POSITION else Kind.RATE
        except InfeasibleError as e:
            self._refuse_plan(axis, str(e), now_ns)
            return
        self._store.put(row, plan)
        self._row_kind[row] = kind
        self._row_guard[row] = plan.guard
        self._row_command[row] = command
        self._row_signals[row] = bool(mode & M.SPECIFIED_SIGNAL_MARKER)
        self._row_special[row] = bool(mode & int(SPECIALS))
        self._ready[axis] = True

    def _bounds(self, axis: int, command: Command) -> Bounds:
        limits = self._limits
        velocity, acceleration = float(self._velocity_limit[axis]), float(self._acceleration_limit[axis])
        if command.control_mode & M.SPECIFIED_MAX_VEL_ACC:
            velocity, acceleration = command.max_velocity, command.max_acceleration
        return Bounds(
            velocity, acceleration, float(limits.jerk[axis]), float(limits.minimum[axis]), float(limits.maximum[axis])
        )

    def _plan_force(self, axis: int, command: Command) -> Plan:
        """Return force over time as a plan: a constant, or a ramp up to the force limit and on."""
        mode = command.control_mode
        duration = command.time if mode & M.SPECIFIED_TIME and command.time > 0 else np.inf
        if mode & M.FORCE:
            level = command.force
            return Plan([(duration, level, 0.0, 0.0, 0.0, 0.0, 0.0)], duration, (level, 0.0, 0.0), True)
        limit = float(self._law.force_limit[axis])
        present = float(np.clip(self._law.output[axis], -limit, limit))
        rate = command.force_velocity
        goal = limit if rate > 0 else -limit
        ramp = (goal - present) / rate if rate else np.inf
        segments = [(min(ramp, duration), present, rate, 0.0, 0.0, 0.0, 0.0)]
        if ramp < duration:
            segments.append((duration - ramp, goal, 0.0, 0.0, 0.0, 0.0, 0.0))
        return Plan(segments, duration, (goal, 0.0, 0.0), True)

    def _refuse_plan(self, axis: int, text: str, now_ns: int) -> None:
        """A command turned out infeasible: drop the buffer and latch a fault; the axis brakes and holds."""
        one = self._all[axis : axis + 1]
        self._drop(one)
        self._queue.emit(EventKind.DROPPED, one, now_ns, errno.ERANGE, text)
        self._queue.latch_fault(one, text, now_ns, errno.ERANGE)
        self._refresh(one)

    # -- answers ------------------------------------------------------------------------------

    def is_idle(self, axes: AxesLike) -> bool:
        """Tell whether these axes hold still and have no commands."""
        return bool(self._idle(np.asarray(axes, dtype=np.int64)).all())

    def _idle(self, axes: Axes) -> NDArray[np.bool_]:
        idle: NDArray[np.bool_] = (self._kind[axes] == Kind.HOLD) & ~self._queue.has_head[axes]
        idle &= (self._queue.latched[axes] & int(AxisStatus.HOMING)) == 0
        return idle

    def take_events(self) -> list[Event]:
        """Return what happened since the last call, oldest first."""
        return self._queue.take_events()

    def _refresh(self, axes: Axes) -> None:
        """Rebuild the status bits that change with events only."""
        kind, queue = self._kind[axes], self._queue
        held = kind == Kind.HOLD
        status = queue.latched[axes] | self._limit_bits[axes]
        status |= np.where(held, 0, int(AxisStatus.MOVING))
        status |= np.where(kind == Kind.FORCE, int(AxisStatus.FORCE_MODE), 0)
        status |= np.where(kind == Kind.STOP, int(AxisStatus.STOPPING), 0)
        waiting = np.isinf(self._store.duration[self._store.row[axes]])
        status |= np.where(waiting & queue.gated_marker[axes], int(AxisStatus.WAITING_MARKER), 0)
        status |= np.where(waiting & queue.gated_synch[axes], int(AxisStatus.WAITING_SYNCH), 0)
        self._base_status[axes] = status
        self._in_motion[axes] = ~held


class _HomingMover:
    """The bank as homing sees it: velocity, halt and coordinate of one axis."""

    def __init__(self, bank: AxisBank) -> None:
        self._bank = bank

    def drive(self, axis: int, velocity: float, now_ns: int) -> None:
        """Go over to this velocity from the present state."""
        self._bank.drive(axis, velocity, now_ns)

    def halt(self, axis: int, now_ns: int) -> None:
        """Stop at maximum deceleration."""
        bank, one = self._bank, np.array([axis])
        bank._brake(one, bank._state(one, now_ns), now_ns, Kind.STOP)

    def stands(self, axis: int) -> bool:
        """Tell whether the axis holds still."""
        return bool(self._bank._kind[axis] == Kind.HOLD)

    def measured(self, axis: int) -> float:
        """Return the measured position."""
        return float(self._bank._position[axis])

    def shift(self, axis: int, by: float) -> None:
        """Add to the coordinate of the axis, also in motion."""
        self._bank.shift(axis, by)
