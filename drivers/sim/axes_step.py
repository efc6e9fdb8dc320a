"""A tick of simulated axes in which nothing happens but motion, and the world's way to the next."""

from __future__ import annotations

from typing import Final

from sioms.motion.axis_step import (
    ENDS,
    SETTLED,
    Loop,
    command_quietly,
    show,
    take_quietly,
)
from sioms.motion.plan_step import Plans, all_idle, come_to_rest, go_on, may_go_on
from sioms.motion.stop_step import rest_stopped, stop_axes
from sioms.native.language import Floats, Integers, Record, step
from sioms.native.system import clock_ns
from sioms.plant.binary_step import Beams, look
from sioms.plant.motor_step import Motors, bound, coast, is_free
from sioms.plant.stepper_step import Steppers, turn
from sioms.sdk.quiet_step import ALIVE, INPUTS, OUTPUTS, Page, publish, shown_as_of

NOT_READY: Final = 1 << 20
EDGE: Final = 1 << 21
"""Nothing was done; all was done, but a beam may have changed."""


class SimulatedAxes(Record):
    """Servos over simulated motors and steppers, each a row of the loop.

    ``ahead``: by how many ticks the world has gone on; ``last_ns``: the time of the last one; ``stride``: how many may
    be made up for at once, for ``make_up_ns`` a tick, up to ``late_ns``. ``plain``: a fixed point of the world shows;
    ``idle``: no axis has anything to do; ``may_rest``: the loop wants to know of both; ``still``: it is so, and ticks
    that are left out change nothing. ``seen``: the command of the tick before, and how ``near`` the next must be to be
    the same. ``found`` by the bank in a tick that is half done, and EDGE. ``data`` and ``flags`` of the plant,
    as they are and as ``shown`` less the ``offset``. The page of the port is there where there are ``beams``.
    """

    period_ns: int
    late_ns: int
    make_up_ns: int
    stride: int
    ahead: int
    last_ns: int
    found: int
    plain: int
    idle: int
    may_rest: int
    still: int
    seen: Floats
    near: Floats
    loop: Loop
    plans: Plans
    motors: Motors
    steppers: Steppers
    beams: Beams
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
    port: Page


@step
def tick_axes(s: SimulatedAxes, now_ns: int, as_of_ns: int, number: int) -> int:
    """Measure, command, publish; ticks that were missed are made up for, and each is published with its own time. What
    that cannot be done for soon is left to the next tick. Returns what the driver has to see to, 0 for nothing.
    """
    if now_ns <= s.last_ns:
        return NOT_READY
    behind = int((now_ns - s.last_ns) / s.period_ns)
    beside_ns = now_ns - s.last_ns - behind * s.period_ns
    if 2 * beside_ns > s.period_ns:
        behind += 1
        beside_ns -= s.period_ns
    if now_ns - s.last_ns > s.late_ns:
        return NOT_READY
    if behind and not beside_ns:
        found = make_up(s, behind, number)
    elif behind < 2 and not s.still and (not beside_ns or 5 * abs(beside_ns) >= s.period_ns):  # off the grid
        found = turn_axes(s, now_ns, behind, beside_ns)
    else:
        return NOT_READY
    if found:
        return found
    s.instants[OUTPUTS] = clock_ns()
    s.axes.words[ALIVE] = s.instants[OUTPUTS]
    s.plant.words[ALIVE] = s.instants[OUTPUTS]
    if s.beams.n:
        s.port.words[ALIVE] = s.instants[OUTPUTS]
    show_axes(s, s.last_ns + beside_ns, as_of_ns, number)
    return 0


@step
def make_up(s: SimulatedAxes, behind: int, number: int) -> int:
    """Do the turns since the last, and show all but the last of them; returns what was found."""
    if s.still or (behind > s.stride and stands(s)):  # what was left out changes nothing
        s.last_ns += (behind - 1) * s.period_ns
        behind = 1
    until_ns = clock_ns() + s.make_up_ns
    shown_ns = shown_as_of(s.axes)
    ticks = min(behind, s.stride)
    found = turn_axes(s, s.last_ns + ticks * s.period_ns, ticks, 0)
    behind -= ticks
    while not found and behind and (behind <= s.stride or clock_ns() < until_ns):
        show_axes(s, s.last_ns, shown_ns, number)
        ticks = min(behind, s.stride)
        found = turn_axes(s, s.last_ns + ticks * s.period_ns, ticks, 0)
        behind -= ticks
    return found


@step
def show_axes(s: SimulatedAxes, stamp_ns: int, as_of_ns: int, number: int) -> int:
    """Publish axes, plant and port as they were at a time."""
    for i in range(2 * s.loop.n):
        s.shown[i] = s.data[i] - s.offset[i]
        s.shown_flags[i] = s.flags[i]
    publish(s.axes, stamp_ns, number, as_of_ns)
    publish(s.plant, stamp_ns, number, as_of_ns)
    return publish(s.port, stamp_ns, number, as_of_ns) if s.beams.n else 0


@step
def turn_axes(s: SimulatedAxes, now_ns: int, ticks: int, beside_ns: int) -> int:
    """Let the world go on by some ticks under the last command, measure, and command anew.

    The world goes by whole ticks: a turn so long after one reads what would be read by then.
    """
    while s.ahead < ticks:
        if move_axes(s):
            return NOT_READY
    brakes = s.plans.braked_ns != 0
    if rest_stopped(s.plans, now_ns) if brakes else not may_go_on(s.plans, now_ns):
        return ENDS
    loop = s.loop
    m = s.motors
    p = s.steppers
    for j in range(m.n):
        loop.measured[s.motor_rows[j]] = m.encoders.reading[j] + m.velocity[j] * (beside_ns * 1e-9)
        loop.switches[s.motor_rows[j]] = m.switches[j]
    for j in range(p.n):
        i = s.stepper_rows[j]
        loop.measured[i] = p.reading[j] + p.velocity[j] * (beside_ns * 1e-9)
        loop.switches[i] = (1 if p.at_minus[j] else 0) + (2 if p.at_plus[j] else 0) + (4 if p.at_home[j] else 0)
    s.instants[INPUTS] = clock_ns()
    found = take_quietly(loop, now_ns)
    if found:
        return found
    if not brakes:
        go_on(s.plans, now_ns)
    found = command_quietly(loop, now_ns)
    if found == SETTLED and not brakes and not come_to_rest(s.plans, now_ns):
        found = show(loop)
    if s.plans.untold:
        s.idle = all_idle(s.plans)
    s.ahead = max(0, s.ahead - ticks)
    s.still = 0
    s.last_ns = now_ns - beside_ns
    for j in range(m.n):
        s.data[2 * s.motor_rows[j]] = m.position[j]
        s.data[2 * s.motor_rows[j] + 1] = m.contact_force[j]
    for j in range(p.n):
        s.data[2 * s.stepper_rows[j]] = p.position[j]
    s.found = found
    if not beside_ns:
        s.found = found | look_at_axes(s, now_ns)
    return s.found


@step
def look_at_axes(s: SimulatedAxes, now_ns: int) -> int:
    """Return EDGE when a beam may have changed on the way of the axes to where they are now."""
    for j in range(s.beams.m):
        s.beams.now[j] = s.data[2 * j]
    return EDGE if s.beams.n and look(s.beams, now_ns) else 0


@step
def brake_axes(s: SimulatedAxes, now_ns: int, latches: int, since_ns: int) -> int:
    """Begin to stop all axes as from an instant, but neither before the last tick nor later than a tick after it.
    Returns 1 where that is for the driver.
    """
    if s.found or now_ns - s.last_ns > s.late_ns:
        return 1
    if s.still:
        return stop_axes(s.plans, now_ns, latches)
    latest_ns = min(now_ns, s.loop.last_ns + s.period_ns)
    return stop_axes(s.plans, min(max(since_ns, s.loop.last_ns), latest_ns), latches)


@step
def advance_axes(s: SimulatedAxes, now_ns: int, until_ns: int, unused: int) -> int:
    """Let the world go on to the next tick. Returns 1 when that takes more than free motion, or plans can be made ahead
    of commands that have begun.
    """
    left = 0 if s.ahead else move_axes(s)
    return left or s.plans.started > 0


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
    """Return whether world and command are at a fixed point and nobody looks."""
    return stands(s) if s.may_rest else 0


@step
def stands(s: SimulatedAxes) -> int:
    """Return whether world and command are at a fixed point, as ``SimAxes.is_at_rest`` does."""
    if not s.plain:
        return 0
    s.still = s.idle
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
