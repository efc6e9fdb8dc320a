"""DriveBank: buffers, markers, synch and latches for drives that close their own loop.

The drive makes its own profile; the bank decides when a command goes out and when it has ended.
poll() takes what the drive reports, take_actions() hands out what shall be sent, action_done() and
action_failed() tell how that went; what verbs mean is in bank.py.
"""

from __future__ import annotations

import errno
import math
from collections.abc import Sequence

import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from sioms.protocol.flags import AxisStatus

from . import modes
from .actions import ActionKind, DriveAction, ends_by_itself, is_force, is_open_ended
from .arrival import Approach
from .bank import Axes, Bank
from .commands import Command, is_point_move
from .profile import InfeasibleError
from .queue import FAULT, LOST, AxesLike
from .settings import AxisSettings
from .store import NEVER_NS
from .types import EventKind, MarkerPort
from .watch import MotionWatch, Order, order_of

FIRST_REPEAT_NS = 50_000_000
LONGEST_REPEAT_NS = 1_000_000_000
"""How often a stop is sent again that failed, or that the drive does not obey."""
DISOBEYED = 4
"""So many stops that a drive has confirmed and does not obey are a fault."""
LATE_START_NS = 100_000_000
"""A drive that confirms a common start later than this after its instant is stopped with a fault [ns]: the other axes
have gone without it. A line is that slow at most: the exchange that it is busy with, then the starts of its drives.
"""


class DriveBank(Bank):
    """The axes of one device whose drives close their own loops.

    Args:
        settings: one per axis; ``modes`` holds the control-mode flags that the drive has, everything
            else is refused (EINVAL) before anything moves.
        markers: seam to the marker table.
        capacity: commands that each axis' buffer holds.
        settle_s: how long after its start a command may take to be reported as moving [s]; until
            then 'done' reports are not believed.

    Short writes are never taken at once: what a drive is told cannot be carried out later at the instant of the write.

    Concurrency: one thread.
    """

    NOT_SEEN = "the drive has not reported its position yet; wait for it"
    DEFERS = False

    def __init__(
        self,
        settings: Sequence[AxisSettings],
        *,
        markers: MarkerPort,
        capacity: int = 16384,
        settle_s: float = 0.05,
    ) -> None:
        super().__init__(settings, markers, capacity, passing=False)
        n = self.n
        self._limits = self._queue.limits
        self._velocity_limit, self._acceleration_limit = self._queue.in_force
        self._watch = MotionWatch(settings, self._limits.velocity, self._acceleration_limit)
        self._running: list[Command | None] = [None] * n
        self._active = np.zeros(n, dtype=bool)
        self._stopping = np.zeros(n, dtype=bool)
        self._moved = np.zeros(n, dtype=bool)
        self._started_ns = np.zeros(n, dtype=np.int64)
        self._end_ns = np.full(n, NEVER_NS, dtype=np.int64)
        self._end_fraction = np.zeros(n)
        self._release_ns = np.zeros(n, dtype=np.int64)
        """Instant of the common start for which the next command waits, 0 for none."""
        self._common_ns = np.zeros(n, dtype=np.int64)
        """Instant of the common start that goes out to the drive, 0 for none."""
        self._target = np.zeros(n)
        self._settle_ns = int(settle_s * 1e9)
        self._acknowledged = np.zeros(n, dtype=bool)
        self._approaches = [Approach.of(s) for s in settings]
        self._take_ups: list[float | None] = [None] * n
        """Targets of the axes on their way to the place from which they take up their play."""
        self._settled_ns = np.full(n, NEVER_NS, dtype=np.int64)
        self._taken = np.zeros(n, dtype=bool)
        self._outcome = np.zeros(n, dtype=np.int64)
        self._homing = np.zeros(n, dtype=bool)
        self._resetting = np.zeros(n, dtype=bool)
        self._stops: dict[int, ActionKind] = {}
        self._again_ns = np.full(n, NEVER_NS, dtype=np.int64)
        """When a stop goes out again unless the drive stands."""
        self._repeats = np.zeros(n, dtype=np.int64)
        self._refused_stop = np.zeros(n, dtype=bool)
        self._rests_ns = np.full(n, NEVER_NS, dtype=np.int64)
        self._actions: list[DriveAction] = []
        self._moving = np.zeros(n, dtype=bool)

    # -- what the bank asks for ----------------------------------------------------------------

    def _rest_positions(self) -> NDArray[np.float64]:
        return np.full(self.n, np.nan)

    def _idle(self, axes: Axes) -> NDArray[np.bool_]:
        idle: NDArray[np.bool_] = ~self._active[axes] & ~self._queue.has_head[axes]
        return idle

    def _is_open_ended(self, axes: Axes) -> NDArray[np.bool_]:
        running = [self._running[axis] for axis in axes]
        lasting = np.array([c is not None and is_open_ended(c) for c in running], dtype=bool)
        return np.asarray(~self._active[axes] | lasting)

    def _begin(self, axes: Axes, now_ns: int, *, replace: bool) -> None:
        if replace:
            self._end_ns[axes] = now_ns
            self._end_fraction[axes] = 0.0
            for axis in axes.tolist():
                self._running[axis] = None
        self.advance(now_ns)

    def _drop(self, axes: Axes) -> None:
        self._queue.clear(axes)
        self._release_ns[axes] = self._common_ns[axes] = 0

    def _emptied(self, axes: Axes) -> None:
        """Stop what was to be replaced by a command that has been flushed."""
        replaced = [a for a in axes.tolist() if self._running[a] is None]
        orphans = np.array(replaced, dtype=np.int64)
        orphans = orphans[self._active[orphans] & ~self._stopping[orphans] & ~self._homing[orphans]]
        if orphans.size:
            self._halt(orphans, self._last_ns, fastest=False)

    def _release(self, axes: Axes, start_ns: int) -> None:
        self._release_ns[axes] = start_ns

    def _let_go(self, axes: Axes) -> None:
        self._taken[axes] = False  # a faulty drive may let go of its axis

    def _forget_places(self, axes: Axes) -> None:
        for axis in axes.tolist():
            self._watch.forget(axis)

    def _recover(self, axes: Axes, latched: Axes) -> None:
        """Have the drives clear their own faults, too."""
        faulty = axes[(latched & FAULT) != 0]
        self._resetting[faulty] = True
        self._actions.extend(self._action(ActionKind.RESET, axis) for axis in faulty.tolist())

    def _move_coordinates(self, axes: Axes, by: NDArray[np.float64]) -> None:
        self._target[axes] = self._position[axes] + by

    def _home(self, axes: Axes, now_ns: int) -> None:
        """Let the drives run their own homing."""
        for axis in axes.tolist():
            self._actions.append(self._action(ActionKind.HOME, axis))
            self._engage(axis, now_ns)
            self._watch.order(axis, Order.FREE)
        self._homing[axes] = True
        self._taken[axes] = False

    # -- driver side ---------------------------------------------------------------------------

    def stop_at_limit(self, axes: AxesLike, side: AxisStatus, text: str, now_ns: int) -> None:
        """Stop axes that a velocity or a force would take past a soft limit: who waits hears it, the status says it.

        Args:
            axes: bank axes.
            side: LIMIT_MINUS or LIMIT_PLUS.
            text: for who waits.
            now_ns: the instant.
        """
        chosen = np.asarray(axes, dtype=np.int64)
        forces = [a for a in chosen.tolist() if is_force(self._running[a])]
        self._queue.emit(EventKind.DROPPED, chosen, now_ns, errno.ERANGE, text)
        self._halt(chosen, now_ns, fastest=False)
        self._outcome[chosen] |= int(side)
        self._outcome[forces] |= int(AxisStatus.FORCE_ENDED)

    def poll(
        self,
        now_ns: int,
        position: NDArray[np.float64],
        velocity: NDArray[np.float64],
        moving: NDArray[np.bool_],
        done: NDArray[np.bool_],
        fault: Sequence[str] | None = None,
        force: NDArray[np.float64] | None = None,
        holds: NDArray[np.bool_] | None = None,
        asked_ns: int = 0,
    ) -> None:
        """Take the drives' reports, look whether they move as they were told, end what has ended and begin what
        follows.

        Args:
            now_ns: instant of the report [ns].
            position: raw positions (n,).
            velocity: measured velocities (n,).
            moving: drive says it moves (n,).
            done: drive says its last command is finished (n,); believed only after the command was
                confirmed, and then seen moving or settle_s old.
            fault: fault text of each axis, empty when it has none; None when none has.
            force: measured forces or torques (n,), None when the drive tells none.
            holds: drive is switched on and holds its axis where nothing is commanded (n,); None: all do.
            asked_ns: when the drives were asked: what was confirmed later may not show in the report yet. 0: not known.
        """
        self._last_ns = now_ns
        asked_ns = asked_ns or now_ns
        heard = self._acknowledged & (asked_ns >= self._started_ns)
        if self.keeper is not None and not self._seen:
            self._offset[:], homed = self.keeper.restored(position)
            self.set_homed(np.flatnonzero(homed))
        self._seen = True
        self._moving = moving.copy()
        self._take(now_ns, position, velocity, fault, force)
        self._look(now_ns, position, velocity, holds, heard, asked_ns)
        self._repeat_stops(now_ns, moving)
        self._end_reached(now_ns, moving, done, heard, asked_ns)
        self.advance(now_ns)
        self._keep()

    def _keep(self) -> None:
        """Note where the axes are; before the drives hear of a motion."""
        if self.keeper is not None and self._seen:
            homed = (self._queue.latched & int(AxisStatus.HOMED)) != 0
            lost = (self._queue.latched & LOST) != 0
            self.keeper.note(~self._active & ~self._moving & ~lost, homed, self._raw, self._position, self._last_ns)

    def advance(self, now_ns: int) -> None:
        """Do what time and markers allow without a new report: end timed commands, begin what waits."""
        self._last_ns = max(self._last_ns, now_ns)
        self._poll_markers(now_ns)
        timed = self._active & ~self._stopping & ~self._homing & (self._end_ns <= now_ns)
        for axis in np.flatnonzero(timed).tolist():
            self._end(axis, now_ns)
        self._start_commands(now_ns)
        self._publish()

    @property
    def due_ns(self) -> int:
        """Instant at which advance() has something to do without a report, 2**62 when none."""
        waiting = self._release_ns[self._queue.has_head & (self._release_ns > self._last_ns)]
        ends = self._end_ns[self._active & ~self._stopping]
        return int(min(waiting.min(initial=NEVER_NS), ends.min(initial=NEVER_NS)))

    def take_actions(self) -> list[DriveAction]:
        """Return what shall be sent, stops first; each is handed out once."""
        self._keep()
        actions = [self._action(kind, axis) for axis, kind in self._stops.items()]
        actions += self._actions
        self._stops.clear()
        self._actions = []
        return actions

    def action_done(self, action: DriveAction, now_ns: int) -> None:
        """Note that a drive confirmed an action: from now on its reports speak of it."""
        if action.kind is ActionKind.RESET:
            self._resetting[action.axis] = False
            return
        self._acknowledged[action.axis] = True
        self._started_ns[action.axis] = now_ns
        if action.kind is ActionKind.START:
            self._refuse_late(action.axis, int(self._common_ns[action.axis]), now_ns)
            self._common_ns[action.axis] = 0
        if action.is_stop:
            self._refused_stop[action.axis] = False
            braking_ns = 2e9 * abs(self._velocity[action.axis]) / self._acceleration_limit[action.axis]
            self._send_again(action.axis, now_ns + int(min(braking_ns, 1e11)) + LONGEST_REPEAT_NS // 4)

    def action_failed(self, action: DriveAction, text: str, now_ns: int) -> None:
        """Note that an action could not be sent or was refused: the axis is stopped and in fault.

        A stop that failed goes out again and again until the drive has confirmed one, or stands.
        """
        axis = action.axis
        self._resetting[axis] = False
        self.fault([axis], f"{action.kind.value} failed: {text}", now_ns)
        if action.is_stop:
            self._stops.pop(axis, None)
            self._refused_stop[axis] = True
            self._send_again(axis, now_ns)

    def _send_again(self, axis: int, from_ns: int) -> None:
        """Send the stop of an axis again some time after an instant, more and more seldom."""
        pause_ns = FIRST_REPEAT_NS << min(int(self._repeats[axis]), 5)
        self._again_ns[axis] = from_ns + min(pause_ns, LONGEST_REPEAT_NS)
        self._repeats[axis] += 1

    def _repeat_stops(self, now_ns: int, moving: NDArray[np.bool_]) -> None:
        """Send stops again that failed or are not obeyed; an axis that rests needs none."""
        rests = self._refused_stop & ~moving
        self._rests_ns = np.where(rests, np.minimum(self._rests_ns, now_ns), NEVER_NS)
        self._acknowledged |= rests & (now_ns - self._rests_ns >= LONGEST_REPEAT_NS)
        for axis in np.flatnonzero(self._stopping & (self._again_ns <= now_ns)).tolist():
            if axis in self._stops:
                continue
            if not moving[axis] and not self._refused_stop[axis]:
                self._again_ns[axis] = NEVER_NS
                continue
            if self._repeats[axis] > DISOBEYED and not self._refused_stop[axis]:
                unit = self.settings[axis].unit
                text = (
                    f"axis {self.settings[axis].name} does not stop: told so {self._repeats[axis]} times, it moves at "
                    f"{self._velocity[axis]:.3g} {unit}/s"
                )
                self._fault_fresh(np.array([axis]), text, now_ns)
            latched = self.is_latched(axis)
            self._again_ns[axis] = NEVER_NS
            self._stops[axis] = ActionKind.QUICK_STOP if latched else ActionKind.STOP
            self._acknowledged[axis] = False

    def _look(
        self,
        now_ns: int,
        raw: NDArray[np.float64],
        velocity: NDArray[np.float64],
        holds: NDArray[np.bool_] | None,
        heard: NDArray[np.bool_],
        asked_ns: int,
    ) -> None:
        """Put axes in fault that move as nobody has told them."""
        for axis in range(self.n):
            found = self._watch.look(
                axis,
                now_ns,
                float(raw[axis]),
                float(velocity[axis]),
                moving=bool(self._moving[axis]),
                confirmed=bool(heard[axis] and self._acknowledged[axis]),
                late_ns=now_ns - asked_ns,
                holds=holds is None or bool(holds[axis]),
                latched=self.is_latched(axis),
            )
            if found is None:
                continue
            if found.lost:
                self.lose_place([axis], found.text, now_ns)
            else:
                self._fault_fresh(np.array([axis]), found.text, now_ns)

    def _action(self, kind: ActionKind, axis: int, command: Command | None = None) -> DriveAction:
        return DriveAction(
            kind, axis, command, float(self._velocity_limit[axis]), float(self._acceleration_limit[axis])
        )

    def _engage(self, axis: int, now_ns: int) -> None:
        """The axis is about to be told something; reports count only once that is confirmed."""
        self._active[axis] = True
        self._moved[axis] = self._acknowledged[axis] = False
        self._started_ns[axis] = now_ns

    def _take(
        self,
        now_ns: int,
        position: NDArray[np.float64],
        velocity: NDArray[np.float64],
        fault: Sequence[str] | None,
        force: NDArray[np.float64] | None,
    ) -> None:
        good = np.isfinite(position) & np.isfinite(velocity)
        np.copyto(self._raw, position, where=good)
        np.add(self._raw, self._offset, out=self._position)
        np.copyto(self._velocity, velocity, where=good)
        if force is not None:
            self._force[:] = force
        if not good.all():
            self._fault_fresh(np.flatnonzero(~good), "the reported position is not a finite number", now_ns)
        for axis, text in enumerate(fault or ()):
            if text and not self._resetting[axis]:
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
            self._halt(np.array([axis]), now_ns, fastest=False)

    def _end_reached(
        self,
        now_ns: int,
        moving: NDArray[np.bool_],
        done: NDArray[np.bool_],
        heard: NDArray[np.bool_],
        asked_ns: int,
    ) -> None:
        heard = heard & self._active & self._acknowledged
        self._moved |= moving & heard
        settled = asked_ns - self._started_ns >= self._settle_ns
        stands = heard & ~moving
        reached = stands & done & (self._moved | settled)
        for axis in np.flatnonzero(stands).tolist():
            command = self._running[axis]
            if self._stopping[axis]:
                self._end(axis, now_ns)
            elif self._homing[axis] and reached[axis]:
                self._homed(axis, now_ns)
            elif reached[axis] and command is not None and ends_by_itself(command):
                self._arrive(axis, command, now_ns)

    def _arrive(self, axis: int, command: Command, now_ns: int) -> None:
        """The drive stands where it was told to go: take up the play, settle, look, try again or end."""
        approach, take_up = self._approach_of(axis, command), self._take_ups[axis]
        if approach is None:
            self._end(axis, now_ns)
        elif take_up is not None:
            self._take_ups[axis] = None
            self._send_to(axis, command, take_up, now_ns, (approach.velocity, approach.acceleration))
        elif self._has_settled(axis, approach, now_ns):
            self._taken[axis] = bool(approach.distance)
            one = np.array([axis])
            missed, again = self._arrivals.judge(one, self._target[one] - self._position[one])
            if again[0]:
                self._go(axis, command, approach, now_ns)
                return
            self._outcome[axis] = int(AxisStatus.MISSED_TARGET) if missed[0] else 0
            self._end(axis, now_ns)

    def _has_settled(self, axis: int, approach: Approach, now_ns: int) -> bool:
        if self._settled_ns[axis] == NEVER_NS:
            self._settled_ns[axis] = now_ns + int(approach.settle_s * 1e9)
        return bool(now_ns >= self._settled_ns[axis])

    def _approach_of(self, axis: int, command: Command) -> Approach | None:
        return self._approaches[axis] if is_point_move(command.control_mode) else None

    def _go(self, axis: int, command: Command, approach: Approach, now_ns: int) -> None:
        """Send the drive to its target, where needed by way of the place from which it takes up the play."""
        target, present = float(self._target[axis]), float(self._position[axis])
        stands, taken = not self._moving[axis], bool(self._taken[axis])
        straight = not approach.distance or (stands and approach.is_straight(target, present, taken))
        self._take_ups[axis] = None if straight else target
        self._settled_ns[axis] = NEVER_NS
        self._taken[axis] = False
        self._send_to(axis, command, target if straight else target - approach.distance, now_ns)

    def _send_to(
        self,
        axis: int,
        command: Command,
        place: float,
        now_ns: int,
        most: tuple[float, float] = (math.inf, math.inf),
    ) -> None:
        """Tell the drive to go to a place, at a velocity and an acceleration of at most so much."""
        command = command._replace(position=float(place - self._offset[axis]))
        action = self._action(ActionKind.START, axis, command)
        velocity, acceleration = min(action.velocity_max, most[0]), min(action.acceleration_max, most[1])
        self._actions.append(replace(action, velocity_max=velocity, acceleration_max=acceleration))
        self._engage(axis, now_ns)
        self._watch.order(axis, Order.POINT, command.position)

    def _homed(self, axis: int, now_ns: int) -> None:
        self._homing[axis] = False
        self._queue.latched[axis] &= ~int(AxisStatus.HOMING)
        self.set_homed([axis])
        self._end(axis, now_ns)

    def _end(self, axis: int, now_ns: int) -> None:
        command, one = self._running[axis], np.array([axis])
        self._running[axis] = None
        if command is not None:
            self._queue.emit(EventKind.ENDED, one, now_ns)
            if command.control_mode & modes.SIGNAL_MARKER:
                self._queue.signal(command.signal_marker_number, command.signal_generation, now_ns)
        was_stop = bool(self._stopping[axis])
        self._active[axis] = self._stopping[axis] = self._refused_stop[axis] = False
        self._again_ns[axis], self._repeats[axis] = NEVER_NS, 0
        self._watch.order(axis, Order.HOLD)
        self._queue.load_heads(one)
        if not self._queue.has_head[axis]:
            if was_stop or command is None or ends_by_itself(command):
                self._queue.emit(EventKind.IDLE, one, now_ns)
            else:
                self._halt(one, now_ns, fastest=False)

    def _start_commands(self, now_ns: int) -> None:
        queue = self._queue
        queue.load_heads(np.flatnonzero(~queue.has_head))
        free = queue.has_head & ~queue.gated_synch & ~queue.gated_marker & ~self._stopping & ~self._homing
        free &= self._release_ns <= now_ns
        for axis in np.flatnonzero(free).tolist():
            if self._refuse_late(axis, int(self._release_ns[axis]), now_ns):
                continue
            running = self._running[axis]
            if self._active[axis] and running is not None:
                if not is_open_ended(running):
                    continue
                self._end(axis, now_ns)
            self._start(axis, now_ns)

    def _refuse_late(self, axis: int, start_ns: int, now_ns: int) -> bool:
        """Stop an axis whose common start has come too late; return whether it has."""
        if not start_ns or now_ns - start_ns <= LATE_START_NS:
            return False
        late, most = (now_ns - start_ns) * 1e-6, LATE_START_NS * 1e-6
        text = f"axis {self.settings[axis].name} starts {late:.0f} ms after the common start; at most {most:g} ms"
        one = np.array([axis])
        self._queue.latch_fault(one, text, now_ns, errno.ETIME)
        self._abandon(one, now_ns, errno.ETIME, text, fastest=True)
        return True

    def _start(self, axis: int, now_ns: int) -> None:
        command, one = self._queue.heads[axis], np.array([axis])
        if command is None:
            return
        mode, approach = command.control_mode, None
        if mode & modes.POSITION:
            target = command.position + (self._target[axis] if mode & modes.RELATIVE else 0.0)
            low, high = self._limits.minimum[axis], self._limits.maximum[axis]
            approach = self._approach_of(axis, command)
            try:
                if not low <= target <= high:
                    raise InfeasibleError(f"position {target:g} is outside the soft limits; want {low:g} to {high:g}")
                if approach is not None:
                    approach.begin_of_take_up(target, low, high)
            except InfeasibleError as error:
                self.fault(one, str(error), now_ns)
                return
            self._target[axis] = target
            command = command._replace(position=float(target - self._offset[axis]))
        if mode & modes.MAX_VEL_ACC:
            self._velocity_limit[axis], self._acceleration_limit[axis] = (
                command.max_velocity,
                command.max_acceleration,
            )
        timed = bool(mode & modes.TIME) and command.time > 0
        due_ns, fraction = (int(self._end_ns[axis]), float(self._end_fraction[axis]))
        if not 0 <= now_ns - due_ns < self._settle_ns:
            due_ns, fraction = now_ns, 0.0
        total = fraction + command.time * 1e9
        self._end_ns[axis] = due_ns + int(total) if timed else NEVER_NS
        self._end_fraction[axis] = total % 1.0 if timed else 0.0
        self._common_ns[axis], self._release_ns[axis] = self._release_ns[axis], 0
        self._queue.has_head[axis] = False
        self._running[axis] = command
        self._outcome[axis] = self._arrivals.tries[axis] = 0
        self._queue.emit(EventKind.STARTED, one, now_ns)
        if approach is None:
            self._taken[axis] = False
            self._engage(axis, now_ns)
            self._watch.order(axis, *order_of(command))
            self._actions.append(self._action(ActionKind.START, axis, command))
        elif not self._active[axis] and approach.is_idle_for(self._target[axis], self._position[axis]):
            self._end(axis, now_ns)
        else:
            self._go(axis, command, approach, now_ns)

    def _halt(self, axes: Axes, now_ns: int, *, fastest: bool) -> None:
        self._drop(axes)
        self._end_ns[axes] = NEVER_NS
        self._end_fraction[axes] = 0.0
        self._actions = [a for a in self._actions if a.axis not in axes or a.kind is ActionKind.RESET]
        self._queue.latched[axes] &= ~int(AxisStatus.HOMING)
        self._homing[axes] = False
        for axis in axes.tolist():
            self._running[axis] = None
            if fastest or self._stops.get(axis) is not ActionKind.QUICK_STOP:
                self._stops[axis] = ActionKind.QUICK_STOP if fastest else ActionKind.STOP
            self._engage(axis, now_ns)
            self._watch.order(axis, Order.STOP)
        self._stopping[axes] = True

    def _publish(self) -> None:
        running = np.array([c is not None for c in self._running])
        position_mode = np.array([c is not None and bool(c.control_mode & modes.POSITION) for c in self._running])
        self._target[~self._active] = self._position[~self._active]
        np.copyto(self._desired, np.where(position_mode, self._target, self._position))
        np.copyto(self._desired_velocity, self._velocity)
        np.subtract(self._desired, self._position, out=self._following)
        busy = self._active | self._moving
        self._in_motion[:] = busy
        status = self._queue.latched | self._outcome
        status |= np.where(busy, int(AxisStatus.MOVING), 0)
        status |= np.where(self._stopping, int(AxisStatus.STOPPING), 0)
        if any(is_force(command) for command in self._running):
            forces = np.array([is_force(command) for command in self._running])
            status |= np.where(forces & self._active, int(AxisStatus.FORCE_MODE), 0)
        status |= np.where(self._queue.gated_marker & ~running, int(AxisStatus.WAITING_MARKER), 0)
        status |= np.where(self._queue.gated_synch & ~running, int(AxisStatus.WAITING_SYNCH), 0)
        self._status[:] = status
        self._queue.count(self._buffered)
