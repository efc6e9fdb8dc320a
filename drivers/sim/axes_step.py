"""A tick of simulated axes in which nothing happens but motion, and the world's way to the next."""

from __future__ import annotations

from typing import Final

from sioms.motion.axis_step import ENDS, LATE, NOT_FINITE, ODD, WIDE, Loop, quiet_tick
from sioms.native.language import Floats, Integers, Record, step
from sioms.native.system import clock_ns
from sioms.plant.motor_step import Motors, bound, coast, is_free
from sioms.plant.stepper_step import Steppers, turn
from sioms.sdk.quiet_step import ALIVE, INPUTS, OUTPUTS, Page, publish

NOT_READY: Final = 1 << 20
UNDONE: Final = LATE | ENDS | NOT_FINITE | WIDE | ODD
"""What a bank finds before it has done anything of a tick."""


class SimulatedAxes(Record):
    """Servos over simulated motors and steppers, each a row of the loop.

    ``ahead``: by how many ticks the world has gone on; ``last_ns``: the time of the last one; ``stride``: how many may
    be made up for at once, up to ``late_ns``. ``may_rest``: axes are at rest when the world is; ``still``: they are,
    and ticks that are left out change nothing. ``seen``: the command of the tick before, and how ``near`` the next must
    be to be the same. ``found`` by the bank in a tick that is half done. ``data`` and ``flags`` of the plant, as they
    are and as ``shown`` less the ``offset``.
    """

    period_ns: int
    late_ns: int
    stride: int
    ahead: int
    last_ns: int
    found: int
    may_rest: int
    still: int
    seen: Floats
    near: Floats
    loop: Loop
    motors: Motors
    steppers: Steppers
    motor_rows: Integers
    stepper_rows: Integers
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
    """Measure, command, publish; ticks that were missed are made up for. Returns what the driver has to see to, 0 for
    nothing.
    """
    behind = int((now_ns - s.last_ns) / s.period_ns)
    if behind < 1 or behind * s.period_ns != now_ns - s.last_ns or now_ns - s.last_ns > s.late_ns:
        return NOT_READY
    if s.still:  # what was left out changes nothing
        s.last_ns += (behind - 1) * s.period_ns
        behind = 1
    while behind > s.stride:
        found = turn_axes(s, s.last_ns + s.stride * s.period_ns, s.stride)
        if found:
            return found
        behind -= s.stride
    found = turn_axes(s, now_ns, behind)
    if found:
        return found
    s.instants[OUTPUTS] = clock_ns()
    m = s.motors
    p = s.steppers
    for j in range(m.n):
        s.data[2 * s.motor_rows[j]] = m.position[j]
        s.data[2 * s.motor_rows[j] + 1] = m.contact_force[j]
    for j in range(p.n):
        s.data[2 * s.stepper_rows[j]] = p.position[j]
    for i in range(2 * s.loop.n):
        s.shown[i] = s.data[i] - s.offset[i]
        s.shown_flags[i] = s.flags[i]
    s.axes.words[ALIVE] = s.instants[OUTPUTS]
    s.plant.words[ALIVE] = s.instants[OUTPUTS]
    publish(s.axes, now_ns, number, as_of_ns)
    publish(s.plant, now_ns, number, as_of_ns)
    return 0


@step
def turn_axes(s: SimulatedAxes, now_ns: int, ticks: int) -> int:
    """Let the world go on by some ticks up to now under the last command, measure, and command anew."""
    while s.ahead < ticks:
        if move_axes(s):
            return NOT_READY
    loop = s.loop
    m = s.motors
    p = s.steppers
    for j in range(m.n):
        loop.measured[s.motor_rows[j]] = m.encoders.reading[j]
        loop.switches[s.motor_rows[j]] = m.switches[j]
    for j in range(p.n):
        i = s.stepper_rows[j]
        loop.measured[i] = p.reading[j]
        loop.switches[i] = (1 if p.at_minus[j] else 0) + (2 if p.at_plus[j] else 0) + (4 if p.at_home[j] else 0)
    s.instants[INPUTS] = clock_ns()
    found = quiet_tick(loop, now_ns)
    if found & UNDONE:
        return found
    s.ahead = 0
    s.still = 0
    s.last_ns = now_ns
    s.found = found
    return found


@step
def advance_axes(s: SimulatedAxes, now_ns: int, until_ns: int, unused: int) -> int:
    """Let the world go on to the next tick. Returns 1 when that takes more than free motion."""
    return 0 if s.ahead else move_axes(s)


@step
def move_axes(s: SimulatedAxes) -> int:
    """Let the world go on by a tick. Returns 1 when that takes more than free motion."""
    m = s.motors
    p = s.steppers
    if m.n:
        for j in range(m.n):
            m.command[j] = s.loop.actuator[s.motor_rows[j]]
        bound(m)
        if not is_free(m):
            return 1
        coast(m)
    if p.n:
        for j in range(p.n):
            p.goal[j] = s.loop.actuator[s.stepper_rows[j]]
        turn(p)
    s.ahead += 1
    return 0


@step
def rest_axes(s: SimulatedAxes, a: int, b: int, c: int) -> int:
    """Return whether world and command are at a fixed point, as ``SimAxes.is_at_rest`` does."""
    if not s.may_rest:
        return 0
    s.still = 1
    for i in range(s.loop.n):
        if not abs(s.loop.actuator[i] - s.seen[i]) <= s.near[i]:
            s.still = 0
        s.seen[i] = s.loop.actuator[i]
    for j in range(s.motors.n):
        if s.motors.velocity[j] != 0.0:
            s.still = 0
    for j in range(s.steppers.n):
        if s.steppers.velocity[j] != 0.0:
            s.still = 0
    return s.still
