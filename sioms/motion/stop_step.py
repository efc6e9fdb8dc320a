"""The beginning of an emergency stop of axes whose loop the host closes, without what follows from it.

``Sequencer.halt`` does the same for axes in any state; here are those states in which no decision is left. Axes are
latched with their brakes, so no reading shows one without the other. What is dropped and told is the bank's, which does
that later as if it had done so at the instant of the stop.
"""

from __future__ import annotations

import math

from sioms.native.language import step
from sioms.native.numbers import whole
from sioms.protocol.flags import AxisStatus

from .axis_step import FORCE, HOLD, REST, STOP, Loop
from .plan_step import PIECE, Plans, look_at_plan
from .profile import MAX_SEGMENTS
from .store import NEVER_NS, UNCUT_NS


@step
def is_behind(a: Loop, i: int) -> int:
    """Return whether an axis cannot follow, as ``ControlLaw.is_behind`` does."""
    error = a.error[i]
    if not abs(error) > a.tolerance[i] or a.kind[i] == FORCE:
        return 0
    gain = a.k[i] * (1.0 + a.kz[i])
    if not a.saturated[i]:
        if a.stepper[i] or not gain > 0.0:
            return 0
        most = a.force_limit[i] * (1.0 + abs(a.kp[i])) + abs(a.kb[i] * a.velocity[i])
        if not abs(error) > most / gain:
            return 0
    velocity = a.output[i] if a.stepper[i] else a.velocity[i]
    return error * velocity >= 0.0 or not abs(velocity) > REST * a.velocity_limit[i]


@step
def stop_axes(s: Plans, now_ns: int, latches: int) -> int:
    """Begin to stop all axes at now, or where the present segment of one has begun since; latched or not. Returns 1,
    and nothing is done, where that is for the bank.
    """
    a = s.loop
    for i in range(a.n):
        if a.kind[i] != HOLD and a.kind[i] != STOP:
            now_ns = max(now_ns, a.segment_ns[i])
    if now_ns >= a.next_ns:
        return 1
    for i in range(a.n):
        if a.kind[i] == FORCE or a.tuned[i] or s.cut_ns[i] != UNCUT_NS or is_behind(a, i):
            return 1
    for i in range(a.n):
        s.fresh[i] = not a.latched[i] & AxisStatus.EMERGENCY_STOP
        if s.fresh[i]:
            stop_axis(s, i, now_ns, latches)
    s.braked_ns = now_ns
    return 0


@step
def stop_axis(s: Plans, i: int, now_ns: int, latches: int) -> int:
    """Let an axis brake if it moves; latch its stop or not."""
    a = s.loop
    if latches:
        a.latched[i] = a.latched[i] | AxisStatus.EMERGENCY_STOP
        a.event_status[i] = a.event_status[i] | AxisStatus.EMERGENCY_STOP
    if a.kind[i] != HOLD and a.kind[i] != STOP:
        brake(s, i, now_ns)
        a.event_status[i] = a.event_status[i] | AxisStatus.MOVING | AxisStatus.STOPPING
    return 0


@step
def brake(s: Plans, i: int, now_ns: int) -> int:
    """Let an axis stop at maximum deceleration from its set-point at now."""
    a = s.loop
    n = a.n
    look_at_plan(s, i, now_ns)
    position = s.state[0]
    velocity = s.state[1]
    row = s.row[i]
    duration = abs(velocity) / a.deceleration[i]
    final = position + 0.5 * velocity * duration
    for j in range(PIECE):
        a.present[j * n + i] = 0.0
    a.present[i] = position
    a.present[n + i] = velocity
    a.present[2 * n + i] = -0.5 * math.copysign(a.deceleration[i], velocity)
    for j in range(PIECE):
        s.coefficients[row * MAX_SEGMENTS * PIECE + j] = a.present[j * n + i]
    s.ends[row * MAX_SEGMENTS] = duration
    s.count[row] = 1
    s.duration[row] = duration
    s.final[3 * row] = final
    s.final[3 * row + 1] = 0.0
    s.final[3 * row + 2] = 0.0
    s.row_taken[row] = False
    s.row_signals[row] = False
    s.row_checked[row] = False
    s.row_kind[row] = STOP
    a.kind[i] = STOP
    a.guard[i] = False
    s.stopped[i] = True
    s.start_ns[i] = now_ns
    s.start_fraction[i] = 0.0
    s.segment[i] = 0
    a.segment_ns[i] = now_ns
    s.end_ns[i] = now_ns + int(-whole(-duration * 1e9))
    a.next_ns = min(a.next_ns, s.end_ns[i])
    return 0


@step
def rest_stopped(s: Plans, now_ns: int) -> int:
    """Let axes rest whose stops are over, until the bank ends their plans. Returns 1 where one does something else."""
    a = s.loop
    if now_ns < a.next_ns:
        return 0
    next_ns = NEVER_NS
    for i in range(a.n):
        if s.end_ns[i] > now_ns:
            next_ns = min(next_ns, s.end_ns[i])
        elif a.kind[i] != STOP:
            return 1
        else:
            for j in range(PIECE):
                a.present[j * a.n + i] = 0.0
            a.present[i] = s.final[3 * s.row[i]]
            a.segment_ns[i] = s.end_ns[i]
    a.next_ns = next_ns
    return 0
