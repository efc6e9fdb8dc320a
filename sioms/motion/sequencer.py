"""Sequencer: which plan every axis runs, and what follows when one ends.

An axis always runs exactly one plan: a hold at rest, a command, or a brake. It begins where the one before ended, but
for axes that cannot follow: their stops begin where they are, and commands that break off others no farther ahead than
their force reaches. The plan of the next command is made ahead, in the slack between ticks, when the state it begins in
is known; then its start is a few array operations for all axes that start together, a thousand as well as one.
Concurrency: that of the bank.
"""

from __future__ import annotations

import errno
import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sioms.protocol.flags import AxisStatus

from . import modes
from .arrival import Arrivals
from .axis_step import BRAKE, FORCE, HOLD, POSITION, RATE, SETTLING, STOP
from .commands import Command
from .law import ControlLaw
from .noted import Noted
from .pace import Pace
from .plan_step import STILL, Plans
from .planning import Planned, Planning
from .profile import InfeasibleError, State
from .queue import FAULT, CommandQueue
from .settings import AxisSettings
from .store import UNCUT_NS, PlanStore
from .types import EventKind

Axes = NDArray[np.int64]
Floats = NDArray[np.float64]

_MOVING = AxisStatus.MOVING
_FORCE, _STOPPING = _MOVING | AxisStatus.FORCE_MODE, _MOVING | AxisStatus.STOPPING
_KIND_STATUS = np.array([0, _MOVING, _MOVING, _FORCE, _MOVING, _STOPPING, _MOVING], dtype=np.int64)
_HOMING = int(AxisStatus.HOMING)


class Sequencer:
    """Plans of n axes in time. Arrays (n,): ``kind`` of the running plan, ``guard`` where soft limits are
    watched in every tick, ``outcome`` LIMIT_* and MISSED_TARGET of the last motion, ``status`` and ``in_motion``
    as they change with events, ``stopped`` where the last motion has been broken off by a stop, ``hardest`` the
    configured deceleration, for velocities that no profile has made.

    Args:
        settings: one per axis.
        queue: the waiting commands.
        store: of the plans.
        law: where gains, offset and force limit of a command are put in force.
        arrivals: how point moves end.
        position, velocity: measured, (n,), kept up to date by the bank; axes in force mode begin
            what follows from there.
        in_motion: (n,) int64, written here.
        tick_s: nominal period [s].
    """

    def __init__(
        self,
        settings: Sequence[AxisSettings],
        queue: CommandQueue,
        store: PlanStore,
        law: ControlLaw,
        arrivals: Arrivals,
        position: Floats,
        velocity: Floats,
        in_motion: NDArray[np.int64],
        tick_s: float,
    ) -> None:
        n = len(settings)
        self.store = store
        self.kind, self.guard, self.status = law.kind, law.guard, law.event_status
        self.outcome = np.zeros(n, dtype=np.int64)
        self.stopped = np.zeros(n, dtype=bool)
        self.any_force = False
        self.any_guard = False
        self._queue = queue
        self._limits = queue.limits
        self._law = law
        self._position = position
        self._velocity = velocity
        self._in_motion = in_motion
        self.planning = Planning(settings, queue, store, law)
        self._row_kind = np.zeros(2 * n, dtype=np.int64)
        self._row_command: list[Command | None] = [None] * (2 * n)
        flags = (np.zeros(2 * n, dtype=bool) for _ in range(5))
        self._row_guard, self._row_signals, self._row_sets, self._row_checked, self._row_taken = flags
        self.arrivals = arrivals
        self.hardest = np.array([s.acceleration_max for s in settings])
        self._ready = np.zeros(n, dtype=bool)
        self._todo: dict[int, None] = {}
        self._noted = Noted(n)
        self.pace = Pace(law.begun, tick_s)
        self._tick_s = tick_s

    # -- what the bank asks for ---------------------------------------------------------------

    def appended(self, axes: Axes, now_ns: int) -> None:
        """New commands wait on these axes: begin at now what no gate and no running command holds."""
        self._todo.update(dict.fromkeys(axes[~self._ready[axes]].tolist()))
        self.release(axes, now_ns)
        self.advance(now_ns)
        self.refresh(axes)

    def replaced(self, axes: Axes, now_ns: int) -> None:
        """New commands shall take over at now from whatever runs, without its signal."""
        self._todo.update(dict.fromkeys(axes.tolist()))
        rows = self.store.row[axes]
        self._row_signals[rows] = self._row_checked[rows] = self._row_taken[rows] = False
        may = self.pace.take_over(axes)
        if not may.all():  # they go on with what they do until the next tick
            self.refresh(axes[~may])
            axes = axes[may]
            if not axes.size:
                return
        self.store.cut(axes, now_ns)
        self.advance(now_ns)  # all of these plans end now, and what follows is what refreshes

    @property
    def has_work(self) -> bool:
        """Tell whether commands wait for the next tick, or to be planned ahead."""
        return bool(self.pace.held or self._todo)

    @property
    def is_plain(self) -> bool:
        """Tell whether no axis presses, or has, or is held back, and no arrival is looked at."""
        return not (self.any_force or self.pace.held or self.arrivals.watched or self._law.force_ends.any)

    def begun(self, axes: Sequence[int], now_ns: int) -> None:
        """Go on behind plans that steps have begun at now on these axes, for which nothing else waits."""
        store = self.store
        self._ready[axes] = False
        self.any_guard = bool(self.guard.any())
        store.next_ns = min(store.next_ns, *map(store.end_ns.item, axes))
        self.advance(now_ns)

    def release_held(self, now_ns: int) -> None:
        """Let the commands that waited for this tick begin at now."""
        if not self.pace.held:
            return
        held, taking = self.pace.take_held()
        self.release(held, now_ns)
        if taking.size:
            self.store.cut(taking, now_ns)

    def release(self, axes: Axes, start_ns: int) -> None:
        """End the open-ended plans of these axes at start_ns where the head has no gate (any more)."""
        queue, store = self._queue, self.store
        free = queue.has_head[axes] & ~queue.gated_synch[axes] & ~queue.gated_marker[axes]
        free &= self.is_open_ended(axes) & (store.cut_ns[axes] == UNCUT_NS)
        chosen = axes[free]
        if chosen.size:
            store.cut(chosen, start_ns)

    def is_open_ended(self, axes: Axes) -> NDArray[np.bool_]:
        """Tell which running plans last until the next command."""
        ended: NDArray[np.bool_] = np.isinf(self.store.duration[self.store.row[axes]])
        return ended

    def is_idle(self, axes: Axes) -> NDArray[np.bool_]:
        """Tell which axes hold still, have no command and are not homing."""
        idle: NDArray[np.bool_] = (self.kind[axes] == HOLD) & ~self._queue.has_head[axes]
        idle &= (self._queue.latched[axes] & _HOMING) == 0
        return idle

    def rest_positions(self) -> Floats:
        """Return where axes without commands rest, NaN for the others (n,)."""
        idle = np.isin(self.kind, (HOLD, SETTLING)) & ~self._queue.has_head
        rest: Floats = np.where(idle, self.store.final[self.store.row, 0], np.nan)
        return rest

    def drop(self, axes: Axes) -> None:
        """Forget all waiting commands of these axes, the plans made for them, and when they were to start."""
        self._queue.clear(axes)
        self.store.uncut(axes)
        self._ready[axes] = False
        self.pace.forget(axes)
        if self._todo:
            for axis in axes.tolist():
                self._todo.pop(axis, None)

    def plans(self, fresh: NDArray[np.bool_]) -> Plans:
        """Return what steps go on with; ``fresh`` is theirs to fill."""
        store = self.store
        return Plans(
            loop=self._law.loop, row=store.row, start_ns=store.start_ns, start_fraction=store.start_fraction,
            end_ns=store.end_ns, cut_ns=store.cut_ns, duration=store.duration, final=store.final,
            row_kind=self._row_kind, row_signals=self._row_signals, row_checked=self._row_checked,
            row_taken=self._row_taken, stopped=self.stopped, fresh=fresh,
            braked_ns=0, outcome=self.outcome, in_motion=self._in_motion, awaited=0, ended_ns=self._noted.ended_ns,
            idle_ns=self._noted.idle_ns, untold=0, follows=0, ready=self._ready, gated_synch=self._queue.gated_synch,
            gated_marker=self._queue.gated_marker, row_guard=self._row_guard, row_sets=self._row_sets,
            started_ns=self._noted.started_ns, started=0, tick_s=self._tick_s, state=np.zeros(3), **store.segments,
        )  # fmt: skip

    def tell_ends(self) -> None:
        """Tell of the ends and begins that steps have found, in their order; those of a tick together."""
        self._todo.update(dict.fromkeys(self._noted.tell(self._queue)))
        self._settle_masks()

    def after_stop(self) -> None:
        """Go on behind a stop that steps have begun: plans that are over are due."""
        self.store.look_ahead()
        self._settle_masks()
        self.refresh(np.arange(len(self.kind)))

    def halt(self, axes: Axes, now_ns: int, *, brakes: bool = False) -> None:
        """Drop the commands and brake at maximum deceleration from the present state.

        Args:
            axes: which.
            now_ns: when [ns].
            brakes: steps have begun their stops at now; an axis that fell behind since goes on with its.
        """
        waited = axes[(self.kind[axes] == HOLD) & self._queue.has_head[axes]]
        self.drop(axes)
        tuned = self._law.tuned[axes]
        moves = (self.kind[axes] != HOLD) & (self.kind[axes] != STOP) | tuned & self._law.moves(axes)
        if not brakes:
            moves |= self._law.is_behind(axes)
        moving, resting = axes[moves], axes[tuned & ~moves]
        if moving.size:
            self.stop(moving, now_ns, now_ns)
            self.advance(now_ns)
        if resting.size:
            self.hold(resting, self._law.brace(resting, now_ns), now_ns)
        if waited.size:
            self._queue.emit(EventKind.IDLE, waited[self.is_idle(waited)], now_ns)
        self.refresh(axes)

    def stop(self, axes: Axes, seen_ns: int, start_ns: int) -> None:
        """Stop at maximum deceleration, beginning at start_ns, from the state of seen_ns: that of the set-points, or
        the actual one of axes that cannot follow them, or do so by gains or with a force that a command has set.
        """
        law = self._law
        most, tuned = self._limits.acceleration[axes], law.tuned[axes]
        state, pressing = self.state(axes, seen_ns), self.kind[axes] == FORCE
        behind = law.is_behind(axes) & (law.stepper[axes] | ~tuned)
        if tuned.any() or pressing.any():
            measured = (tuned | pressing) & ~law.stepper[axes]  # no profile has made their velocities
            most[measured] = self.hardest[axes[measured]]
            state[tuned, 1] = law.actual(axes[tuned])[1]
            state[tuned, 0] = law.brace(axes, seen_ns)[tuned]
            state[pressing, 0] += law.hold_load(axes[pressing])
            beside = tuned | pressing
            state[beside, 0] -= self._beyond(axes[beside], state[beside], most[beside], seen_ns)
        if behind.any():
            late = axes[behind]
            state[behind, 0], state[behind, 1] = law.actual(late, seen_ns)
            law.give_way(late)
        self.brake(axes, state, start_ns, most)

    def _beyond(self, axes: Axes, state: Floats, most: Floats, now_ns: int) -> Floats:
        """Return how far set-points of servos that brake from state would come to rest beyond their soft limits, or
        farther beyond than the axes are (m,); their errors are less by that.
        """
        at, limits = self._law.actual(axes, now_ns)[0], self._limits
        stand = state[:, 0] + state[:, 1] * np.abs(state[:, 1]) / (2.0 * most)
        kept = np.clip(stand, np.minimum(limits.minimum[axes], at), np.maximum(limits.maximum[axes], at))
        beyond: Floats = np.where(self._law.stepper[axes], 0.0, stand - kept)
        self._law.come_nearer(axes, beyond)
        return beyond

    def brake(self, axes: Axes, state: Floats, start_ns: int, most: Floats) -> None:
        """Stop from state (m, 2 or 3) at a deceleration of most (m,), beginning at start_ns."""
        store = self.store
        store.put_brake(store.row[axes], state[:, 0], state[:, 1], most)
        self._run_now(axes, STOP, start_ns)

    def hold(self, axes: Axes, position: Floats, start_ns: int) -> None:
        """Rest at position, which is where they are; what waited for the end of something else begins."""
        self.store.put_hold(self.store.row[axes], position)
        self._run_now(axes, HOLD, start_ns)
        self.release(axes, start_ns)

    def stay(self, axes: Axes, position: Floats, now_ns: int) -> None:
        """Have axes that rest or settle rest at position instead."""
        settling = axes[self.kind[axes] == SETTLING]
        self.hold(axes, position, now_ns)
        self._queue.emit(EventKind.IDLE, settling[self.is_idle(settling)], now_ns)

    def drive(self, axis: int, velocity: float, now_ns: int) -> None:
        """Go over to a velocity from the present state, outside the buffer and the soft limits (homing)."""
        one = np.array([axis])
        p, v, a = self.state(one, now_ns)[0].tolist()
        if self._law.tuned[axis]:
            p, v, a = float(self._law.brace(one, now_ns)[0]), 0.0, 0.0
        self.store.put(int(self.store.row[axis]), self.planning.drive(axis, velocity, (p, v, a)))
        self._law.force_ends.end(one)
        self._run_now(one, RATE, now_ns)

    def _run_now(self, axes: Axes, kind: int, start_ns: int) -> None:
        tuned = axes[self._law.tuned[axes]]
        if tuned.size:  # what no command has asked for is done by the gains that are configured
            self._law.brace(tuned, start_ns)
            self._law.give_way(tuned)
        self._set_kind(axes, kind)
        self.stopped[axes] = kind == STOP
        self._row_taken[self.store.row[axes]] = False
        self.store.begin(axes, np.full(axes.size, start_ns), np.zeros(axes.size))
        self._settle_masks()
        self.refresh(axes)

    def state(self, axes: Axes, now_ns: int) -> Floats:
        """Return the set-point state (m, 3) at now; of axes in force mode the measured one."""
        return self._actual_of_force(axes, self.store.state(axes, now_ns), now_ns)

    def _end_state(self, axes: Axes, at_ns: NDArray[np.int64], now_ns: int) -> tuple[Floats, NDArray[np.bool_]]:
        """Return the state (m, 3) in which what follows the plans that have just ended begins, and who cannot follow.

        Args:
            axes: whose plans.
            at_ns: when these have ended (m,).
            now_ns: when all that is due has been done.
        """
        store, law = self.store, self._law
        state = self._actual_of_force(axes, store.final[store.row[axes]], now_ns)
        broken = np.flatnonzero(store.cut_ns[axes] != UNCUT_NS)
        behind = broken[law.is_behind(axes[broken])] if broken.size else broken
        is_late = np.zeros(len(axes), dtype=bool)
        if behind.size:
            late = axes[behind]
            is_late[behind] = True
            position, velocity = law.place_at(late, at_ns[behind]), law.actual(late)[1]
            reach = np.minimum(np.abs(state[behind, 0] - position), law.full_error(late))
            state[behind, 0] = position + np.copysign(reach, state[behind, 0] - position)
            state[behind, 1], state[behind, 2] = velocity, 0.0
            self._ready[late] = False  # what was planned ahead would begin somewhere else
        return state, is_late

    def _actual_of_force(self, axes: Axes, state: Floats, now_ns: int) -> Floats:
        if self.any_force:
            force = self.kind[axes] == FORCE
            state[force, 0], state[force, 1] = self._law.actual(axes[force], now_ns)
            state[force, 2] = 0.0
        return state

    # -- transitions --------------------------------------------------------------------------

    def advance(self, now_ns: int) -> None:
        """Carry out everything that was due until now, at its own exact instant."""
        store = self.store
        if now_ns < store.next_ns:
            return
        while (axes := store.due(now_ns)).size:
            ended = store.advance(axes)
            if ended.size:
                self._finish(ended, now_ns)

    def _finish(self, axes: Axes, now_ns: int) -> None:
        """End the running plans of these axes and begin what follows."""
        if self.arrivals.watched:
            axes = self._look_at_arrivals(axes, now_ns)
            if not axes.size:
                return
        store, queue = self.store, self._queue
        rows = store.row[axes]
        start_ns, fraction = store.ended_at(axes)
        state, late = self._end_state(axes, start_ns, now_ns)
        kind = self._row_kind[rows]
        queue.emit(EventKind.ENDED, axes[(kind >= POSITION) & (kind <= FORCE)], now_ns)
        for row in rows[self._row_signals[rows]].tolist():
            self._signal(row, now_ns)
        queue.load_heads(axes)
        free = queue.has_head[axes] & ~queue.gated_synch[axes] & ~queue.gated_marker[axes]
        self.pace.follow(axes, store.duration[rows], np.abs(state[:, 1]) <= STILL, free)
        begins = self._recalled(axes, state, free, now_ns) if self._law.any_braced else state
        for i in np.flatnonzero(free & ~self._ready[axes]).tolist():
            p, v, a = begins[i].tolist()
            self._plan_head(int(axes[i]), (p, v, a), now_ns)
        go = free & self._ready[axes]
        if (late & go).any():
            self._law.begin_at(axes[late & go], begins[late & go, 0], start_ns[late & go])
        if go.all():
            self._start(axes, start_ns, fraction, now_ns)
        else:
            if go.any():
                self._start(axes[go], start_ns[go], fraction[go], now_ns)
            faulty = ~go & self._law.tuned[axes] & ((queue.latched[axes] & FAULT) != 0)
            if faulty.any():  # what follows was not possible
                self.stop(axes[faulty], now_ns, now_ns)
            rest = ~go & ~faulty
            self._rest(axes[rest], state[rest], start_ns[rest], fraction[rest], now_ns)

    def _recalled(self, axes: Axes, state: Floats, free: NDArray[np.bool_], now_ns: int) -> Floats:
        """Return the states in which commands begin, of braced axes those in which the gains to come keep the force."""
        state = state.copy()
        for i in np.flatnonzero(free & self._law.is_braced(axes)).tolist():
            axis = int(axes[i])
            command = self._queue.heads[axis]
            if command is not None and not command.control_mode & modes.ANY_FORCE:
                p, v, a = state[i].tolist()
                state[i, 0] = self.planning.recalled(axis, command, (p, v, a), now_ns)
                self._ready[axis] = False
        return state

    def _look_at_arrivals(self, axes: Axes, now_ns: int) -> Axes:
        """Try point moves that missed their targets again, as often as is allowed; return the axes that have ended."""
        rows = self.store.row[axes]
        checked = self._row_checked[rows]
        if not checked.any():
            return axes
        looked, at = axes[checked], rows[checked]
        missed, again = self.arrivals.judge(looked, self.store.final[at, 0] - self._position[looked])
        self._row_checked[at[~again]] = False
        failed = [axis for axis in looked[again].tolist() if not self._try_again(axis)]
        self.arrivals.misses[failed] += 1
        self.outcome[[*looked[missed].tolist(), *failed]] |= int(AxisStatus.MISSED_TARGET)
        tries = np.setdiff1d(looked[again], failed)
        return axes[~np.isin(axes, tries)]

    def _try_again(self, axis: int) -> bool:
        """Begin the running point move of a stepper anew, from where it is measured to be; tell whether that is
        possible.
        """
        store, row = self.store, int(self.store.row[axis])
        command, taken = self._row_command[row], bool(self._row_taken[row])
        if command is None:
            return False
        one, measured, target = np.array([axis]), float(self._position[axis]), float(store.final[row, 0])
        start_ns, fraction = store.ended_at(one)
        try:
            planned = self.planning.planned_again(axis, command, measured, target, taken)
        except InfeasibleError:
            self._row_checked[row] = False
            return False
        if planned is None:
            return False
        self._law.anchor_at(axis, measured)
        store.put(row, planned.plan)
        self._row_taken[row] = planned.taken
        store.begin(one, start_ns, fraction)
        return True

    def _signal(self, row: int, now_ns: int) -> None:
        command = self._row_command[row]
        self._row_signals[row] = False
        if command is not None:
            self._queue.signal(command.signal_marker_number, command.signal_generation, now_ns)

    def _start(self, axes: Axes, start_ns: NDArray[np.int64], fraction: Floats, now_ns: int) -> None:
        store = self.store
        store.flip(axes)
        rows = store.row[axes]
        store.begin(axes, start_ns, fraction)
        self._ready[axes] = False
        self._queue.has_head[axes] = False
        self.pace.forget(axes)
        if self.any_force or self._law.force_ends.any:
            self._law.force_ends.end(axes)
        recalled = axes[:0]
        if self._law.any_braced:
            recalled = self._law.recall(axes, store.state(axes, now_ns)[:, 0], now_ns)
        self.kind[axes] = self._row_kind[rows]
        pressing = axes[self.kind[axes] == FORCE]
        if pressing.size:
            self._law.speed_most[pressing] = self._limits.velocity[pressing]
            self._law.moved_ns[pressing] = now_ns
        self.guard[axes] = self._row_guard[rows]
        self.outcome[axes] = 0
        self.stopped[axes] = False
        if self.arrivals.watched:
            self.arrivals.tries[axes] = 0
        self._todo.update(dict.fromkeys(axes.tolist()))
        for row in rows[self._row_sets[rows]].tolist():
            self.planning.put_in_force(row // 2, self._row_command[row])
        if recalled.size:
            self._law.carry_on(recalled)
        self._queue.emit(EventKind.STARTED, axes, now_ns)
        self._settle_masks()
        self.refresh(axes)

    def _rest(self, axes: Axes, state: Floats, start_ns: NDArray[np.int64], fraction: Floats, now_ns: int) -> None:
        """Nothing follows: hold the axes at rest, brake the others."""
        store, pressed = self.store, self.kind[axes] == FORCE
        if pressed.any():  # nothing that a command has set for a force need brake the axis
            self._law.brace(axes[pressed], now_ns)
        still = np.abs(state[:, 1]) <= STILL
        chosen = axes[still]
        if chosen.size:
            came = chosen[self.kind[chosen] != HOLD]
            store.put_hold(store.row[chosen], state[still, 0])
            self._set_kind(chosen, HOLD)
            self.settle(came, now_ns)
            store.begin(chosen, start_ns[still], fraction[still])
            self._queue.emit(EventKind.IDLE, came[self.is_idle(came)], now_ns)
        chosen = axes[~still]
        if chosen.size:
            deceleration = np.where(pressed, self.hardest[axes], self._limits.acceleration[axes])[~still]
            store.put_brake(store.row[chosen], state[~still, 0], state[~still, 1], deceleration)
            self._set_kind(chosen, BRAKE)
            self._ready[chosen] = False  # what was planned ahead would begin in motion
            self._todo.update(dict.fromkeys(chosen.tolist()))
            store.begin(chosen, start_ns[~still], fraction[~still])
        self._settle_masks()
        self.refresh(axes)

    def settle(self, axes: Axes, now_ns: int) -> None:
        """Of these axes, whose set-points rest, wait for those that are still on their way."""
        rest = self.store.final[self.store.row[axes], 0]
        settling = axes[(self.kind[axes] == HOLD) & self._law.is_on_its_way(axes, rest)]
        if settling.size:
            self._set_kind(settling, SETTLING)
            self._law.moved_ns[settling] = now_ns
            self.refresh(settling)

    def settled(self, axes: Axes, now_ns: int) -> None:
        """These axes have come to rest behind their set-points."""
        self._set_kind(axes, HOLD)
        self._queue.emit(EventKind.IDLE, axes[self.is_idle(axes)], now_ns)
        self.refresh(axes)

    def _set_kind(self, axes: Axes, kind: int) -> None:
        if self.any_force:
            self._leave_force(axes)
        rows = self.store.row[axes]
        self.kind[axes] = self._row_kind[rows] = kind
        self.guard[axes] = False
        self._row_signals[rows] = self._row_checked[rows] = False

    def _leave_force(self, axes: Axes) -> None:
        """Axes that leave force mode for a stop or a hold press no harder than they were told."""
        law = self._law
        for axis in axes[self.kind[axes] == FORCE].tolist():
            velocity, limit = float(self._velocity[axis]), float(law.velocity_limit[axis])
            law.force_ends.begin(axis, velocity, limit, float(law.offset[axis]))

    def _settle_masks(self) -> None:
        self.any_force = bool((self.kind == FORCE).any())
        self.any_guard = bool(self.guard.any())

    def refresh(self, axes: Axes) -> None:
        """Rebuild the status bits that change with events only."""
        kind, queue = self.kind[axes], self._queue
        status = _KIND_STATUS[kind]
        status |= queue.latched[axes]
        status |= self.outcome[axes]
        marker, synch = queue.gated_marker[axes], queue.gated_synch[axes]
        if marker.any() or synch.any():
            waiting = self.is_open_ended(axes)
            status |= (waiting & marker) * np.int64(AxisStatus.WAITING_MARKER)
            status |= (waiting & synch) * np.int64(AxisStatus.WAITING_SYNCH)
        self.status[axes] = status
        self._in_motion[axes] = kind != HOLD

    # -- planning -----------------------------------------------------------------------------

    def plan_ahead(self, count: int, now_ns: int) -> int:
        """Plan up to ``count`` heads whose starting state is known; return how many axes were looked at."""
        done = 0
        queue, todo, store = self._queue, self._todo, self.store
        while todo and done < count:
            axis = next(iter(todo))
            del todo[axis]
            done += 1
            if not queue.load_head(axis) or self._ready[axis]:
                continue
            kind, row = self.kind[axis], store.row[axis]
            if kind == HOLD or (kind != FORCE and store.duration[row] < math.inf):
                p, v, a = store.final[row].tolist()
                self._plan_head(axis, (p, v, a), now_ns)
        return done

    def _plan_head(self, axis: int, state: State, now_ns: int) -> None:
        """Plan the head of an axis from a state into its other row; a failure is a latched fault."""
        command = self._queue.heads[axis]
        if command is None:
            return
        try:
            planned = self.planning.planned(axis, command, state, bool(self._row_taken[self.store.row[axis]]))
        except InfeasibleError as e:
            self._refuse(axis, str(e), now_ns)
            return
        self.put(axis, command, planned)
        self._ready[axis] = True

    def put(self, axis: int, command: Command, planned: Planned) -> None:
        """Write a plan into the other row of its axis."""
        row, mode = self.store.row.item(axis) ^ 1, command.control_mode
        self.store.put(row, planned.plan)
        self._row_kind[row] = planned.kind
        self._row_guard[row] = planned.plan.guard
        self._row_command[row] = command
        self._row_signals[row] = mode & modes.SIGNAL_MARKER != 0
        self._row_sets[row] = mode & modes.SETTINGS != 0
        self._row_checked[row], self._row_taken[row] = planned.looked_at, planned.taken

    def _refuse(self, axis: int, text: str, now_ns: int) -> None:
        """A command turned out infeasible: drop the buffer and latch a fault; the axis brakes and holds."""
        one = np.array([axis])
        self.drop(one)
        self._queue.emit(EventKind.DROPPED, one, now_ns, errno.ERANGE, text)
        self._queue.latch_fault(one, text, now_ns, errno.ERANGE)
        self.refresh(one)
