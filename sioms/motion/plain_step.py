"""Which short writes are taken at once, as a step: the same answer as ``CommandQueue.admit_plain``, out of the bytes.

A record is judged where it lies in the packet; see plain.py for what is plain. Nothing is changed here.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from sioms.native.language import Bytes, Flags, Floats, Integers, Record, step
from sioms.native.numbers import real_at, word_at

from . import modes
from .commands import RULES, WIRE_DTYPE
from .plain import BESIDE, GREATEST, MOST, QUANTITY
from .queue import BARRED, HOMED, LOST

if TYPE_CHECKING:
    from .queue import CommandQueue

PLACE: Final = {name: place for name, (_, place, *_) in (WIRE_DTYPE.fields or {}).items()}
"""Where in a record each column begins."""
SIZE: Final = WIRE_DTYPE.itemsize
AXIS_AT: Final = PLACE["axis"]
MODE_AT: Final = PLACE["control_mode"]
POSITION_AT: Final = PLACE["position"]
BOUNDS: Final = ("", "velocity", "acceleration", "jerk", "force")
"""Limits that bound columns, as rules name them; in a Plain by number."""
VELOCITY: Final = 1
ACCELERATION: Final = 2
JERK: Final = 3
FORCE: Final = 4


class Plain(Record):
    """What writes to the axes of a bank are judged by; its arrays are those of the queue, (n,) each.

    ``rules`` of ``flag``, place ``at`` in a record, limit that is its ``bound``, and whether it has to be ``positive``.
    """

    capacity: int
    latched: Integers
    home_required: Flags
    waiting: Integers
    offered: Integers
    minimum: Floats
    maximum: Floats
    below: Floats
    above: Floats
    velocity: Floats
    acceleration: Floats
    jerk: Floats
    force: Floats
    rules: int
    flag: Integers
    at: Integers
    bound: Integers
    positive: Integers


@step
def most_of(p: Plain, bound: int, axis: int) -> float:
    """Return what the size of a value may be at most."""
    if bound == VELOCITY:
        return p.velocity[axis]
    if bound == ACCELERATION:
        return p.acceleration[axis]
    if bound == JERK:
        return p.jerk[axis]
    if bound == FORCE:
        return p.force[axis]
    return GREATEST


@step
def may_take(p: Plain, axis: int) -> int:
    """Return whether an axis takes commands now, as ``CommandQueue.is_barred`` has it."""
    if p.latched[axis] & (BARRED | LOST):
        return 0
    if p.home_required[axis] and not p.latched[axis] & HOMED:
        return 0
    return 1


@step
def is_plain(p: Plain, data: Bytes, at: int, axis: int) -> int:
    """Return whether the record at a byte is plain and good, as ``PlainCheck.command`` has it."""
    mode = word_at(data, at + MODE_AT)
    quantity = mode & QUANTITY
    if mode & ~(QUANTITY | BESIDE) or not quantity or quantity & (quantity - 1) or mode & ~p.offered[axis]:
        return 0
    for i in range(p.rules):
        if mode & p.flag[i]:
            value = real_at(data, at + p.at[i])
            most = most_of(p, p.bound[i], axis)
            if not (-most <= value <= most) or not (-GREATEST <= value <= GREATEST):
                return 0
            if p.positive[i] and value <= 0.0:
                return 0
    if mode & modes.POSITION:
        position = real_at(data, at + POSITION_AT)
        low = p.minimum[axis] + p.below[axis]
        high = p.maximum[axis] - p.above[axis]
        if not (low <= position <= high):
            return 0
    return 1


@step
def admits(
    p: Plain, data: Bytes, at: int, count: int, axes: Integers, first: int, known: int, waiting: int, replace: int
) -> int:
    """Return whether the records from a byte on can be taken at once.

    Args:
        p: of the bank.
        data: the packet; at: where the records begin; count: how many.
        axes, first, known: bank axes of the node are ``axes[first : first + known]``.
        waiting: how many commands have been taken and are not in the buffers.
        replace: the buffers of these axes will be emptied first.
    """
    if count < 1 or count > MOST or count > p.capacity:
        return 0
    most = p.capacity - 1 - waiting - count
    for i in range(count):
        local = word_at(data, at + i * SIZE + AXIS_AT)
        if local >= known:
            return 0
        axis = axes[first + local]
        if not replace and p.waiting[axis] > most:
            return 0
        if not may_take(p, axis) or not is_plain(p, data, at + i * SIZE, axis):
            return 0
    return 1


def plain_of(queue: CommandQueue) -> Plain:
    """Return what the writes to a bank are judged by; it stays true while the queue changes."""
    limits, rules = queue.limits, [rule for rule in RULES if rule.flag & (QUANTITY | BESIDE)]

    def row(values: list[int]) -> NDArray[np.int64]:
        return np.array(values, dtype=np.int64)

    return Plain(
        capacity=queue.capacity, latched=queue.latched, home_required=queue.home_required, waiting=queue.waiting,
        offered=row(queue.plain.offered), minimum=limits.minimum, maximum=limits.maximum, below=limits.room_below,
        above=limits.room_above, velocity=limits.velocity, acceleration=limits.acceleration, jerk=limits.jerk,
        force=limits.force, rules=len(rules), flag=row([rule.flag for rule in rules]),
        at=row([PLACE[rule.field] for rule in rules]), bound=row([BOUNDS.index(rule.bound) for rule in rules]),
        positive=row([rule.positive for rule in rules]),
    )  # fmt: skip
