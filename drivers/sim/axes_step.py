"""A tick of simulated axes in which nothing happens but motion, and the world's way to the next."""

from __future__ import annotations

from typing import Final

from sioms.motion.axis_step import ENDS, LATE, NOT_FINITE, ODD, WIDE, Loop, quiet_tick
from sioms.native.language import Floats, Integers, Record, step
from sioms.native.system import clock_ns
from sioms.plant.motor_step import Motors, bound, coast, is_free
from sioms.sdk.quiet_step import ALIVE, INPUTS, OUTPUTS, Page, publish

NOT_READY: Final = 1 << 20
UNDONE: Final = LATE | ENDS | NOT_FINITE | WIDE | ODD
"""What a bank finds before it has done anything of a tick."""


class SimulatedAxes(Record):
    """Servos over simulated motors. ``ahead``: the world has gone on to the next tick; ``last_ns``: its time.

    ``found`` by the bank in a tick that is half done. ``data`` and ``flags`` of the plant, as they are and as ``shown``
    less the ``offset``.
    """

    period_ns: int
    ahead: int
    last_ns: int
    found: int
    loop: Loop
    motors: Motors
    instants: Integers
    data: Floats
    offset: Floats
    shown: Floats
    flags: Integers
    shown_flags: Integers
    axes: Page
    plant: Page


@step
def tick_axes(s: SimulatedAxes, now_ns: int, as_of_ns: int, number: int) -> int:
    """Measure, command, publish. Returns what the driver has to see to, 0 for nothing."""
    if s.ahead != 1 or now_ns - s.last_ns != s.period_ns:
        return NOT_READY
    loop = s.loop
    m = s.motors
    for i in range(m.n):
        loop.measured[i] = m.encoders.reading[i]
        loop.switches[i] = m.switches[i]
    s.instants[INPUTS] = clock_ns()
    found = quiet_tick(loop, now_ns)
    if found & UNDONE:
        return found
    s.ahead = 0
    s.last_ns = now_ns
    s.found = found
    if found:
        return found
    s.instants[OUTPUTS] = clock_ns()
    for i in range(m.n):
        s.data[2 * i] = m.position[i]
        s.data[2 * i + 1] = m.contact_force[i]
    for i in range(2 * m.n):
        s.shown[i] = s.data[i] - s.offset[i]
        s.shown_flags[i] = s.flags[i]
    s.axes.words[ALIVE] = s.instants[OUTPUTS]
    s.plant.words[ALIVE] = s.instants[OUTPUTS]
    publish(s.axes, now_ns, number, as_of_ns)
    publish(s.plant, now_ns, number, as_of_ns)
    return 0


@step
def advance_axes(s: SimulatedAxes, now_ns: int, until_ns: int, unused: int) -> int:
    """Let the world go on to the next tick. Returns 1 when that takes more than free motion."""
    m = s.motors
    if s.ahead:
        return 0
    for i in range(m.n):
        m.command[i] = s.loop.actuator[i]
    bound(m)
    if not is_free(m):
        return 1
    coast(m)
    s.ahead = 1
    return 0
