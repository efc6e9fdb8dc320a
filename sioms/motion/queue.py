"""Commands waiting to run: validation, buffers, gates (markers, synch), latches and events of a bank.

Shared by the host-closed loop (AxisBank) and the drives that close their own (DriveBank), so that
buffer, marker and latch semantics are the same for both. What runs, and when, is theirs.
"""

from __future__ import annotations

import errno
from collections.abc import Generator, Sequence
from typing import Any

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from sioms.protocol.flags import AxisStatus

from . import modes
from .buffers import Chunk, CommandBuffers, cut
from .commands import WIRE_DTYPE, Command, Limits, Validator
from .feasibility import Feasibility, Tail
from .plain import AXIS, MOST, PlainCheck
from .settings import AxisSettings
from .types import CommandError, Event, EventKind, MarkerPort, RecordError

AxesLike = Sequence[int] | NDArray[np.int64]
LimitValue = float | None | Sequence[float | None]
BARRED, HOMED = int(AxisStatus.EMERGENCY_STOP | AxisStatus.FAULT | AxisStatus.HOMING), int(AxisStatus.HOMED)
LOST = int(AxisStatus.POSITION_LOST)
EMERGENCY_STOP, FAULT = int(AxisStatus.EMERGENCY_STOP), int(AxisStatus.FAULT)
LIMIT_NAMES = ("position_min", "position_max", "velocity_max", "acceleration_max", "jerk_max", "force_max")

PIECE = 256
"""Records that are judged in one go: some 0.3 ms."""


class Judged(Struct, frozen=True, eq=False):
    """A written array that was found good, and on what that rests.

    Attributes:
        chunks: the array as commands, cut by axis, in order.
        axes, counts: the axes it touches, ascending, and how many commands each gets.
        replace: whether the buffers of these axes are to be emptied first.
        begin, end: what is known of these axes' buffers before and after it.
        limits_set: how often limits had been changed.
    """

    chunks: list[Chunk]
    axes: NDArray[np.int64]
    counts: NDArray[np.int64]
    replace: bool
    begin: Tail
    end: Tail
    limits_set: int


Judgement = Generator[None, None, Judged]
"""Judging a written array: goes on with every ``next``, returns Judged or raises CommandError."""


def verdict(judgement: Judgement) -> Judged:
    """Judge to the end in one go."""
    while True:
        try:
            next(judgement)
        except StopIteration as end:
            judged: Judged = end.value
            return judged


class CommandQueue:
    """The waiting commands of n axes. The *head* of an axis is the command that runs next.

    Arrays (n,): ``gated_synch`` and ``gated_marker`` say what the head waits for, ``latched`` holds
    the persistent AxisStatus bits (HOMED, FAULT, EMERGENCY_STOP, FOLLOWING_ERROR, STALLED, HOMING, POSITION_LOST),
    ``latched_ns`` when an axis came into fault or was last stopped, even if it was stopped already [ns].
    """

    def __init__(
        self, settings: Sequence[AxisSettings], markers: MarkerPort, capacity: int, passing: bool = True
    ) -> None:
        self.n = len(settings)
        self.settings = tuple(settings)
        self.limits = Limits(settings)
        self.capacity = capacity
        self.heads: list[Command | None] = [None] * self.n
        self.has_head = np.zeros(self.n, dtype=bool)
        self.gated_synch = np.zeros(self.n, dtype=bool)
        self.gated_marker = np.zeros(self.n, dtype=bool)
        self.latched = np.zeros(self.n, dtype=np.int64)
        self.latched_ns = np.zeros(self.n, dtype=np.int64)
        self.home_required = np.array([s.homing is not None and s.homing.required for s in settings], dtype=bool)
        self._buffers = CommandBuffers(self.n, capacity)
        self.waiting = self._buffers.count
        self._markers = markers
        self._validator = Validator(settings, self.limits, markers, passing)
        self.in_force = (self.limits.velocity.copy(), self.limits.acceleration.copy())
        """Velocity and acceleration limits that commands have specified, (n,) each."""
        self.tail = Tail(np.full((self.n, 3), np.nan), self.in_force[0].copy(), self.in_force[1].copy())
        self._limits_set = 0
        self._feasibility = Feasibility(self.limits, self._validator)
        self.plain = PlainCheck(self._validator.offered, self.limits)
        self._waiting: dict[tuple[int, int], set[int]] = {}
        self._fault_text: dict[int, str] = {}
        self._stop_text: dict[int, str] = {}
        self._new_faults: list[int] = []
        self._lost_text: dict[int, str] = {}
        self._events: list[tuple[EventKind, Any, int, int, str]] = []

    # -- writing ------------------------------------------------------------------------------

    def judge(self, records: NDArray[Any], axes: AxesLike, at_rest: NDArray[np.float64], *, replace: bool) -> Judgement:
        """Check a written array and the state of its axes, piece by piece; nothing is taken yet.

        Args:
            records: as written.
            axes: bank axis of each node-local index.
            at_rest: position (n,) of axes that are idle, NaN of the others.
            replace: the buffers of these axes will be emptied first.
        """
        if records.dtype != WIRE_DTYPE:
            raise CommandError(errno.EINVAL, "write: the records are not axis write records; table F.3")
        placed = self._validator.place(records, np.asarray(axes, dtype=np.int64))
        counts = np.bincount(placed, minlength=self.n)
        touched = np.flatnonzero(counts)
        counts = counts[touched]
        self._check_state(touched, counts, replace)
        self._check_places(records, placed)
        begin, limits_set = self._known(touched, at_rest, replace), self._limits_set
        tail = Tail(np.full((self.n, 3), np.nan), np.zeros(self.n), np.zeros(self.n))
        tail.set_rows(touched, begin)
        chunks: list[Chunk] = []
        if len(records) > PIECE:
            yield  # what is said of all records has taken as long as a piece
        for first in range(0, len(records), PIECE):
            piece = slice(first, first + PIECE)
            try:
                commands = self._validator.check(records[piece], placed[piece])
                yield from self._feasibility.check(commands, tail)
            except RecordError as error:
                raise error.later(first) from None
            chunks += cut(commands)
            if len(records) > PIECE:
                yield
        return Judged(chunks, touched, counts, replace, begin, tail.rows(touched), limits_set)

    def still_holds(self, judged: Judged, at_rest: NDArray[np.float64]) -> bool:
        """Tell whether what a judgement rests on has not changed since; else it must be judged again.

        Raises:
            CommandError: the axes take no commands any more, or have no room.
        """
        self._check_state(judged.axes, judged.counts, judged.replace)
        known = self._known(judged.axes, at_rest, judged.replace)
        return judged.limits_set == self._limits_set and judged.begin.equals(known)

    def _check_state(self, axes: NDArray[np.int64], counts: NDArray[np.int64], replace: bool) -> None:
        """Raise when an axis written to takes no commands now, or has no room for so many."""
        self._check_latches(axes)
        room = np.full(len(axes), self.capacity) if replace else self.room_of_all()[axes]
        full = counts > room
        if full.any():
            i = int(full.argmax())
            axis, count = int(axes[i]), int(counts[i])
            raise CommandError(
                errno.EAGAIN if count <= self.capacity else errno.EINVAL,
                f"write axis {axis} ({self.settings[axis].name}): {count} commands do not fit; "
                f"room for {room[i]} of {self.capacity}",
            )

    def _known(self, axes: NDArray[np.int64], at_rest: NDArray[np.float64], replace: bool) -> Tail:
        """Return what is known of the state in which the next command of these axes begins."""
        known = self.tail.rows(axes)
        resting = np.isfinite(at_rest[axes])
        if replace:
            known.state[~resting] = np.nan
        known.state[resting] = 0.0
        known.state[resting, 0] = at_rest[axes][resting]
        return known

    def admit_plain(
        self, records: Sequence[tuple[Any, ...]], axes: AxesLike, waiting: int, *, replace: bool
    ) -> list[Command] | None:
        """Check a short write one by one; None when the general way has to judge it.

        Args:
            records: as written, each as a tuple of the fields of table F.3.
            axes: bank axis of each node-local index.
            waiting: how many commands have been admitted but not appended.
            replace: the buffers of these axes will be emptied first.
        """
        count = len(records)
        if not 0 < count <= MOST or count > self.capacity:
            return None
        most, known, commands = self.capacity - 1 - waiting - count, len(axes), []
        for record in records:
            local = record[AXIS]
            if not 0 <= local < known:
                return None
            axis = int(axes[local])
            full = not replace and self._buffers.count.item(axis) > most
            command = None if full or self.is_barred(axis) else self.plain.command(record, axis)
            if command is None:
                return None
            commands.append(command)
        return commands

    def is_barred(self, axis: int) -> bool:
        """Tell whether an axis takes no commands now; see _check_latches()."""
        latched: int = self.latched.item(axis)
        return latched & (BARRED | LOST) != 0 or (self.home_required.item(axis) and not latched & HOMED)

    def append_plain(self, commands: Sequence[Command], axes: NDArray[np.int64]) -> None:
        """Take plain commands of these axes, each of which has a head then."""
        for command in commands:
            self.end_with(command)
        self._buffers.append_commands(commands)
        self.load_heads(axes)

    def end_with(self, command: Command) -> None:
        """A plain command is the last of its axis."""
        tail, axis, mode = self.tail, command.axis, command.control_mode
        tail.state[axis] = (command.position, 0.0, 0.0) if mode & modes.POSITION else np.nan
        if mode & modes.MAX_VEL_ACC:
            tail.velocity[axis], tail.acceleration[axis] = command.max_velocity, command.max_acceleration

    def forget_tail(self, axes: NDArray[np.int64]) -> None:
        """The buffers of these axes were emptied: what follows begins in a state not known here."""
        self.tail.state[axes] = np.nan
        self.tail.velocity[axes] = self.in_force[0][axes]
        self.tail.acceleration[axes] = self.in_force[1][axes]

    def _check_latches(self, axes: NDArray[np.int64]) -> None:
        latched = self.latched[axes]
        homed = (latched & HOMED) != 0
        barred = (latched & BARRED) != 0
        barred |= self.home_required[axes] & ~homed
        if not barred.any():
            return
        axis = int(axes[barred.argmax()])
        bits, what = int(self.latched[axis]), f"write axis {axis} ({self.settings[axis].name}): "
        if bits & AxisStatus.EMERGENCY_STOP:
            raise CommandError(errno.EPERM, what + f"stopped: {self.stop_text(axis)}; RESET first")
        if bits & AxisStatus.FAULT:
            raise CommandError(errno.EIO, what + f"in fault ({self.fault_text(axis)}); RESET first")
        if bits & AxisStatus.HOMING:
            raise CommandError(errno.EBUSY, what + "homing; wait until it is idle")
        raise CommandError(errno.EPERM, what + "home required; HOME first")

    def _check_places(self, records: NDArray[Any], placed: NDArray[np.int64]) -> None:
        """Raise when a position is commanded to an axis that does not know where it is."""
        blind = (self.latched[placed] & LOST != 0) & (records["control_mode"] & modes.POSITION != 0)
        if blind.any():
            axis = int(placed[blind.argmax()])
            raise CommandError(
                errno.EPERM,
                f"write axis {axis} ({self.settings[axis].name}): {self._lost_text.get(axis, 'position lost')}; "
                "HOME it, or CALIBRATE_DEVICE with where it is",
            )

    def append(self, judged: Judged) -> NDArray[np.int64]:
        """Take what still holds; return the axes touched, each of which now has a head."""
        self._buffers.append(judged.chunks)
        self.tail.set_rows(judged.axes, judged.end)
        self.load_heads(judged.axes)
        return judged.axes

    def room_of_all(self) -> NDArray[np.int64]:
        """Return how many commands each axis has room for."""
        room: NDArray[np.int64] = self.capacity - self._buffers.count - self.has_head
        return room

    def count(self, out: NDArray[np.int64]) -> None:
        """Write the number of commands that wait, per axis, into out (n,)."""
        np.add(self._buffers.count, self.has_head, out=out, casting="unsafe")

    # -- heads and gates ----------------------------------------------------------------------

    def load_heads(self, axes: NDArray[np.int64]) -> NDArray[np.int64]:
        """Make the oldest command of each of these axes its head; return the axes that gained one."""
        lacking = axes[~self.has_head[axes] & (self._buffers.count[axes] > 0)]
        for axis in lacking.tolist():
            self.load_head(axis)
        return lacking

    def load_head(self, axis: int) -> bool:
        """Make the oldest command of an axis its head; tell whether it has a head now."""
        if self.has_head[axis]:
            return True
        command = self._buffers.pop(axis)
        if command is None:
            return False
        self.heads[axis] = command
        self.has_head[axis] = True
        if command.control_mode & modes.SYNCH:
            self.gated_synch[axis] = True
        if command.control_mode & modes.WAIT_MARKER:
            self._wait_for(axis, command)
        return True

    def _wait_for(self, axis: int, command: Command) -> None:
        key = (command.wait_marker_number, command.wait_generation)
        if self._markers.state(*key) is True:
            return
        self.gated_marker[axis] = True
        self._waiting.setdefault(key, set()).add(axis)

    @property
    def waits_for_markers(self) -> bool:
        """Tell whether any head waits for a marker."""
        return bool(self._waiting)

    def poll_markers(self) -> tuple[list[int], list[tuple[int, int]]]:
        """Look at the markers that heads wait for, once each.

        Returns:
            the axes released, and (axis, marker number) of those whose marker was freed.
        """
        released: list[int] = []
        broken: list[tuple[int, int]] = []
        for (number, generation), axes in list(self._waiting.items()):
            state = self._markers.state(number, generation)
            if state is False:
                continue
            del self._waiting[number, generation]
            self.gated_marker[list(axes)] = False
            if state is None:
                broken.extend((axis, number) for axis in sorted(axes))
            else:
                released.extend(sorted(axes))
        return released, broken

    def signal(self, number: int, generation: int, now_ns: int) -> None:
        """Signal the marker of a command that ended."""
        self._markers.signal(number, generation, now_ns)

    def clear(self, axes: NDArray[np.int64]) -> NDArray[np.int64]:
        """Drop all waiting commands of these axes; return the axes that had any."""
        self.forget_tail(axes)
        had = axes[self.has_head[axes] | (self._buffers.count[axes] > 0)]
        self._buffers.clear(axes)
        for axis in axes[self.gated_marker[axes]].tolist():
            for key in [k for k, waiting in self._waiting.items() if axis in waiting]:
                self._waiting[key].discard(axis)
                if not self._waiting[key]:
                    del self._waiting[key]
        for axis in axes[self.has_head[axes]].tolist():
            self.heads[axis] = None
        self.has_head[axes] = False
        self.gated_synch[axes] = False
        self.gated_marker[axes] = False
        return had

    # -- limits and coordinates ---------------------------------------------------------------

    def check_calibration(
        self, axes: NDArray[np.int64], positions: NDArray[np.float64], idle: NDArray[np.bool_]
    ) -> None:
        """Raise when one of these axes may not be given this coordinate now."""
        for axis, value, free in zip(axes.tolist(), positions.tolist(), idle.tolist(), strict=True):
            what = f"calibrate axis {axis} ({self.settings[axis].name}): "
            if not np.isfinite(value):
                raise CommandError(errno.EINVAL, what + f"position is {value}; want a finite number")
            if not free:
                raise CommandError(errno.EBUSY, what + "it moves or has commands; wait until it is idle")
            low, high = self.limits.minimum[axis], self.limits.maximum[axis]
            if not low <= value <= high:
                raise CommandError(
                    errno.ERANGE, what + f"position {value:g} is outside the soft limits; want {low:g} to {high:g}"
                )

    def check_homing(self, axes: NDArray[np.int64], idle: NDArray[np.bool_]) -> None:
        """Raise when one of these axes may not home now."""
        for axis, free in zip(axes.tolist(), idle.tolist(), strict=True):
            what = f"home axis {axis} ({self.settings[axis].name}): "
            latched = int(self.latched[axis])
            if self.settings[axis].homing is None:
                raise CommandError(errno.EINVAL, what + "no homing is configured for it")
            if latched & AxisStatus.EMERGENCY_STOP:
                raise CommandError(errno.EPERM, what + f"stopped: {self.stop_text(axis)}; RESET first")
            if latched & AxisStatus.FAULT:
                raise CommandError(errno.EIO, what + f"in fault ({self.fault_text(axis)}); RESET first")
            if not free:
                raise CommandError(errno.EBUSY, what + "it moves or has commands; wait until it is idle")

    def set_limits(self, axes: NDArray[np.int64], limits: dict[str, LimitValue], position: NDArray[np.float64]) -> None:
        """Set limits of axes; a value of None returns to the configured one.

        Args:
            axes: bank axes.
            limits: by LIMIT_NAMES, one number for all axes or one per axis; never wider than configured.
            position: present positions (n,), which must stay inside.

        Raises:
            CommandError: EINVAL for an unknown name or number, ERANGE when wider than configured or
                when the axis stands outside; then nothing is changed.
        """
        changes: list[tuple[NDArray[np.float64], int, float]] = []
        for name, given in limits.items():
            array = self._limit_array(name)
            values = list(given) if isinstance(given, Sequence) else [given] * len(axes)
            if len(values) != len(axes):
                raise CommandError(errno.EINVAL, f"set limits: {len(values)} values of {name}; want {len(axes)} or one")
            for axis, value in zip(axes.tolist(), values, strict=True):
                changes.append((array, axis, self._checked_limit(axis, name, value, position)))
        for array, axis, value in changes:
            array[axis] = value
        self._limits_set += 1
        self.forget_settings(axes)

    def forget_settings(self, axes: NDArray[np.int64]) -> None:
        """What commands of these axes have set as their greatest velocity and acceleration ends."""
        self.in_force[0][axes] = self.limits.velocity[axes]
        self.in_force[1][axes] = self.limits.acceleration[axes]
        self.forget_tail(axes)

    def _limit_array(self, name: str) -> NDArray[np.float64]:
        arrays = {
            "position_min": self.limits.minimum,
            "position_max": self.limits.maximum,
            "velocity_max": self.limits.velocity,
            "acceleration_max": self.limits.acceleration,
            "jerk_max": self.limits.jerk,
            "force_max": self.limits.force,
        }
        if name not in arrays:
            raise CommandError(errno.EINVAL, f"set limits: no limit {name!r}; want one of {', '.join(arrays)}")
        return arrays[name]

    def _checked_limit(self, axis: int, name: str, value: float | None, position: NDArray[np.float64]) -> float:
        what = f"set limits of axis {axis} ({self.settings[axis].name}): "
        configured = getattr(self.settings[axis], name)
        lower = name == "position_min"
        widest = (-np.inf if lower else np.inf) if configured is None else float(configured)
        wanted = widest if value is None else float(value)
        if np.isnan(wanted) or (not name.startswith("position") and wanted <= 0):
            raise CommandError(errno.EINVAL, what + f"{name} {wanted:g}; want a positive number")
        if wanted < widest if lower else wanted > widest:
            most = f"{'at least' if lower else 'at most'} {widest:g}"
            raise CommandError(errno.ERANGE, what + f"{name} {wanted:g} is wider than configured; want {most}")
        if (lower and position[axis] < wanted) or (name == "position_max" and position[axis] > wanted):
            raise CommandError(
                errno.ERANGE,
                what + f"{name} {wanted:g}, but the axis stands at {position[axis]:g}; move it inside",
            )
        return wanted

    def get_limits(self, axes: AxesLike) -> dict[str, list[float | None]]:
        """Return the limits in force by name, one entry per axis, None where there is none."""
        found: dict[str, list[float | None]] = {}
        for name in LIMIT_NAMES:
            values = self._limit_array(name)[np.asarray(axes)].tolist()
            found[name] = [value if np.isfinite(value) else None for value in values]
        return found

    # -- latches and events -------------------------------------------------------------------

    def note_stop(self, axes: NDArray[np.int64], text: str, now_ns: int) -> None:
        """Keep why these axes are under an emergency stop, and since when; the first reason stays."""
        self.latched_ns[axes] = now_ns
        for axis in axes.tolist():
            self._stop_text.setdefault(axis, text)

    def stop_text(self, axis: int) -> str:
        """Return why an axis is under an emergency stop."""
        return self._stop_text.get(axis, "emergency stop")  # of one that steps have obeyed, it is told a moment later

    def latch_fault(self, axes: NDArray[np.int64], text: str, now_ns: int, errno_: int = errno.EIO) -> None:
        """Set the fault latch of these axes with its reason; the first reason stays."""
        fresh = axes[(self.latched[axes] & FAULT) == 0]
        if not fresh.size:
            return
        self.latched[fresh] |= FAULT
        self.latched_ns[fresh] = now_ns
        for axis in fresh.tolist():
            self._fault_text[axis] = text
        self._new_faults += fresh.tolist()
        self.emit(EventKind.FAULT, fresh, now_ns, errno_, text)

    def take_faults(self) -> list[int]:
        """Return the axes that have come into fault, or lost their place, since the last call; cheap where none has."""
        faults = self._new_faults
        if faults:
            self._new_faults = []
        return faults

    def fault_text(self, axis: int) -> str:
        """Return why an axis is in fault, empty when it is not."""
        return self._fault_text.get(axis, "")

    def lose_places(self, axes: NDArray[np.int64], text: str) -> None:
        """Latch that these axes do not know where they are, with the reason; only find_places() clears it."""
        self.latched[axes] = self.latched[axes] & ~HOMED | LOST
        reason = dict.fromkeys(axes.tolist(), text)
        self._new_faults += reason
        self._lost_text.update(reason)
        self._fault_text.update(reason)  # outweighs an earlier one, such as the lost link that led to it
        self._limits_set += 1  # what was judged before is judged again

    def find_places(self, axes: NDArray[np.int64]) -> None:
        """These axes know where they are: they were homed, or given a coordinate."""
        self.latched[axes] &= ~LOST

    def set_homed(self, axes: NDArray[np.int64], homed: bool, now_ns: int) -> None:
        """Set or clear the HOMED bit of these axes; tell those that gained it."""
        if homed:
            self.find_places(axes)
        bit = int(AxisStatus.HOMED)
        changed = axes[((self.latched[axes] & bit) != 0) != homed]
        self.latched[changed] ^= bit
        if homed:
            self.emit(EventKind.HOMED, changed, now_ns)

    def check_reset(self, axes: NDArray[np.int64], until_ns: int) -> None:
        """Raise when one of these axes was stopped or put in fault at ``until_ns`` or later, and is so still."""
        later = (self.latched_ns[axes] >= until_ns) & (self.latched[axes] & (FAULT | EMERGENCY_STOP) != 0)
        if later.any():
            axis = int(axes[later.argmax()])
            bits = int(self.latched[axis])
            what = "stopped" if bits & EMERGENCY_STOP else f"put in fault ({self.fault_text(axis)})"
            raise CommandError(
                errno.EAGAIN,
                f"axis {axis} ({self.settings[axis].name}) has been {what} since the reading that the reset is based "
                "on; see why, and reset again",
            )

    def end_stop(self, axes: NDArray[np.int64]) -> None:
        """Clear the emergency stop of these axes."""
        self.latched[axes] &= ~EMERGENCY_STOP
        for axis in axes.tolist():
            self._stop_text.pop(axis, None)

    def unlatch(self, axes: NDArray[np.int64]) -> None:
        """Clear emergency stop and fault of these axes."""
        self.end_stop(axes)
        self.latched[axes] &= ~int(AxisStatus.FAULT | AxisStatus.FOLLOWING_ERROR | AxisStatus.STALLED)
        for axis in axes.tolist():
            self._fault_text.pop(axis, None)

    def emit(self, kind: EventKind, axes: NDArray[np.int64], stamp_ns: int, errno_: int = 0, text: str = "") -> None:
        """Note an event; it becomes an Event when it is taken."""
        if axes.size:
            self._events.append((kind, axes, stamp_ns, errno_, text))

    def take_events(self) -> list[Event]:
        """Return the events since the last call, oldest first."""
        events = [Event(k, tuple(a.tolist()), t, e, text) for k, a, t, e, text in self._events]
        self._events.clear()
        return events
