"""The motion watch: what an axis does, compared with what it was told and with what it can do.

Drives that close their own loop plan by themselves, so a value left in the drive, another master, a lost reference or
a defective board moves an axis while everything reads well. Looked at is the raw position, which calibration does not
change. Found are

* *too fast*: the distance covered beyond ``1 + speed_margin`` times velocity_max adds up to JITTER_S at that speed, in
  two looks running, and the drive reports such a speed. A sum does not mind when looks come unevenly, and neither the
  noise of a differentiated encoder nor a short overshoot adds up.
* *uncommanded*: an axis that is to hold is farther than ``tolerance`` from where it came to rest.
* *away*: a move to a place gets farther from it (a velocity runs the other way) than braking from the speed at its
  start needs.
* *lost*: the position is where the axis cannot have come since the last look. Its place is then no longer known.

What is seen once is not believed, for one damaged reading must stop nothing; two looks make a finding: 20 to 40 ms at
50 to 100 Hz. Why so: docs/decisions/0094-motion-watch.md.

Pure; concurrency: that of its bank.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from enum import Enum, auto
from typing import NamedTuple

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from . import modes
from .commands import Command
from .settings import AxisSettings

JITTER_S = 0.01
"""Time at velocity_max that a speed may be exceeded by in all, and that an axis may be pushed by where no tolerance is
given [s].
"""
LATE_S = 0.05
"""How much later than the reading its time stamp may be: a reply that was asked for twice [s]."""
LATEST_S = 0.5
"""Likewise, of what was read so long after it was asked for: a machine that is busier loses the link [s]."""
PROMPT_NS = 20_000_000
"""So soon after it was asked for a reading is not late; nor as soon as the soonest."""
GAP_NS = 200_000_000
"""Looks farther apart are a lost link: whether the axis was held meanwhile is not known."""
SETTLE_NS = 500_000_000
"""An axis settles after a command, and a drive may set its counter to zero some time after its homing."""
SETTLING = 0.25
"""Part of the way by which the place to be held follows an axis that settles, at each look."""
OVERSHOOT = 0.05
"""Part of a move by which a drive may pass its target and come back."""
LONGEST_BRAKE_S = 10.0
"""However fast an axis is found, it is not given longer to brake [s]."""
MOST_BEFORE = 15
"""Orders without a look between them that are remembered."""
STILL = 0.25
"""A step that is followed by one at less than this part of its speed was a jump of the reading, not a motion."""


class Order(Enum):
    """What the drive was told."""

    HOLD = auto()
    STOP = auto()
    POINT = auto()
    """Go to ``goal``."""
    RUN = auto()
    """Run at the velocity ``goal``."""
    FORCE = auto()
    FREE = auto()
    """Homing by itself: it goes where it likes and sets its counter."""


class Finding(NamedTuple):
    """What an axis does that it must not.

    Args:
        axis: bank axis.
        text: what, with numbers and units.
        lost: its place is no longer known.
        drifts: it moves though nothing is commanded, no faster than it may.
    """

    axis: int
    text: str
    lost: bool
    drifts: bool = False


class _State(Struct):
    order: Order = Order.HOLD
    goal: float = 0.0
    before: tuple[tuple[Order, float], ...] = ()
    """What it was told before that since the last look: it may have heard all or nothing of it."""
    has_begun: bool = False
    best: float = 0.0
    """POINT: least distance so far; RUN: farthest place in its direction."""
    allowed: float = 0.0
    """How far it may go back from there."""
    reference: float = 0.0
    """HOLD: where it came to rest, since ``since_ns``."""
    since_ns: int = 0
    place: float = 0.0
    velocity: float = 0.0
    rests_ns: int = 0
    """Until then an axis that was found moving may brake: the driver before this one was killed in motion."""
    held: bool = True
    """The drive held its axis at the last look."""
    stamp_ns: int = 0
    """The last look that was believed."""
    doubted: float = 0.0
    doubted_ns: int = 0
    doubted_late_s: float = 0.0
    doubts: int = 0
    excess: float = 0.0
    fast: int = 0
    aways: int = 0
    free_until_ns: int = 0
    soonest_ns: int = PROMPT_NS
    """Least time from asking to reading: what one takes longer may have passed after it was taken."""
    late_s: float = 0.0
    """By how much the last reading that was believed may be older than its stamp."""
    late_before_s: float = 0.0
    """Likewise, of the one from which ``excess`` counts."""


class MotionWatch:
    """Watches the axes of a bank.

    Args:
        settings: of the axes.
        velocity: velocity limits in force (n,), the bank's own array [unit/s].
        acceleration: likewise [unit/s^2].
    """

    def __init__(
        self,
        settings: Sequence[AxisSettings],
        velocity: NDArray[np.float64],
        acceleration: NDArray[np.float64],
    ) -> None:
        self._settings = tuple(settings)
        self._velocity, self._acceleration = velocity, acceleration
        self._states = [_State() for _ in settings]

    # --- what the axes are told -------------------------------------------------------------------

    def order(self, axis: int, order: Order, goal: float = 0.0) -> None:
        """Note what an axis is about to be told.

        Args:
            axis: bank axis.
            order: what.
            goal: raw target of POINT [unit], velocity of RUN [unit/s].
        """
        state = self._states[axis]
        if order is Order.HOLD and state.order is not Order.HOLD:
            state.reference, state.since_ns = state.place, state.stamp_ns
        if order is Order.HOLD:
            state.before = ()
        elif state.order is not Order.HOLD:
            state.before = (*state.before[-MOST_BEFORE:], (state.order, state.goal))
        state.order, state.goal, state.has_begun, state.aways = order, goal, False, 0

    def forget(self, axis: int) -> None:
        """Believe the next reading, whatever it says: the place was lost, and that has been told."""
        self._states[axis].stamp_ns = 0

    # --- what they do -----------------------------------------------------------------------------

    def look(
        self,
        axis: int,
        now_ns: int,
        place: float,
        velocity: float,
        *,
        moving: bool = False,
        confirmed: bool = True,
        holds: bool = True,
        latched: bool = False,
        late_ns: int = 0,
    ) -> Finding | None:
        """Judge a reading.

        Args:
            axis: bank axis.
            now_ns: time of the reading [ns].
            place: raw position [unit].
            velocity: as the drive reports it [unit/s].
            moving: the drive says that it moves.
            confirmed: the drive has confirmed what it was told last.
            holds: the drive is switched on and holds its axis when nothing is commanded.
            latched: a fault or an emergency stop is latched; the drive may have let go, and is told to stop anyway.
            late_ns: how long ago the drive was asked: a process that had to wait for the machine reads late [ns].
        """
        state = self._states[axis]
        state.soonest_ns = min(state.soonest_ns, late_ns)
        late_s = min((late_ns - state.soonest_ns) / 1e9, LATEST_S)
        if state.order is Order.FREE:
            state.free_until_ns = now_ns + SETTLE_NS
        if not state.stamp_ns or now_ns < state.free_until_ns:
            state.held = holds
            self._rest_at(state, now_ns, place, velocity)
            state.late_s = late_s
            brakes_s = 2 * abs(velocity) / float(self._acceleration[axis]) if moving else 0.0
            state.rests_ns = now_ns + int(min(brakes_s, LONGEST_BRAKE_S) * 1e9) + SETTLE_NS * moving
            return None
        if not moving:
            state.rests_ns = min(state.rests_ns, now_ns)
        gap_ns = now_ns - state.stamp_ns
        watched = holds and state.held and (not latched or gap_ns > GAP_NS)
        watched = watched and self._settings[axis].watch.uncommanded and now_ns >= state.rests_ns
        low, high = self._reach(axis, state, gap_ns, confirmed, watched)
        if not low <= place <= high:
            return self._doubt(axis, state, now_ns, place, velocity, watched, late_s)
        state.doubts = 0
        fast = self._is_too_fast(axis, state, now_ns, place, velocity)
        away = self._is_away(axis, state, place, velocity, confirmed)
        self._believe(state, now_ns, place, velocity)
        state.held, state.late_s = holds, late_s
        if confirmed:
            state.before = ()
        if not watched:
            state.reference = place
        elif state.order is Order.HOLD and 0 < now_ns - state.since_ns <= SETTLE_NS:
            state.reference += SETTLING * (place - state.reference)
        if fast:
            return Finding(axis, self._fast_text(axis, velocity), lost=False)
        return Finding(axis, self._away_text(axis, state, velocity), lost=False) if away else None

    def _believe(self, state: _State, now_ns: int, place: float, velocity: float) -> None:
        state.place, state.velocity, state.stamp_ns, state.doubts = place, velocity, now_ns, 0

    def _rest_at(self, state: _State, now_ns: int, place: float, velocity: float) -> None:
        self._believe(state, now_ns, place, velocity)
        state.reference, state.since_ns = place, now_ns

    def _tolerance(self, axis: int) -> float:
        return tolerance_of(self._settings[axis])

    def _fastest(self, axis: int) -> float:
        return (1 + self._settings[axis].watch.speed_margin) * float(self._velocity[axis])

    def _braking(self, axis: int, velocity: float) -> float:
        """Return how far an axis may run on: twice what it brakes in, and the way of the order over the line."""
        return velocity * velocity / float(self._acceleration[axis]) + 2 * LATE_S * abs(velocity)

    def _reach(self, axis: int, state: _State, gap_ns: int, confirmed: bool, watched: bool) -> tuple[float, float]:
        """Return where the axis can have come since the last look."""
        slack, place = self._tolerance(axis), state.place
        if state.order is Order.HOLD and watched:
            return state.reference - slack, state.reference + slack
        way = self._fastest(axis) * (gap_ns / 1e9 + max(LATE_S, state.late_s))
        if gap_ns <= GAP_NS or not confirmed or state.order in (Order.HOLD, Order.FORCE):
            return place - way - slack, place + way + slack
        reached = [place, place + math.copysign(self._braking(axis, state.velocity), state.velocity)]
        for order, goal in (*state.before, (state.order, state.goal)):
            if order is Order.POINT:
                reached.append(goal)
            elif order is Order.FORCE:
                reached += [place - way, place + way]
            else:
                ahead = goal if order is Order.RUN else state.velocity
                reached.append(place + way * ((ahead > 0) - (ahead < 0)))
        return min(reached) - slack, max(reached) + slack

    def _doubt(
        self,
        axis: int,
        state: _State,
        now_ns: int,
        place: float,
        velocity: float,
        watched: bool,
        late_s: float,
    ) -> Finding | None:
        """Look a second time at what cannot be, and say what it is."""
        state.doubts += 1
        if state.doubts == 1:
            state.doubted, state.doubted_ns, state.doubted_late_s = place, now_ns, late_s
            return None
        first, second = abs(state.doubted - state.place), abs(place - state.doubted)
        between_s = (now_ns - state.doubted_ns) / 1e9
        gap = state.doubted_ns - state.stamp_ns > GAP_NS
        before, reference = state.place, state.reference
        held = state.order is Order.HOLD and watched
        if held:
            first_s = (state.doubted_ns - state.stamp_ns) / 1e9
            stands = second * first_s <= STILL * first * between_s  # looks may come unevenly
            jumped = gap or (first > self._tolerance(axis) and stands)
        else:
            jumped = gap or second <= self._fastest(axis) * (between_s + max(LATE_S, state.doubted_late_s))
        self._rest_at(state, now_ns, place, velocity)
        state.late_s = late_s
        if jumped:
            within_s = (now_ns - state.doubted_ns) / 1e9 if not gap else None
            return Finding(axis, lost_text(self._settings[axis], before, place, within_s), lost=True)
        if held:
            return Finding(axis, uncommanded_text(self._settings[axis], reference, place, velocity), lost=False)
        return Finding(axis, self._fast_text(axis, velocity), lost=False)

    def _is_too_fast(self, axis: int, state: _State, now_ns: int, place: float, velocity: float) -> bool:
        fastest = self._fastest(axis)
        beyond = abs(place - state.place) - fastest * (now_ns - state.stamp_ns) / 1e9
        if not state.excess:
            state.late_before_s = state.late_s
        state.excess = max(0.0, state.excess + beyond)
        state.fast = state.fast + 1 if beyond > 0 else 0
        return state.fast > 1 and state.excess > (JITTER_S + state.late_before_s) * fastest and abs(velocity) > fastest

    def _is_away(self, axis: int, state: _State, place: float, velocity: float, confirmed: bool) -> bool:
        if state.order is Order.POINT:
            left, ahead = abs(state.goal - place), state.goal - place
        elif state.order is Order.RUN and state.goal:
            left, ahead = -math.copysign(1.0, state.goal) * place, state.goal
        else:
            return False
        if not state.has_begun or not confirmed:
            state.has_begun, state.best = confirmed, left
            state.allowed = self._tolerance(axis)
            braking = self._braking(axis, velocity)
            if velocity * ahead < 0:
                state.allowed += braking
            elif state.order is Order.POINT:  # it may be too near to brake before it
                state.allowed += OVERSHOOT * left + max(0.0, braking - left)
            return False
        state.best = min(state.best, left)
        state.aways = state.aways + 1 if left > state.best + state.allowed else 0
        return state.aways > 1

    def _fast_text(self, axis: int, velocity: float) -> str:
        return fast_text(self._settings[axis], velocity, float(self._velocity[axis]))

    def _away_text(self, axis: int, state: _State, velocity: float) -> str:
        if state.order is not Order.POINT:
            return away_text(self._settings[axis], velocity, state.goal)
        name, unit = self._settings[axis].name, self._settings[axis].unit
        return (
            f"axis {name} moves away from its target {state.goal:.6g} {unit}: at {state.place:.6g} {unit}, "
            f"{velocity:.3g} {unit}/s"
        )


# --- what is the same for axes whose loop the host closes --------------------------------------------


def order_of(command: Command) -> tuple[Order, float]:
    """Return what a command is to the watch, and its goal."""
    mode = command.control_mode
    if mode & modes.POSITION:
        return Order.POINT, command.position
    return (Order.RUN, command.velocity) if mode & modes.VELOCITY else (Order.FORCE, 0.0)


def tolerance_of(axis: AxisSettings) -> float:
    """Return how far an axis that is to hold may be pushed [unit]."""
    given = axis.watch.tolerance
    return JITTER_S * axis.velocity_max if given is None else given


def fast_text(axis: AxisSettings, velocity: float, most: float) -> str:
    """Say that an axis is too fast; velocities in unit/s."""
    return f"axis {axis.name} moves at {velocity:.4g} {axis.unit}/s; velocity_max is {most:.4g} {axis.unit}/s"


def away_text(axis: AxisSettings, velocity: float, commanded: float) -> str:
    """Say that an axis runs the other way; velocities in unit/s."""
    return f"axis {axis.name} runs at {velocity:.3g} {axis.unit}/s; {commanded:.3g} {axis.unit}/s were commanded"


def uncommanded_text(axis: AxisSettings, reference: float, place: float, velocity: float) -> str:
    """Say that an axis does not hold; places in unit, velocity in unit/s."""
    unit, most = axis.unit, tolerance_of(axis)
    text = f"axis {axis.name} moves though nothing was commanded: from {reference:.6g} to {place:.6g} {unit}"
    return f"{text} at {velocity:.3g} {unit}/s; at most {most:.3g} {unit} is allowed"


def lost_text(axis: AxisSettings, before: float, place: float, within_s: float | None) -> str:
    """Say that an axis is where it cannot be; places in unit, the time None after a gap in the readings [s]."""
    text = f"position lost: axis {axis.name} read {before:.6g} {axis.unit} and reads {place:.6g} {axis.unit}"
    how = "after a gap in its readings" if within_s is None else f"within {within_s:.3g} s"
    return f"{text} {how}, where it cannot have gone by itself"
