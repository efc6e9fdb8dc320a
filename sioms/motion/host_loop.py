"""AxisBank: axes whose loop the host closes.

A tick measures, advances plans, keeps limits, applies the control law and fills ``fields``; what verbs mean is in
bank.py, which plan an axis runs and what follows it in sequencer.py.
"""

from __future__ import annotations

import errno
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from sioms.protocol.flags import AxisStatus

from . import axis_step
from .axis_step import FORCE, HOLD, SETTLING, STOP, Loop
from .bank import Axes, Bank
from .commands import Command
from .guard import LimitGuard
from .homing import HomingRuns
from .host_watch import HostWatch
from .law import ControlLaw
from .queue import FAULT, LOST
from .sequencer import Sequencer
from .settings import SWITCH_MINUS, SWITCH_PLUS, AxisSettings
from .short_way import ShortWay
from .store import PlanStore
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
        makes_up: tells whether late ticks are made up for, each at its own time, as those of a simulated device are;
            a verb then acts within a tick after the last, because the axes have come no further.
        leaves_out: returns how much of the time from the last tick to now nothing has changed in, and is left out [ns,
            whole ticks]: the last tick was so much later.
        derived: the positions are made of those of other axes, whose own watch finds motors that run the wrong way; an
            axis that is brought back from where these have come is none.

    ``arrays`` are those of the loop by name (``axis_step.Loop``), to be read.
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
        makes_up: Callable[[], bool] = lambda: False,
        leaves_out: Callable[[int], int] = lambda now_ns: 0,
        derived: bool = False,
    ) -> None:
        super().__init__(settings, markers, capacity, passing=True)
        n = self.n
        store = PlanStore(n)
        queue, limits = self._queue, self._queue.limits
        self._law = ControlLaw(
            settings, tick_s, raw=self._raw, offset=self._offset, present=store.present, segment_ns=store.segment_ns,
            minimum=limits.minimum, maximum=limits.maximum, deceleration=limits.acceleration,
            desired=self._desired, desired_velocity=self._desired_velocity, following=self._following,
            latched=queue.latched, waiting=queue.waiting, has_head=queue.has_head,
            **{column: row for column, row in self.rows.items() if column in Loop.kinds},
        )  # fmt: skip
        self.loop = self._law.loop
        self.loop.late_ns = self._late_ns = int(late_max_s * 1e9)
        self.loop.derived = int(derived)
        self.stepper = self._law.stepper
        self._sequencer = Sequencer(
            settings, self._queue, store, self._law, self._arrivals, self._position, self._velocity, self._in_motion,
            tick_s,
        )  # fmt: skip
        self.plans = self._sequencer.plans(self._braked)
        self._short_way = ShortWay(self._sequencer, self._queue, self._law, self.plans)
        self._braked_ns = 0
        """When the stop of these axes began [ns]; 0: there are none."""
        self._guard = LimitGuard(self._queue, self._sequencer, self._law)
        self._homing = HomingRuns(settings, self._queue, self)
        self._motion_watch = HostWatch(settings, tick_s, self._law)
        arrays = self.arrays = self._law.arrays
        self._limp, self._actuator, self._last_raw = self._law.limp, self._law.actuator, arrays["last_raw"]
        self._measured, self._switches, self._error_max = arrays["measured"], arrays["switches"], arrays["error_max"]
        self._lets_go = np.zeros(self.n, dtype=bool)
        """Axes that press no more when they have come to rest."""
        self._tick_s, self._makes_up, self._leaves_out = tick_s, makes_up, leaves_out
        self._again = False

    def plan_ahead(self, count: int = 32) -> int:
        """Plan up to ``count`` next commands (10 to 20 us each), in the slack between ticks.

        Returns:
            how many axes were looked at; 0 when there is nothing to do.
        """
        return self._sequencer.plan_ahead(count, self._last_ns)

    @property
    def stopped(self) -> NDArray[np.bool_]:
        """Which axes have been stopped since their last command began, (n,)."""
        return self._sequencer.stopped

    def is_on_its_way(self) -> bool:
        """Tell whether an axis whose set-point rests still moves, farther from there than the tolerance."""
        rests = np.flatnonzero(np.isin(self._sequencer.kind, (HOLD, SETTLING)))
        return bool(self._law.is_on_its_way(rests, self._desired[rests]).any())

    def stay(self, axes: Axes) -> None:
        """Have axes whose set-points rest hold where they are instead: nothing is brought back."""
        self._law.give_way(axes)
        self._sequencer.stay(axes, self._position[axes], self._last_ns)
        self._desired[axes], self._desired_velocity[axes] = self._position[axes], 0.0

    # -- what the bank asks for ---------------------------------------------------------------

    def _instant(self, now_ns: int) -> int:
        """Return now, or the instant of the last tick when the next is late already.

        A late tick stops what moves where it was last put out; a verb that comes before it must not let
        the set-points run on to now. Where late ticks are made up for, it must not let them run on past the first of
        these. A stop that steps have begun was at its own instant.
        """
        if not self._seen or self._braked_ns:
            return self._braked_ns or now_ns
        self._last_ns += self._leaves_out(now_ns)
        if now_ns - self._last_ns > self._late_ns:
            return self._last_ns
        return min(now_ns, self._last_ns + round(self._tick_s * 1e9)) if self._makes_up() else now_ns

    def _catch_up(self, now_ns: int) -> int:
        now_ns = self._instant(now_ns)
        if not self._braked_ns:  # where a stop is over at once, what waited behind it is still to be dropped
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

    def _begin_at_once(self, commands: Sequence[Command], now_ns: int, *, replace: bool) -> bool:
        return self._short_way.begin(commands, now_ns, replace=replace)

    def _drop(self, axes: Axes) -> None:
        self._sequencer.drop(axes)

    def _halt(self, axes: Axes, now_ns: int, *, fastest: bool) -> None:
        """Brake; in force mode the controlled stop holds, the fastest one lets go until reset(), when it has braked."""
        brakes, self._braked_ns = self._braked_ns > 0, 0
        left = self._law.force_ends.has_left(axes)  # also one that brakes since it has left force mode
        in_force = axes[(self._sequencer.kind[axes] == FORCE) | left] if fastest else axes[:0]
        self._homing.cancel(axes)
        self._sequencer.halt(axes, now_ns, brakes=brakes)
        if in_force.size:
            brakes_first = self._law.moves(in_force) & self._law.force_ends.is_bound(in_force)
            self._set_limp(in_force[~brakes_first])
            self._lets_go[in_force[brakes_first]] = True

    def _let_go(self, axes: Axes) -> None:
        self._set_limp(axes[~self.stepper[axes]])

    def _set_limp(self, axes: Axes) -> None:
        self._limp[axes], self._lets_go[axes] = True, False
        self._sequencer.settle(axes, self._last_ns)

    def _recover(self, axes: Axes, latched: Axes) -> None:
        lost = axes[self.stepper[axes] & ((latched & FOLLOWING_ERROR) != 0)]
        lost = lost[self._sequencer.kind[lost] == HOLD]
        if lost.size:
            for axis in lost.tolist():
                self._law.anchor_at(axis, float(self._position[axis]))
            self._sequencer.hold(lost, self._position[lost], self._last_ns)
        self._lets_go[axes] = False
        limp = axes[self._limp[axes]]
        if limp.size:
            self._limp[limp] = False
            moves = self._law.moves(limp)
            rests, moving = limp[~moves], limp[moves]
            self._sequencer.hold(rests, self._position[rests], self._last_ns)
            if moving.size:
                state = np.stack(self._law.actual(moving), axis=1)
                self._sequencer.brake(moving, state, self._last_ns, self._sequencer.hardest[moving])

    def _is_too_late(self, start_ns: int, now_ns: int) -> bool:
        return now_ns - start_ns > self._tick_s * 1e9

    def _release(self, axes: Axes, start_ns: int) -> None:
        self._sequencer.release(axes, start_ns)

    def _show(self, axes: Axes) -> None:
        self._sequencer.refresh(axes)

    def _settings_forgotten(self, axes: Axes) -> None:
        self._law.forget(axes)

    def _limits_changed(self, axes: Axes) -> None:
        held = self._queue.limits
        self._law.velocity_limit[axes] = held.velocity[axes]
        self._law.acceleration_limit[axes] = held.acceleration[axes]
        self._law.configure_force(axes, held.force[axes])

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
        self._sequencer.stop(np.array([axis]), now_ns, now_ns)

    def stands(self, axis: int) -> bool:
        """Tell whether an axis holds still."""
        return bool(self._sequencer.kind[axis] == HOLD)

    def measured(self, axis: int) -> float:
        """Return the measured position."""
        return float(self._position[axis])

    # -- the tick -----------------------------------------------------------------------------

    def believe(self) -> None:
        """Take the next readings as the first: nothing is known of how the axes came from the last to there."""
        self._again = True

    def tick(
        self,
        now_ns: int,
        position: NDArray[np.float64],
        switches: NDArray[np.int64] | None = None,
        seen_ns: int | None = None,
    ) -> NDArray[np.float64]:
        """Advance all axes to now and return what the actuators shall do.

        Args:
            now_ns: instant of the tick [ns].
            position: measured raw positions (n,).
            switches: bits SWITCH_MINUS, SWITCH_PLUS, SWITCH_HOME of each axis (n,), or None.
            seen_ns: instant at which the positions were measured [ns]; None: now. It may be that of the tick before:
                nothing has been measured since.

        Returns:
            (n,) force or torque of servos, raw output position of steppers (see ``stepper``). The
            array is reused by the next tick.
        """
        loop, first = self.loop, not self._seen
        self._braked_ns = 0
        last_ns = now_ns if first else self._last_ns
        self._last_ns = now_ns
        if now_ns - last_ns > self._late_ns:
            self._stop_late(last_ns, now_ns)
        self._measured[:] = position
        loop.seen_ns = now_ns if seen_ns is None else seen_ns
        loop.has_switches = switches is not None
        if switches is not None:
            self._switches[:] = switches
        found = axis_step.take(loop, now_ns)
        if found == axis_step.NOT_FINITE:
            self._refuse_measurement(now_ns)
            found = axis_step.take(loop, now_ns)
        if first:
            self._first_measurement(position, now_ns)
        elif self._again:
            self._begin_to_watch()
        elif found or loop.any_odd or loop.seen_ns >= loop.due_ns:
            self._look(now_ns)
        else:
            axis_step.looked_at(loop, now_ns)
        loop.last_ns = last_ns if not first else now_ns - round(self._tick_s * 1e9)
        axis_step.begin_tick(loop, now_ns)
        self._sequencer.pace.begin_tick(loop.dt)
        self._settle(now_ns)
        self._sequencer.release_held(now_ns)
        if self._queue.waits_for_markers:
            self._poll_markers(now_ns)
        self._sequencer.advance(now_ns)
        loop.any_guard = self._sequencer.any_guard
        self._command(axis_step.set_points(loop, now_ns), last_ns, now_ns)
        return self._actuator

    def is_quiet(self) -> bool:
        """Tell whether the next ticks may be steps, as long as that finds nothing.

        So it is where no command waits for a tick, no marker is waited for, no axis is homing or has left force mode.
        """
        sequencer, loop = self._sequencer, self.loop
        if (
            not self._seen or self._written or self._queue.waits_for_markers or self._homing.active
            or self._law.force_ends.any or sequencer.has_work or self.keeper is not None
        ):  # fmt: skip
            return False
        self.plans.braked_ns = self.plans.started = 0
        self.plans.follows = sequencer.is_plain and not self._law.any_braced
        loop.any_guard, loop.next_ns, loop.last_ns = sequencer.any_guard, sequencer.store.next_ns, self._last_ns
        return True

    def after_quiet(self) -> None:
        """Go on behind quiet ticks, if there were any, and behind a stop that steps have begun.

        The ``emergency_stop`` of all axes, or their ``stop``, follows at once.
        """
        if self._last_ns != self.loop.last_ns:
            self._last_ns = self.loop.last_ns
            self._sequencer.pace.begin_tick(self.loop.dt)
        if self.plans.untold:
            self.plans.untold = 0
            self._sequencer.tell_ends()
        if self.loop.next_ns != self._sequencer.store.next_ns:  # segments have ended
            self._sequencer.store.look_ahead()
        if self.plans.braked_ns and self._braked.any():
            self._braked_ns = self.plans.braked_ns
            self._sequencer.after_stop()

    def finish_tick(self, found: int) -> NDArray[np.float64]:
        """Finish a quiet tick that has found something, and return what ``tick`` would have."""
        loop = self.loop
        if found == axis_step.AT_LIMIT:
            self._command(axis_step.set_points(loop, loop.last_ns), loop.previous_ns, loop.last_ns)
        else:
            self._judge(found, loop.last_ns)
        return self._actuator

    def _command(self, found: int, last_ns: int, now_ns: int) -> None:
        """Let the laws follow the set-points of a tick."""
        loop = self.loop
        if found and self._guard.keep(self._desired, self._desired_velocity, last_ns, now_ns):
            loop.any_guard = self._sequencer.any_guard
            axis_step.set_points(loop, now_ns)
        axis_step.control(loop)
        if self._law.force_ends.any:
            self._yield()
        self._judge(axis_step.follow(loop), now_ns)

    def _stop_late(self, last_ns: int, now_ns: int) -> None:
        """Stop what moved, from the state of the last tick: a late tick never catches up."""
        sequencer = self._sequencer
        behind = self._law.is_behind(np.arange(self.n))
        moving = np.flatnonzero((sequencer.kind != HOLD) | (sequencer.store.cut_ns <= now_ns) | behind)
        if not moving.size:
            return
        after, most = (now_ns - last_ns) * 1e-6, self._late_ns * 1e-6
        text = f"the tick came {after:.1f} ms after the last; at most {most:g} ms"
        if self._makes_up():
            text = f"simulated time is {after:.0f} ms behind on this busy machine; at most {most:g} ms"
        self._homing.cancel(moving)
        sequencer.drop(moving)
        sequencer.stop(moving, last_ns, now_ns)
        self._queue.emit(EventKind.DROPPED, moving, now_ns, errno.ETIME, text)
        self._queue.latch_fault(moving, text, now_ns, errno.ETIME)
        sequencer.refresh(moving)

    def _look(self, now_ns: int) -> None:
        """Put axes in fault that move as nobody has told them."""
        for axis, text, lost, drifts in self._motion_watch.look(now_ns):
            if self._queue.latched[axis] & (LOST if lost else FAULT):
                if not drifts:  # it was held, which was no help
                    self.let_go([axis])
            elif lost:
                self.lose_place([axis], text, now_ns)
            else:
                self.fault([axis], text, now_ns, lets_go=not (drifts and self._law.tuned[axis]))

    def _first_measurement(self, told: NDArray[np.float64], now_ns: int) -> None:
        self._seen = True
        if self.keeper is not None:
            offset, homed = self.keeper.restored(told)
            self._offset[:] = offset
            np.add(self._raw, offset, out=self._position)
            self._queue.set_homed(np.flatnonzero(homed), True, now_ns)
        self._law.slewed[:] = self._position
        self._law.anchor[:] = self._offset
        self._begin_to_watch()
        self._sequencer.hold(np.arange(self.n), self._position, now_ns)

    def _begin_to_watch(self) -> None:
        self._again = False
        self._last_raw[:], self.loop.raw_ns = self._raw, self.loop.seen_ns - round(self._tick_s * 1e9)
        self._motion_watch.begin()

    def _refuse_measurement(self, now_ns: int) -> None:
        """Go on with what was read before where a reading is not a number."""
        bad = np.flatnonzero(~np.isfinite(self._measured))
        self.fault(bad, "the measured position is not a finite number", now_ns)
        self._measured[bad] = self._last_raw[bad]

    def _poll_markers(self, now_ns: int) -> None:
        released, broken = self._queue.poll_markers()
        if released:
            self._sequencer.release(np.array(released), now_ns)
            self._sequencer.refresh(np.array(released))
        for axis, number in broken:
            self._abandon(np.array([axis]), now_ns, errno.EPIPE, f"marker {number} was freed while waited for")

    def _yield(self) -> None:
        """Have the set-points come to the axes that would have to press harder than they were told to reach them.

        There they are held, after a force command that may carry something with that force. An axis that goes on in
        that direction, and that is braked by what resists it harder than by its ramp, is braked from there: a set-point
        that stands at once would be a stop at any deceleration.
        """
        law, sequencer = self._law, self._sequencer
        axes = law.force_ends.look(self._velocity, law.velocity_limit, self._last_ns)
        if axes.size:
            law.give_way(axes)
            goes_on = law.force_ends.goes_on(axes, self._velocity, law.velocity_limit)
            held, moving = axes[~goes_on], axes[goes_on]
            place = self._position[axes]
            if held.size:
                left = law.force_ends.has_left(axes) & ~goes_on
                place[left] += law.hold_load(axes[left])
                sequencer.hold(held, place[~goes_on], self._last_ns)
            if moving.size:
                place[goes_on] += law.relieve(moving, np.zeros(moving.size))  # its damping shall not come at once
                state = np.stack((place[goes_on], self._velocity[moving]), axis=1)
                sequencer.brake(moving, state, self._last_ns, sequencer.hardest[moving])
            self._desired[axes], self._desired_velocity[axes] = place, np.where(goes_on, self._velocity[axes], 0.0)
        turned, part = law.force_ends.turned(
            self._velocity, law.velocity_limit, law.drive(self._desired), self._last_ns
        )
        if turned.size:
            place = self._position[turned] + law.relieve(turned, part)
            rests = sequencer.kind[turned] == HOLD
            if rests.any():
                sequencer.hold(turned[rests], place[rests], self._last_ns)
            if not rests.all():
                moving = turned[~rests]
                state = np.stack((place[~rests], self._velocity[moving]), axis=1)
                sequencer.brake(moving, state, self._last_ns, sequencer.hardest[moving])
            self._desired[turned] = place
        letting_go = np.flatnonzero(self._lets_go)
        if letting_go.size:
            self._set_limp(letting_go[~law.force_ends.is_bound(letting_go)])

    # -- watching -----------------------------------------------------------------------------

    def _judge(self, found: int, now_ns: int) -> None:
        """Following errors and switches, and what they cause; then what is shown."""
        loop = self.loop
        if found & axis_step.FOLLOWS_BADLY:
            self._lose(np.flatnonzero((np.abs(self._following) > self._error_max) & ~self._limp), now_ns)
        if found & axis_step.SETTLED:
            settled = self._law.settled & (self._sequencer.kind == SETTLING)
            self._sequencer.settled(np.flatnonzero(settled), now_ns)
        if found & axis_step.ON_SWITCH:
            self._keep_switches(self._switches, now_ns)
        if self._homing.active:
            for axis, reason in self._homing.tick(self._switches if loop.has_switches else None, now_ns):
                self.fault([axis], reason, now_ns)
            self._sequencer.refresh(np.arange(self.n))
        axis_step.show(loop)
        if self.keeper is not None:
            self._keep(self.keeper, now_ns)

    def _lose(self, axes: Axes, now_ns: int) -> None:
        """Fault axes whose following error is too great; a stepper that does so has stalled.

        One that gains of a command had lag behind is braked and held by its own.
        """
        bits, tuned = int(AxisStatus.FOLLOWING_ERROR), self._law.tuned.copy()
        fresh = (self._queue.latched[axes] & bits) == 0
        self.let_go(axes[~fresh])  # they were held, which was no help
        for axis in axes[fresh].tolist():
            self._queue.latched[axis] |= bits | (int(AxisStatus.STALLED) if self.stepper[axis] else 0)
            unit = self.settings[axis].unit
            text = f"following error {self._following[axis]:g} {unit}; at most {self._error_max[axis]:g} {unit}"
            self.fault([axis], text, now_ns, lets_go=not tuned[axis])
            if self._limp[axis]:
                self._actuator[axis] = self._force[axis] = self._law.output[axis] = 0.0

    def _keep_switches(self, switches: NDArray[np.int64], now_ns: int) -> None:
        """Stop axes that run onto an end switch; leaving it is free."""
        error, kind = self._law.arrays["error"], self._sequencer.kind
        v = np.where(np.abs(error) > self._law.arrays["tolerance"], error, self._desired_velocity)
        hit = ((switches & SWITCH_MINUS) != 0) & (v < 0) | ((switches & SWITCH_PLUS) != 0) & (v > 0)
        hit &= (kind != STOP) & (kind != HOLD) & ((self._queue.latched & HOMING) == 0)
        if hit.any():
            self._abandon(np.flatnonzero(hit), now_ns, errno.ERANGE, "stopped by an end switch")

    def _keep(self, keeper: Keeper, now_ns: int) -> None:
        """Note where the axes are; before the actuators hear of a motion."""
        latched = self._queue.latched
        at_rest = (self._sequencer.kind == HOLD) & ~self._limp & ((latched & (HOMING | LOST)) == 0)
        keeper.note(at_rest, (latched & HOMED) != 0, self._raw, self._position, now_ns)
