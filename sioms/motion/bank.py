"""Bank: the axes of one device, whatever closes their loops. What a verb means is here, once.

A bank owns what is published, the commands that wait, the latches, the coordinates and the events. *How* axes run is a
loop's: ``AxisBank`` closes it on the host, ``DriveBank`` feeds drives that close their own. A loop is asked through the
hooks at the end of the class and finds every command in the queue's buffers: short writes that have been acknowledged
and not yet put there (decision 0023) never get past a verb, because each begins with ``_settle`` or ``_forget``.

Pure: no I/O and no clock; every call that depends on time takes ``now_ns`` (CLOCK_MONOTONIC), never falling.
"""

from __future__ import annotations

import errno
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sioms.protocol.flags import AxisStatus, NodeClass
from sioms.protocol.records import READ, read_rows

from .arrival import Arrivals
from .commands import WIRE_DTYPE, Command
from .plain import MOST
from .plain_step import Plain, plain_of
from .queue import EMERGENCY_STOP, FAULT, LOST, AxesLike, CommandQueue, Judged, Judgement, LimitValue, verdict
from .settings import AxisSettings
from .store import NEVER_NS
from .types import CommandError, Event, EventKind, Keeper, MarkerPort

Axes = NDArray[np.int64]


class Written(NamedTuple):
    """A short write that has been acknowledged and waits to be worked in.

    Args:
        commands: in order.
        axes: the bank axes they are for.
        replace: whether they replace what the axes do.
        now_ns: instant of the write.
    """

    commands: list[Command]
    axes: frozenset[int]
    replace: bool
    now_ns: int


class Bank(ABC):
    """The axes of one device.

    Args:
        settings: one per axis.
        markers: seam to the marker table.
        capacity: commands that each axis' buffer holds.
        passing: whether the axes can pass a position at a velocity.

    ``fields`` is (columns of AxisRead, n) float64, contiguous; ``rows`` are its rows by name, whole numbers as int64.
    ``keeper`` may be set before the first measurement.

    Concurrency: one thread.
    """

    NOT_SEEN: ClassVar[str]
    """Why nothing can be written before the first measurement, and what to wait for."""
    DEFERS: ClassVar[bool]
    """Whether the loop can begin a command later as if it had begun at the instant of its write."""

    def __init__(self, settings: Sequence[AxisSettings], markers: MarkerPort, capacity: int, *, passing: bool) -> None:
        n = self.n = len(settings)
        self.settings = tuple(settings)
        self.fields = np.zeros((len(READ[NodeClass.AXIS]), n))
        rows = self.rows = read_rows(NodeClass.AXIS, self.fields)
        self._position, self._velocity, self._force = rows["position"], rows["velocity"], rows["force"]
        self._desired, self._desired_velocity = rows["commanded_position"], rows["commanded_velocity"]
        self._following, self._in_motion = rows["following_error"], rows["in_motion"]
        self._status, self._buffered = rows["status"], rows["buffered"]
        self._queue = CommandQueue(settings, markers, capacity, passing)
        self._arrivals = Arrivals(settings)
        self._raw, self._offset = np.zeros(n), np.zeros(n)
        self._braked = np.zeros(n, dtype=bool)
        """Axes whose emergency stop has been begun, and latched, by steps, and has still to be told."""
        self._written: list[Written] = []
        self._seen = False
        self._last_ns = 0
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

    def offer(self, records: Sequence[tuple[Any, ...]], axes: AxesLike, now_ns: int, *, replace: bool = False) -> bool:
        """Take a short write at once; False, and nothing taken, when append() has to judge it.

        The next tick or verb carries it out at its own instant, or that of the last tick if this has come since: the
        writer has its acknowledgement sooner, and set-points that are replaced before any tick has seen them are never
        planned.

        Args:
            records: up to MOST, each as a tuple of the columns of an axis command.
            axes, now_ns, replace: as append().
        """
        if not self._seen or not self.DEFERS:
            return False
        written = self._written
        waiting = sum([len(write.commands) for write in written]) if written else 0
        commands = self._queue.admit_plain(records, axes, waiting, replace=replace)
        if commands is None:
            return False
        touched = frozenset([command.axis for command in commands])
        if replace and written:
            written = self._written = [older for older in written if not older.axes <= touched]
        written.append(Written(commands, touched, replace, max(now_ns, self._last_ns)))
        if len(written) > MOST:
            self._settle()
        return True

    @property
    def defers(self) -> bool:
        """Whether ``offer`` may take what is written, and nothing that it has taken waits."""
        return self._seen and self.DEFERS and not self._written

    @property
    def plain(self) -> Plain | None:
        """What the short writes that ``offer`` takes are judged by, made anew for steps; None: it takes none."""
        return plain_of(self._queue) if self.DEFERS else None

    def judge(self, records: NDArray[Any], axes: AxesLike, now_ns: int, *, replace: bool = False) -> Judgement:
        """Judge a long write piece by piece, between ticks; what append() would refuse is refused here.

        Args, Raises: as append(). Returns, at its end: what take() takes.
        """
        if not self._seen:
            raise CommandError(errno.EIO, f"write: {self.NOT_SEEN}")
        self._settle()
        self._catch_up(now_ns)
        return (yield from self._queue.judge(records, axes, self._rest_positions(), replace=replace))

    def take(self, judged: Judged, now_ns: int) -> bool:
        """Append a judged write whole, at now; False when its axes have changed since: judge it again.

        Raises:
            CommandError: the axes take no commands any more, or have no room.
        """
        self._settle()
        now_ns = self._catch_up(now_ns)
        if not self._queue.still_holds(judged, self._rest_positions()):
            return False
        if judged.replace:
            self._drop(judged.axes)
        if judged.axes.size:
            self._begin(self._queue.append(judged), now_ns, replace=judged.replace)
        return True

    def ends(self) -> list[float]:
        """Return where the commands in hand will leave each axis; NaN where there are none, or it is not known."""
        self._settle()
        busy = ~self._idle(np.arange(self.n))
        return [float(end) for end in np.where(busy, self._queue.tail.state[:, 0], np.nan)]

    def room(self, axes: AxesLike) -> int:
        """Return how many further commands fit into the fullest buffer of these axes."""
        self._settle()
        return int(self._queue.room_of_all()[np.asarray(axes)].min())

    def flush(self, axes: AxesLike) -> None:
        """Empty the buffers; the running command goes on to its end, one that was to be replaced is stopped."""
        self._settle()
        chosen = np.asarray(axes, dtype=np.int64)
        waited = chosen[~self._idle(chosen)]
        self._drop(chosen)
        self._emptied(chosen)
        self._queue.emit(EventKind.IDLE, waited[self._idle(waited)], self._last_ns)
        self._show(chosen)

    def synch(self, axes: AxesLike, start_ns: int, now_ns: int) -> tuple[int, ...]:
        """Start the commands that wait for the external synch, all exactly at start_ns.

        A command is started when it holds its axis: it is the next, and what runs before it is a
        hold or lasts until the next command. Other axes are not affected. Axes that the host moves, and for which
        start_ns passed more than a tick ago, are stopped and their buffers dropped (ETIME), never hurried.

        Returns:
            the axes released.
        """
        self._settle()
        self._catch_up(now_ns)
        chosen = np.asarray(axes, dtype=np.int64)
        chosen = chosen[self._queue.gated_synch[chosen] & self._is_open_ended(chosen)]
        if chosen.size and self._is_too_late(start_ns, now_ns):
            text = f"the synch came {(now_ns - start_ns) * 1e-6:.3f} ms after its start time"
            self._abandon(chosen, now_ns, errno.ETIME, text)
            return ()
        self._queue.gated_synch[chosen] = False
        self._release(chosen, start_ns)
        self._show(chosen)
        return tuple(chosen.tolist())

    # -- short writes -------------------------------------------------------------------------

    def _settle(self, latest_ns: int = NEVER_NS) -> None:
        """Carry out the short writes, each at its own instant, or at latest_ns."""
        if not self._written:
            return
        writes, self._written = self._written, []
        for write in writes:
            at_ns = self._catch_up(min(write.now_ns, latest_ns))
            # Working in an earlier one may have ended in a fault.
            commands = [c for c in write.commands if not self._queue.is_barred(c.axis)]
            if not commands or self._begin_at_once(commands, at_ns, replace=write.replace):
                continue
            axes = np.array(sorted({c.axis for c in commands}), dtype=np.int64)
            if write.replace:
                self._drop(axes)
            self._queue.append_plain(commands, axes)
            self._begin(axes, at_ns, replace=write.replace)

    def _forget(self, axes: AxesLike) -> Axes:
        """Drop the short writes to these axes; return the axes as an array."""
        chosen = np.asarray(axes, dtype=np.int64)
        if self._written:
            dropped = frozenset(chosen.tolist())
            left = [(write, [c for c in write.commands if c.axis not in dropped]) for write in self._written]
            self._written = [write._replace(commands=cs, axes=write.axes - dropped) for write, cs in left if cs]
        return chosen

    # -- stopping -----------------------------------------------------------------------------

    def stop(self, axes: AxesLike, now_ns: int) -> None:
        """Empty the buffers and stop at maximum deceleration; force mode goes over to holding."""
        chosen = self._forget(axes)
        self._braked[chosen] = False
        self._halt(chosen, self._catch_up(now_ns), fastest=False)

    def emergency_stop(self, axes: AxesLike, now_ns: int, text: str = "emergency stop") -> None:
        """Empty the buffers and stop the fastest way there is; latched: writes are refused (EPERM) until reset(), with
        the text of the first stop.
        """
        chosen = np.asarray(axes, dtype=np.int64)
        self._queue.note_stop(chosen, text, now_ns)
        fresh = chosen[((self._queue.latched[chosen] & EMERGENCY_STOP) == 0) | self._braked[chosen]]
        self._braked[chosen] = False
        if not fresh.size:
            return
        self._queue.latched[fresh] |= EMERGENCY_STOP
        self._catch_up(now_ns)
        self._abandon(fresh, now_ns, errno.ECANCELED, "emergency stop", fastest=True)

    def fault(self, axes: AxesLike, text: str, now_ns: int | None = None, *, lets_go: bool = True) -> None:
        """Put axes in fault: buffers dropped, stopped the fastest way there is; latched until reset().

        Servos whose loop the host closes are let go, unless it is known that their loop is not what is wrong.
        """
        chosen = np.asarray(axes, dtype=np.int64)
        stamp = self._last_ns if now_ns is None else now_ns
        self._queue.latch_fault(chosen, text, stamp)
        self._abandon(chosen, stamp, errno.EIO, text, fastest=True)
        if lets_go:
            self._let_go(chosen)

    def let_go(self, axes: AxesLike) -> None:
        """Press no more with these axes, however far from their set-points; reset() has them hold where they are."""
        self._let_go(np.asarray(axes, dtype=np.int64))

    def lose_place(self, axes: AxesLike, text: str, now_ns: int | None = None) -> None:
        """Put axes in fault whose device does not know where they are: it restarted, or says so itself.

        Positions are refused (EPERM) until they are homed or calibrated; reset() clears the fault alone.
        """
        chosen = np.asarray(axes, dtype=np.int64)
        fresh = chosen[(self._queue.latched[chosen] & LOST) == 0]
        if fresh.size:
            self._queue.lose_places(fresh, text)
            self.fault(fresh, text, now_ns)
            self._forget_places(fresh)

    def break_off(self, axes: AxesLike, text: str, now_ns: int | None = None) -> None:
        """Put axes in fault whose search for a reference has ended without one, as ``lose_place``: again each time."""
        chosen = np.asarray(axes, dtype=np.int64)
        self.lose_place(chosen, text, now_ns)
        searching = chosen[(self._queue.latched[chosen] & int(AxisStatus.HOMING)) != 0]
        if searching.size:  # whose place was lost before
            self.fault(searching, text, now_ns)

    def is_latched(self, axis: int) -> bool:
        """Tell whether an axis is stopped by an emergency stop or in fault, until ``reset``."""
        return bool(self._queue.latched.item(axis) & (EMERGENCY_STOP | FAULT))

    def is_stopped(self, axis: int) -> bool:
        """Tell whether an axis is under an emergency stop, until ``reset``."""
        return bool(self._queue.latched.item(axis) & EMERGENCY_STOP)

    def is_in_fault(self, axis: int) -> bool:
        """Tell whether an axis is in fault, until ``reset``."""
        return bool(self._queue.latched.item(axis) & FAULT)

    def take_faults(self) -> list[int]:
        """Return the axes that have come into fault since the last call; cheap where none has."""
        return self._queue.take_faults()

    def fault_text(self, axis: int) -> str:
        """Return why an axis is in fault, empty when it is not."""
        return self._queue.fault_text(axis)

    def check_reset(self, axes: AxesLike, until_ns: int) -> None:
        """Refuse a reset that is based on a reading, if there is more to be reset by now.

        Args:
            axes: which.
            until_ns: the instant up to which that reading was complete [ns].

        Raises:
            CommandError: EAGAIN, one of them was stopped or put in fault at until_ns or later, and is so still.
        """
        self._queue.check_reset(np.asarray(axes, dtype=np.int64), until_ns)

    def reset(self, axes: AxesLike) -> None:
        """Clear emergency stop and fault, a drive's own too; axes that were let go, and steppers that lost steps, hold
        where they are.

        Nothing resumes.
        """
        chosen = np.asarray(axes, dtype=np.int64)
        latched = self._queue.latched[chosen]
        self._queue.unlatch(chosen)
        self._recover(chosen, latched)
        self._show(chosen)

    def end_stop(self, axes: AxesLike) -> None:
        """Clear the emergency stop of axes in fault, which stay so."""
        chosen = np.asarray(axes, dtype=np.int64)
        self._queue.end_stop(chosen)
        self._show(chosen)

    def forget_settings(self, axes: AxesLike) -> None:
        """End what commands of these halted axes have set for those that follow: who set it has gone."""
        self._settle()
        chosen = np.asarray(axes, dtype=np.int64)
        self._queue.forget_settings(chosen)
        self._settings_forgotten(chosen)

    def _abandon(self, axes: Axes, now_ns: int, errno_: int, text: str, *, fastest: bool = False) -> None:
        """Stop axes for a reason that is not their writer's, and tell those who wait for them."""
        written = [c.axis for write in self._written for c in write.commands]
        unfinished = ~self._idle(axes) | np.isin(axes, written)
        self._forget(axes)
        self._queue.emit(EventKind.DROPPED, axes[unfinished], now_ns, errno_, text)
        self._halt(axes, self._instant(now_ns), fastest=fastest)

    def abandon(self, axes: AxesLike, now_ns: int, errno_: int, text: str) -> None:
        """Empty the buffers and stop, for a reason that is not the writer's; those who wait are told it."""
        self._abandon(np.asarray(axes, dtype=np.int64), now_ns, errno_, text)

    # -- coordinates, limits, homing ----------------------------------------------------------

    def calibrate(self, axes: AxesLike, positions: Sequence[float] | NDArray[np.float64]) -> None:
        """Give the present place of each axis a new coordinate, without motion.

        Soft limits keep their numbers: they belong to the coordinates so defined.

        Raises:
            CommandError: EBUSY while an axis moves, ERANGE outside its soft limits, EINVAL when not finite.
        """
        self._settle()
        chosen, wanted = np.asarray(axes, dtype=np.int64), np.asarray(positions, dtype=np.float64)
        self._queue.check_calibration(chosen, wanted, self._idle(chosen))
        self._queue.find_places(chosen)
        self._move_coordinates(chosen, wanted - self._position[chosen])
        # A sum of differences rounds: the place that was named is the place that is read.
        self._offset[chosen] = wanted - self._raw[chosen]
        self._position[chosen] = self._raw[chosen] + self._offset[chosen]

    def zero(self, axes: AxesLike) -> None:
        """Make the present place of each axis position 0; see calibrate()."""
        self.calibrate(axes, np.zeros(len(axes)))

    def set_limits(self, axes: AxesLike, **limits: LimitValue) -> None:
        """Narrow the limits of axes, or with None return to the configured ones; see CommandQueue.set_limits()."""
        chosen = np.asarray(axes, dtype=np.int64)
        if not self.is_idle(chosen):
            raise CommandError(errno.EBUSY, "set limits: an axis moves or has commands; wait until it is idle")
        self._queue.set_limits(chosen, limits, self._position)
        self._limits_changed(chosen)

    def get_limits(self, axes: AxesLike) -> dict[str, list[float | None]]:
        """Return the limits in force by name, one entry per axis, None where there is none."""
        return self._queue.get_limits(axes)

    def home(self, axes: AxesLike, now_ns: int) -> None:
        """Start homing; HOMED and IDLE events tell the end, a fault that it failed.

        Raises:
            CommandError: EINVAL without homing, EBUSY while moving, EPERM or EIO when latched.
        """
        self._settle()
        now_ns = self._catch_up(now_ns)
        chosen = np.asarray(axes, dtype=np.int64)
        self._queue.check_homing(chosen, self._idle(chosen))
        self._queue.latched[chosen] |= int(AxisStatus.HOMING)
        self._queue.latched[chosen] &= ~int(AxisStatus.HOMED)
        self._home(chosen, now_ns)
        self._show(chosen)

    def set_homed(self, axes: AxesLike, homed: bool = True) -> None:
        """Note that a reference was found otherwise (a drive's own, an absolute encoder, restored position) or lost."""
        chosen = np.asarray(axes, dtype=np.int64)
        self._queue.set_homed(chosen, homed, self._last_ns)
        self._show(chosen)

    # -- answers ------------------------------------------------------------------------------

    def is_idle(self, axes: AxesLike) -> bool:
        """Tell whether these axes hold still, have no commands and are not homing."""
        self._settle()
        return bool(self._idle(np.asarray(axes, dtype=np.int64)).all())

    def diagnostics(self, axes: AxesLike) -> dict[str, list[float]]:
        """Return what the readings do not tell of these axes, by name.

        Raw is what the device counts, offset what makes a position of it; retries belong to the last point
        move, misses are counted since the start.
        """
        chosen = np.asarray(axes)
        report = {"raw": self._raw[chosen].tolist(), "offset": self._offset[chosen].tolist()}
        return report | self._arrivals.report(chosen)

    def take_events(self) -> list[Event]:
        """Return what happened since the last call, oldest first."""
        self._settle()
        return self._queue.take_events()

    # -- what a loop does ---------------------------------------------------------------------

    @abstractmethod
    def _idle(self, axes: Axes) -> NDArray[np.bool_]:
        """Tell which axes hold still, have no commands in the buffers and are not homing."""

    @abstractmethod
    def _is_open_ended(self, axes: Axes) -> NDArray[np.bool_]:
        """Tell on which axes a command may begin at any time: they rest, or what runs lasts until the next command."""

    @abstractmethod
    def _rest_positions(self) -> NDArray[np.float64]:
        """Return where axes are known to rest, NaN for the others (n,)."""

    @abstractmethod
    def _begin(self, axes: Axes, now_ns: int, *, replace: bool) -> None:
        """New commands wait on these axes: begin at now what nothing holds, or replace what runs."""

    @abstractmethod
    def _drop(self, axes: Axes) -> None:
        """Forget the commands in the buffers of these axes, and what has been made of them."""

    @abstractmethod
    def _halt(self, axes: Axes, now_ns: int, *, fastest: bool) -> None:
        """Drop the commands and the homing of these axes, and stop them."""

    @abstractmethod
    def _release(self, axes: Axes, start_ns: int) -> None:
        """Let the commands of these axes, whose gate has gone, begin at start_ns."""

    @abstractmethod
    def _recover(self, axes: Axes, latched: Axes) -> None:
        """Make axes ready again whose latches, here as they were, have been cleared."""

    @abstractmethod
    def _move_coordinates(self, axes: Axes, by: NDArray[np.float64]) -> None:
        """Add to all positions that are kept of these axes."""

    @abstractmethod
    def _home(self, axes: Axes, now_ns: int) -> None:
        """Begin to home axes that may."""

    def _instant(self, now_ns: int) -> int:
        """Return the instant at which a verb acts."""
        return now_ns

    def _catch_up(self, now_ns: int) -> int:
        """Carry out what was due until now; return the instant at which a verb acts."""
        return now_ns

    def _is_too_late(self, start_ns: int, now_ns: int) -> bool:
        """Tell whether a common start in the past is none any more."""
        return False

    def _begin_at_once(self, commands: Sequence[Command], now_ns: int, *, replace: bool) -> bool:
        """Begin short writes that need no buffer; return False, and nothing is done, where they do."""
        return False

    def _emptied(self, axes: Axes) -> None:  # noqa: B027  # most loops have nothing to do
        """The buffers of these axes were flushed."""

    def _let_go(self, axes: Axes) -> None:  # noqa: B027  # most loops have nothing to do
        """These axes were put in fault."""

    def _forget_places(self, axes: Axes) -> None:  # noqa: B027  # most loops have nothing to do
        """These axes do not know where they are."""

    def _settings_forgotten(self, axes: Axes) -> None:  # noqa: B027  # most loops have nothing to do
        """What commands have set on these axes has ended."""

    def _limits_changed(self, axes: Axes) -> None:  # noqa: B027  # most loops have nothing to do
        """Limits of these axes were set."""

    def _show(self, axes: Axes) -> None:  # noqa: B027  # most loops have nothing to do
        """What shows in the status of these axes may have changed."""
