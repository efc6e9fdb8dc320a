"""The beginning of a command on an axis for which nothing else waits: nothing is left to decide, and it begins at once.

``Sequencer`` does the same for any number of axes in any state, with arrays. The profile between the two steps here is
that of a library.
"""

from __future__ import annotations

import math

from sioms.native.language import step

from .axis_step import FORCE, POSITION
from .plan_step import Plans, begin_other, look_at_plan
from .stop_step import is_behind
from .store import UNCUT_NS


@step
def may_begin(s: Plans, i: int, replaces: int) -> int:
    """Return whether a command may begin on an axis without the sequencer, in place of what runs or where that rests.

    So it is where no command waits, none has begun since the last tick, and force mode is not left.
    """
    a = s.loop
    row = s.row[i]
    if a.has_head[i] or a.waiting[i] or a.begun[i] or s.cut_ns[i] != UNCUT_NS or a.kind[i] == FORCE:
        return 0
    return replaces or (s.duration[row] == math.inf and not s.row_signals[row])


@step
def look_at_state(s: Plans, i: int, now_ns: int) -> int:
    """Set ``state`` to that in which a command of an axis begins at now, as ``Sequencer._end_state`` finds it."""
    look_at_plan(s, i, now_ns)
    if is_behind(s.loop, i):
        look_at_late(s, i, now_ns)
    return 0


@step
def look_at_late(s: Plans, i: int, now_ns: int) -> int:
    """Set ``state`` to that of an axis that cannot follow: where it is, no farther ahead than its force reaches."""
    a = s.loop
    beside_s = (now_ns - max(a.last_ns, a.seen_ns)) * 1e-9
    position = a.slewed[i] if a.stepper[i] else a.position[i] + a.velocity[i] * beside_s
    ahead = s.state[0] - position
    reach = abs(ahead)
    gain = a.k[i] * (1.0 + a.kz[i])
    if gain > 0.0 and not a.stepper[i]:
        most = a.force_limit[i] * (1.0 + abs(a.kp[i])) + abs(a.kb[i] * a.velocity[i])
        reach = min(reach, most / gain)
    s.state[0] = position + math.copysign(reach, ahead)
    s.state[1] = a.output[i] if a.stepper[i] else a.velocity[i]
    s.state[2] = 0.0
    return 0


@step
def begin(s: Plans, i: int, now_ns: int) -> int:
    """Begin the plan in the other row of an axis at now; return whether a command of its owner has ended by that."""
    a = s.loop
    kind = a.kind[i]
    late = is_behind(a, i)
    s.start_ns[i] = now_ns
    s.start_fraction[i] = 0.0
    s.cut_ns[i] = UNCUT_NS
    begin_other(s, i)
    if late and not a.stepper[i]:  # how far it was behind before must not push back
        a.error[i] = a.present[i] - (a.position[i] + a.velocity[i] * ((now_ns - max(a.last_ns, a.seen_ns)) * 1e-9))
    a.begun[i] += 1
    return kind >= POSITION and kind < FORCE
