"""DriveBank: buffers, markers, synch and latches for drives that close their own loop.

The drive makes its own profile; the bank decides when a command goes out and when it has ended.
poll() takes what the drive reports and answers with actions for the driver to carry out. Pure, and
one thread, as AxisBank.
"""

from __future__ import annotations

import errno
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sioms.protocol.flags import AxisStatus, ControlMode
from sioms.protocol.records import AXIS_READ_FIELDS

from .commands import Command
from .queue import AxesLike, CommandQueue
from .types import AxisSettings, CommandError, Event, EventKind, MarkerPort

M = ControlMode
Axes = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class StartCommand:
    """Start this command on this axis now; position is absolute and in the axis' raw coordinates."""

    axis: int
    command: Command
    velocity_max: float
    acceleration_max: float


@dataclass(frozen=True, slots=True)
class StopAxis:
    """Stop this axis: fastest (emergency stop, fault) or controlled at maximum deceleration."""

    axis: int
    fastest: bool


Action = StartCommand | StopAxis


class DriveBank:
    """The axes of one device whose drives close their own loops.

    Args:
        settings: one per axis; ``modes`` holds the control-mode flags that the drive has, everything
            else is refused (EINVAL) before anything moves.
        markers: seam to the marker table.
        capacity: commands that each axis' buffer holds.
        settle_s: how long after its start a command may take to be reported as moving [s]; until
            then 'done' reports are not believed.

    ``fields`` as in AxisBank. Concurrency: one thread.
    """

    def __init__(
        self,
        settings: Sequence[AxisSettings],
        *,
        markers: MarkerPort,
        capacity: int = 16384,
        settle_s: float = 0.05,
    ) -> None:
        n = self.n = len(settings)
        self.settings = tuple(settings)
        self.fields = np.zeros((len(AXIS_READ_FIELDS), n))
        integers = self.fields.view(np.int64)
        self._position, self._velocity = self.fields[0], self.fields[1]
        self._desired, self._desired_velocity, self._following = self.fields[7], self.fields[8], self.fields[9]
        self._in_motion, self._status_word, self._buffered = integers[10], integers[11], integers[12]
        self._queue = CommandQueue(settings, markers, capacity)
        self._limits = self._queue.limits
        self._velocity_limit = self._limits.velocity.copy()
        self._acceleration_limit = self._limits.acceleration.copy()
        self._running: list[Command | None] = [None] * n
        self._active = np.zeros(n, dtype=bool)
        self._stopping = np.zeros(n, dtype=bool)
        self._moved = np.zeros(n, dtype=bool)
        self._started_ns = np.zeros(n, dtype=np.int64)
        self._end_ns = np.full(n, 2**62, dtype=np.int64)
        self._end_fraction = np.zeros(n)
        self._release_ns = np.zeros(n, dtype=np.int64)
        self._offset = np.zeros(n)
        self._target = np.zeros(n)
        self._settle_ns = int(settle_s * 1e9)
        self._stops: dict[int, bool] = {}
        self._seen = False
        self._last_ns = 0

    # -- verbs: as AxisBank --------------------------------------------------------------------

    def append(self, records: NDArray[Any], axes: AxesLike, now_ns: int, *, replace: bool = False) -> None:
        """Append written records, all or none; see AxisBank.append()."""
        commands = self._queue.admit(records, axes, replace=replace)
        if not self._seen:
            raise CommandError(errno.EIO, "write: the drive has not reported its position yet; wait for it")
        if replace:
            touched = np.unique(commands["axis"]).astype(np.int64)
            self._queue.clear(touched)
            self._end_ns[touched] = now_ns
            self._end_fraction[touched] = 0.0
            for axis in touched.tolist():
                self._running[axis] = None
        self._queue.append(commands)

    def room(self, axes: AxesLike) -> int:
        """Return how many further commands fit into the fullest buffer of these axes."""
        return int(self._queue.room_of_all()[np.asarray(axes)].min())

    def flush(self, axes: AxesLike) -> None:
        """Empty the buffers; the running command goes on."""
        self._queue.clear(np.asarray(axes, dtype=np.int64))

    def synch(self, axes: AxesLike, start_ns: int, now_ns: int) -> tuple[int, ...]:
        """Release the commands that wait for the external synch; they go out in the poll at start_ns."""
        chosen = np.asarray(axes, dtype=np.int64)
        chosen = chosen[self._queue.gated_synch[chosen] & (~self._active[chosen] | self._open_ended(chosen))]
        self._queue.gated_synch[chosen] = False
        self._release_ns[chosen] = start_ns
        return tuple(chosen.tolist())

    def stop(self, axes: AxesLike, now_ns: int) -> None:
        """Empty the buffers and stop at maximum deceleration, in the next poll."""
        self._halt(np.asarray(axes, dtype=np.int64), fastest=False)

    def emergency_stop(self, axes: AxesLike, now_ns: int) -> None:
        """Empty the buffers and stop the fastest way the drive has; latched until reset()."""
        chosen = np.asarray(axes, dtype=np.int64)
        fresh = chosen[(self._queue.latched[chosen] & int(AxisStatus.EMERGENCY_STOP)) == 0]
        busy = fresh[~self._idle(fresh)]
        self._queue.latched[fresh] |= int(AxisStatus.EMERGENCY_STOP)
        self._queue.emit(EventKind.DROPPED, busy, now_ns, errno.ECANCELED, "emergency stop")
        self._halt(fresh, fastest=True)

    def reset(self, axes: AxesLike) -> None:
        """Clear emergency stop and fault. Nothing resumes."""
        self._queue.unlatch(np.asarray(axes, dtype=np.int64))

    def fault(self, axes: AxesLike, text: str, now_ns: int | None = None) -> None:
        """Put axes in fault: buffers dropped, the drive stopped the fastest way; latched until reset()."""
        chosen = np.asarray(axes, dtype=np.int64)
        stamp = self._last_ns if now_ns is None else now_ns
        busy = chosen[~self._idle(chosen)]
        self._queue.emit(EventKind.DROPPED, busy, stamp, errno.EIO, text)
        self._halt(chosen, fastest=True)
        self._queue.latch_fault(chosen, text, stamp)

    def fault_text(self, axis: int) -> str:
        """Return why an axis is in fault, empty when it is not."""
        return self._queue.fault_text(axis)

    def calibrate(self, axes: AxesLike, positions: Sequence[float] | NDArray[np.float64]) -> None:
        """Give the present place of each axis a new coordinate, without motion; see AxisBank.calibrate()."""
        chosen, wanted = np.asarray(axes, dtype=np.int64), np.asarray(positions, dtype=np.float64)
        self._queue.check_calibration(chosen, wanted, self._idle(chosen))
        self._offset[chosen] += wanted - self._position[chosen]
        self._position[chosen] = wanted
        self._target[chosen] = wanted

    def zero(self, axes: AxesLike) -> None:
        """Make the present place of each axis position 0; see calibrate()."""
        self.calibrate(axes, np.zeros(len(axes)))

    def set_limits(self, axes: AxesLike, **limits: float | None) -> None:
        """Narrow the limits of axes; see CommandQueue.set_limits()."""
        self._queue.set_limits(axes, limits, self._position)

    def get_limits(self, axis: int) -> dict[str, float | None]:
        """Return the limits of an axis in force, None where there is none."""
        return self._queue.get_limits(axis)

    def is_idle(self, axes: AxesLike) -> bool:
        """Tell whether these axes stand still and have no commands."""
        return bool(self._idle(np.asarray(axes, dtype=np.int64)).all())

    def take_events(self) -> list[Event]:
        """Return what happened since the last call, oldest first."""
        return self._queue.take_events()

    def set_homed(self, axes: AxesLike, homed: bool = True) -> None:
        """Note that the drive has found (or lost) its reference."""
        chosen = np.asarray(axes, dtype=np.int64)
        bit = int(AxisStatus.HOMED)
        fresh = chosen[((self._queue.latched[chosen] & bit) != 0) != homed]
        self._queue.latched[fresh] ^= bit
        if homed:
            self._queue.emit(EventKind.HOMED, fresh, self._last_ns)

    # -- the poll ------------------------------------------------------------------------------

    def poll(
        self,
        now_ns: int,
        position: NDArray[np.float64],
        velocity: NDArray[np.float64],
        moving: NDArray[np.bool_],
        done: NDArray[np.bool_],
        fault: Sequence[str] | None = None,
        force: NDArray[np.float64] | None = None,
    ) -> list[Action]:
        """Take the drives' reports and return what shall be sent to them, stops first.

        Args:
            now_ns: instant of the report [ns].
            position: raw positions (n,).
            velocity: measured velocities (n,).
            moving: drive says it moves (n,).
            done: drive says its last command is finished (n,); believed only once the command was
                seen moving, or settle_s after it went out.
            fault: fault text of each axis, empty when it has none; None when none has.
            force: measured forces or torques (n,), None when the drive tells none.
        """
        self._last_ns = now_ns
        self._seen = True
        self._take(now_ns, position, velocity, fault, force)
        self._poll_markers(now_ns)
        self._end_commands(now_ns, moving, done)
        actions: list[Action] = [StopAxis(axis, fastest) for axis, fastest in self._stops.items()]
        self._stops.clear()
        actions.extend(self._start_commands(now_ns))
        self._publish(moving)
        return actions

    def _take(
        self,
        now_ns: int,
        position: NDArray[np.float64],
        velocity: NDArray[np.float64],
        fault: Sequence[str] | None,
        force: NDArray[np.float64] | None,
    ) -> None:
        good = np.isfinite(position) & np.isfinite(velocity)
        np.add(position, self._offset, out=self._position, where=good)
        np.copyto(self._velocity, velocity, where=good)
        if force is not None:
            self.fields[2] = force
        if not good.all():
            self._fault_fresh(np.flatnonzero(~good), "the reported position is not a finite number", now_ns)
        for axis, text in enumerate(fault or ()):
            if text:
                self._fault_fresh(np.array([axis]), text, now_ns)

    def _fault_fresh(self, axes: Axes, text: str, now_ns: int) -> None:
        fresh = axes[(self._queue.latched[axes] & int(AxisStatus.FAULT)) == 0]
        if fresh.size:
            self.fault(fresh, text, now_ns)

    def _poll_markers(self, now_ns: int) -> None:
        _, broken = self._queue.poll_markers()
        for axis, number in broken:
            text = f"marker {number} was freed while waited for"
            self._queue.emit(EventKind.DROPPED, np.array([axis]), now_ns, errno.EPIPE, text)
            self._halt(np.array([axis]), fastest=False)

    def _open_ended(self, axes: Axes) -> NDArray[np.bool_]:
        """Tell which running commands last until the next one arrives."""
        return np.array([c is not None and _is_open_ended(c) for c in (self._running[a] for a in axes)], dtype=bool)

    def _end_commands(self, now_ns: int, moving: NDArray[np.bool_], done: NDArray[np.bool_]) -> None:
        settled = now_ns - self._started_ns >= self._settle_ns
        self._moved |= moving & self._active
        reached = self._active & ~moving & done & (self._moved | settled)
        ended = np.zeros(self.n, dtype=bool)
        for axis in np.flatnonzero(self._active).tolist():
            command = self._running[axis]
            if self._stopping[axis] or (command is not None and _ends_by_itself(command)):
                ended[axis] = reached[axis] or (self._stopping[axis] and settled[axis] and not moving[axis])
            else:
                ended[axis] = now_ns >= self._end_ns[axis]
        for axis in np.flatnonzero(ended).tolist():
            self._end(axis, now_ns)

    def _end(self, axis: int, now_ns: int) -> None:
        command, one = self._running[axis], np.array([axis])
        self._running[axis] = None
        if command is not None:
            self._queue.emit(EventKind.ENDED, one, now_ns)
            if command.control_mode & M.SPECIFIED_SIGNAL_MARKER:
                self._queue.signal(command.signal_marker_number, command.signal_generation, now_ns)
        was_stop = bool(self._stopping[axis])
        self._active[axis] = self._stopping[axis] = False
        self._queue.load_heads(one)
        if not self._queue.has_head[axis]:
            if was_stop or command is None or _ends_by_itself(command):
                self._queue.emit(EventKind.IDLE, one, now_ns)
            else:
                self._halt(one, fastest=False)

    def _start_commands(self, now_ns: int) -> list[Action]:
        queue = self._queue
        queue.load_heads(np.arange(self.n))
        free = queue.has_head & ~queue.gated_synch & ~queue.gated_marker & ~self._stopping
        free &= self._release_ns <= now_ns
        actions: list[Action] = []
        for axis in np.flatnonzero(free).tolist():
            if self._active[axis] and self._running[axis] is not None:
                if not self._open_ended(np.array([axis]))[0]:
                    continue
                self._end(axis, now_ns)
            start = self._start(axis, now_ns)
            if start is not None:
                actions.append(start)
        return actions

    def _start(self, axis: int, now_ns: int) -> StartCommand | None:
        command, one = self._queue.heads[axis], np.array([axis])
        if command is None:
            return None
        mode = command.control_mode
        if mode & M.POSITION:
            target = command.position + (self._target[axis] if mode & M.RELATIVE else 0.0)
            low, high = self._limits.minimum[axis], self._limits.maximum[axis]
            if not low <= target <= high:
                text = f"position {target:g} is outside the soft limits; {low:g} to {high:g}"
                self.fault(one, text, now_ns)
                return None
            self._target[axis] = target
            command = command._replace(position=float(target - self._offset[axis]))
        if mode & M.SPECIFIED_MAX_VEL_ACC:
            self._velocity_limit[axis], self._acceleration_limit[axis] = command.max_velocity, command.max_acceleration
        timed = bool(mode & M.SPECIFIED_TIME) and command.time > 0
        due_ns, fraction = (int(self._end_ns[axis]), float(self._end_fraction[axis]))
        if not 0 <= now_ns - due_ns < self._settle_ns:
            due_ns, fraction = now_ns, 0.0
        total = fraction + command.time * 1e9
        self._end_ns[axis] = due_ns + int(total) if timed else 2**62
        self._end_fraction[axis] = total % 1.0 if timed else 0.0
        self._queue.has_head[axis] = False
        self._running[axis] = command
        self._active[axis] = True
        self._moved[axis] = False
        self._started_ns[axis] = now_ns
        self._queue.emit(EventKind.STARTED, one, now_ns)
        return StartCommand(
            axis, command, float(self._velocity_limit[axis]), float(self._acceleration_limit[axis])
        )

    def _halt(self, axes: Axes, *, fastest: bool) -> None:
        self._queue.clear(axes)
        for axis in axes.tolist():
            self._running[axis] = None
            self._stops[axis] = self._stops.get(axis, False) or fastest
        self._active[axes] = True
        self._stopping[axes] = True
        self._started_ns[axes] = self._last_ns

    def _publish(self, moving: NDArray[np.bool_]) -> None:
        running = np.array([c is not None for c in self._running])
        position_mode = np.array([c is not None and bool(c.control_mode & M.POSITION) for c in self._running])
        self._target[~self._active] = self._position[~self._active]
        np.copyto(self._desired, np.where(position_mode, self._target, self._position))
        np.subtract(self._desired, self._position, out=self._following)
        self._in_motion[:] = self._active | moving
        status = self._queue.latched.copy()
        status |= np.where(self._active | moving, int(AxisStatus.MOVING), 0)
        status |= np.where(self._stopping, int(AxisStatus.STOPPING), 0)
        status |= np.where(self._queue.gated_marker & ~running, int(AxisStatus.WAITING_MARKER), 0)
        status |= np.where(self._queue.gated_synch & ~running, int(AxisStatus.WAITING_SYNCH), 0)
        self._status_word[:] = status
        self._queue.count(self._buffered)

    def _idle(self, axes: Axes) -> NDArray[np.bool_]:
        idle: NDArray[np.bool_] = ~self._active[axes] & ~self._queue.has_head[axes]
        return idle


def _ends_by_itself(command: Command) -> bool:
    """Tell whether the drive's own 'done' ends this command."""
    mode = command.control_mode
    return bool(mode & M.POSITION) and not (mode & M.SPECIFIED_TIME)


def _is_open_ended(command: Command) -> bool:
    """Tell whether this command lasts until the next one arrives."""
    mode = command.control_mode
    if mode & M.SPECIFIED_TIME:
        return command.time < 0
    return not mode & M.POSITION
