"""Whether light beams change between two looks: what most ticks of a device with beams have to know of them."""

from __future__ import annotations

from sioms.native.language import Flags, Floats, Integers, Record, step


class Beams(Record):
    """n light beams over m coordinates, each broken while all coordinates of one of its boxes lie within.

    The boxes of beam k are ``boxes[k]`` up to ``boxes[k + 1]``, the intervals of box x ``intervals[x]`` up to
    ``intervals[x + 1]``, each of a ``coordinate`` from ``low`` to ``high``. ``broken`` of each beam at ``looked_ns``,
    when the coordinates were ``before``; ``now`` are those of the next look.
    """

    n: int
    m: int
    looked_ns: int
    boxes: Integers
    intervals: Integers
    coordinate: Integers
    low: Floats
    high: Floats
    broken: Flags
    before: Floats
    now: Floats


@step
def passes(b: Beams, k: int) -> int:
    """Return 2 when one box of a beam holds on all the way from before to now, 1 when one is touched, else 0."""
    found = 0
    for x in range(b.boxes[k], b.boxes[k + 1]):
        enter = 0.0
        leave = 1.0
        for i in range(b.intervals[x], b.intervals[x + 1]):
            start = b.before[b.coordinate[i]]
            way = b.now[b.coordinate[i]] - start
            if way != 0.0:
                first = (b.low[i] - start) / way
                second = (b.high[i] - start) / way
                enter = max(enter, min(first, second))
                leave = min(leave, max(first, second))
            elif not (b.low[i] <= start and start <= b.high[i]):
                leave = -1.0
        if enter == 0.0 and leave == 1.0:
            found = 2
        elif enter <= leave:
            found = max(found, 1)
    return found


@step
def look(b: Beams, now_ns: int) -> int:
    """Return 1, and leave all as it is, when a beam may change on the way from before to now; else be there."""
    for k in range(b.n):
        if passes(b, k) != (2 if b.broken[k] else 0):
            return 1
    for j in range(b.m):
        b.before[j] = b.now[j]
    b.looked_ns = now_ns
    return 0
