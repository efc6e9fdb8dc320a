"""What becomes of plans where nothing is decided: the segments that follow, ends behind which nothing waits, and
commands that are planned and begin where the one before ends.

``Sequencer.advance`` does the same with all plans, ``Sequencer.settled`` with axes that come to rest behind their
set-points. What is told of it is the bank's, which does that later, with the instants that are noted here.
"""

from __future__ import annotations

import math
from typing import Final

from sioms.native.language import Flags, Floats, Integers, Record, step
from sioms.native.numbers import whole
from sioms.protocol.flags import AxisStatus

from .axis_step import FORCE, HOLD, POSITION, REST, SETTLING, Loop
from .pace import PIECES
from .profile import MAX_SEGMENTS
from .store import NEVER_NS, UNCUT_NS

PIECE: Final = 6
"""Coefficients of a segment."""
STILL: Final = 1e-9
"""Speed below which a set-point is at rest [unit/s]."""


class Plans(Record):
    """The plans of n axes; arrays (n,) or, of rows, (2 n,), see store.py and sequencer.py.

    ``braked_ns``: when they began to stop [ns], 0: they have not; ``fresh`` axes had not been stopped before.

    ``awaited``: somebody waits for the end of a motion, which is the bank's then. Else steps note when the command of
    an axis has ended, ``ended_ns``, and when it came to rest, ``idle_ns``, by the ticks in which that was found [ns];
    0: it has not. ``untold``: how much of it the bank has yet to tell. ``state``: (3,) in which a command, or a stop,
    begins.

    ``follows``: steps may begin commands that are ``ready``, planned in the other row of their axis, and ``started`` of
    them they have, at ``started_ns`` [ns], 0: none on this axis. ``tick_s``: nominal period [s].
    """

    loop: Loop
    row: Integers
    start_ns: Integers
    start_fraction: Floats
    segment: Integers
    end_ns: Integers
    cut_ns: Integers
    count: Integers
    duration: Floats
    final: Floats
    ends: Floats
    coefficients: Floats
    row_kind: Integers
    row_signals: Flags
    row_checked: Flags
    row_taken: Flags
    stopped: Flags
    fresh: Flags
    braked_ns: int
    outcome: Integers
    in_motion: Integers
    awaited: int
    ended_ns: Integers
    idle_ns: Integers
    untold: int
    follows: int
    ready: Flags
    gated_synch: Flags
    gated_marker: Flags
    row_guard: Flags
    row_sets: Flags
    started_ns: Integers
    started: int
    tick_s: float
    state: Floats


@step
def may_go_on(s: Plans, now_ns: int) -> int:
    """Return whether all that ends by now is a segment with another behind it, a plan with nothing behind it, or one
    with another that is planned.
    """
    a = s.loop
    if now_ns < a.next_ns:
        return 1
    for i in range(a.n):
        if s.end_ns[i] <= now_ns and plan_ends(s, i, now_ns) and not (may_end(s, i) or may_follow(s, i, now_ns)):
            return 0
    return 1


@step
def may_follow(s: Plans, i: int, now_ns: int) -> int:
    """Return whether nothing is left to decide when the command that waits on an axis begins where its plan ends: it is
    planned, free to begin, not short, goes on until now at least, and puts nothing else in force.
    """
    a = s.loop
    row = s.row[i]
    other = row ^ 1
    if not s.follows or not s.ready[i] or not a.has_head[i] or s.gated_synch[i] or s.gated_marker[i]:
        return 0
    if s.awaited or s.ended_ns[i] or s.idle_ns[i] or s.started_ns[i] or s.cut_ns[i] != UNCUT_NS:
        return 0
    if a.kind[i] < POSITION or a.kind[i] >= FORCE or s.row_signals[row] or s.row_checked[row]:
        return 0
    if s.row_kind[other] == FORCE or s.row_guard[other] or s.row_sets[other] or s.duration[row] * PIECES < s.tick_s:
        return 0
    return (s.duration[row] + s.duration[other]) * 1e9 > now_ns - s.start_ns[i] + 1


@step
def may_end(s: Plans, i: int) -> int:
    """Return whether nothing is left to decide when the plan of an axis ends: it leads to rest, and that is all."""
    a = s.loop
    row = s.row[i]
    if s.cut_ns[i] != UNCUT_NS or a.kind[i] == FORCE or s.row_signals[row] or s.row_checked[row]:
        return 0
    return not s.ended_ns[i] and may_rest(s, i) and abs(s.final[3 * row + 1]) <= STILL


@step
def may_rest(s: Plans, i: int) -> int:
    """Return whether an axis may come to rest without the bank: nobody and nothing waits for that."""
    a = s.loop
    if s.awaited or s.idle_ns[i]:
        return 0
    return not (a.has_head[i] or a.waiting[i] or a.latched[i] & AxisStatus.HOMING)


@step
def go_on(s: Plans, now_ns: int) -> int:
    """Begin what follows what ends by now, see ``may_go_on``; after the readings have been taken."""
    a = s.loop
    if now_ns < a.next_ns:
        return 0
    next_ns = NEVER_NS
    for i in range(a.n):
        while s.end_ns[i] <= now_ns:
            if s.segment[i] + 1 < s.count[s.row[i]]:
                a.segment_ns[i] = s.end_ns[i]
                s.segment[i] += 1
                load(s, i)
            elif may_follow(s, i, now_ns):
                begin_next(s, i, now_ns)
            else:
                end_plan(s, i, now_ns)
        next_ns = min(next_ns, s.end_ns[i])
    a.next_ns = next_ns
    return 0


@step
def end_plan(s: Plans, i: int, now_ns: int) -> int:
    """End the plan of an axis, which rests then, or settles."""
    a = s.loop
    row = s.row[i]
    if a.kind[i] >= POSITION and a.kind[i] < FORCE:
        s.ended_ns[i] = now_ns
    pass_over(s, i)
    s.segment[i] = 0
    a.segment_ns[i] = s.start_ns[i]
    position = s.final[3 * row]
    put_hold(s, row, position)
    load(s, i)
    error = a.error[i] if a.stepper[i] else position - a.position[i]
    velocity = a.output[i] if a.stepper[i] else a.velocity[i]
    if (abs(error) > a.tolerance[i] or a.limp[i]) and abs(velocity) > REST * a.velocity_limit[i]:
        a.moved_ns[i] = now_ns
        become(s, i, SETTLING)
    else:
        s.idle_ns[i] = now_ns
        become(s, i, HOLD)
    return 0


@step
def pass_over(s: Plans, i: int) -> int:
    """Put the begin of the plan of an axis to where it ends."""
    total = s.start_fraction[i] + s.duration[s.row[i]] * 1e9
    s.start_ns[i] += int(whole(total))
    s.start_fraction[i] = total - whole(total)
    return 0


@step
def begin_next(s: Plans, i: int, now_ns: int) -> int:
    """Begin the command that waits on an axis where its plan ends."""
    a = s.loop
    s.ended_ns[i] = now_ns
    s.started_ns[i] = now_ns
    pass_over(s, i)
    begin_other(s, i)
    a.guard[i] = False
    a.has_head[i] = False
    s.ready[i] = False
    s.started += 1
    s.untold += 1
    return 0


@step
def begin_other(s: Plans, i: int) -> int:
    """Let the plan in the other row of an axis begin, at its ``start_ns``, and show that it moves."""
    a = s.loop
    row = s.row[i] ^ 1
    s.row[i] = row
    s.segment[i] = 0
    a.segment_ns[i] = s.start_ns[i]
    load(s, i)
    a.kind[i] = s.row_kind[row]
    s.outcome[i] = 0
    s.stopped[i] = False
    a.event_status[i] = a.latched[i] | AxisStatus.MOVING
    s.in_motion[i] = True
    return 0


@step
def look_at_plan(s: Plans, i: int, now_ns: int) -> int:
    """Set ``state`` to that of the set-point of an axis at now."""
    a = s.loop
    n = a.n
    t = (now_ns - a.segment_ns[i]) * 1e-9
    c1 = a.present[n + i]
    c2 = a.present[2 * n + i]
    c3 = a.present[3 * n + i]
    c4 = a.present[4 * n + i]
    c5 = a.present[5 * n + i]
    s.state[0] = a.present[i] + t * (c1 + t * (c2 + t * (c3 + t * (c4 + t * c5))))
    s.state[1] = c1 + t * (2 * c2 + t * (3 * c3 + t * (4 * c4 + t * 5 * c5)))
    s.state[2] = 2 * c2 + t * (6 * c3 + t * (12 * c4 + t * 20 * c5))
    return 0


@step
def put_hold(s: Plans, row: int, position: float) -> int:
    """Write 'rest at position until something comes' into a row."""
    for j in range(PIECE):
        s.coefficients[row * MAX_SEGMENTS * PIECE + j] = 0.0
    s.coefficients[row * MAX_SEGMENTS * PIECE] = position
    s.ends[row * MAX_SEGMENTS] = math.inf
    s.count[row] = 1
    s.duration[row] = math.inf
    s.final[3 * row] = position
    s.final[3 * row + 1] = 0.0
    s.final[3 * row + 2] = 0.0
    return 0


@step
def become(s: Plans, i: int, kind: int) -> int:
    """Note that an axis holds or settles, and show it."""
    a = s.loop
    row = s.row[i]
    a.kind[i] = kind
    a.guard[i] = False
    s.row_kind[row] = kind
    s.row_signals[row] = False
    s.row_checked[row] = False
    moves = kind != HOLD
    a.event_status[i] = a.latched[i] | s.outcome[i] | moves * AxisStatus.MOVING
    s.in_motion[i] = moves
    s.untold += 1
    return 0


@step
def come_to_rest(s: Plans, now_ns: int) -> int:
    """Let the axes rest that have settled in this tick. Returns 1, and nothing is done, where that is for the bank."""
    a = s.loop
    for i in range(a.n):
        if a.kind[i] == SETTLING and a.settled[i] and not may_rest(s, i):
            return 1
    for i in range(a.n):
        if a.kind[i] == SETTLING and a.settled[i]:
            s.idle_ns[i] = now_ns
            become(s, i, HOLD)
    return 0


@step
def all_idle(s: Plans) -> int:
    """Return whether all axes hold still and have no commands; none is homing."""
    a = s.loop
    for i in range(a.n):
        if a.kind[i] != HOLD or a.has_head[i] or a.waiting[i]:
            return 0
    return 1


@step
def plan_ends(s: Plans, i: int, now_ns: int) -> int:
    """Return whether the plan of an axis ends by now, of its own or because it is cut."""
    row = s.row[i]
    last = s.count[row] - 1
    return s.cut_ns[i] <= now_ns or segment_end(s, i, row * MAX_SEGMENTS + last) <= now_ns


@step
def segment_end(s: Plans, i: int, place: int) -> int:
    """Return the instant at which a segment ends, as ``PlanStore`` rounds it."""
    end = s.ends[place] * 1e9 + s.start_fraction[i]
    if end >= NEVER_NS:
        return NEVER_NS
    return min(s.start_ns[i] + int(-whole(-end)), NEVER_NS)


@step
def load(s: Plans, i: int) -> int:
    """Take the coefficients and the end of the present segment of an axis."""
    a = s.loop
    place = s.row[i] * MAX_SEGMENTS + s.segment[i]
    for j in range(PIECE):
        a.present[j * a.n + i] = s.coefficients[place * PIECE + j]
    s.end_ns[i] = min(segment_end(s, i, place), s.cut_ns[i])
    return 0
