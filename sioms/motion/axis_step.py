"""Axes whose loop the host closes, from a reading to a command: what every tick does for every axis.

``AxisBank`` owns the arrays and decides; here nothing is decided. The parts in their order are ``take`` and ``watch``,
``filter_velocity``, ``set_points``, ``control``, ``follow`` and ``show``. Each but the last tells by its flags what the
bank has to look at before the next; ``take_quietly`` and ``command_quietly`` do them as long as there is nothing.

Servo (dissertation, section F.2.4): ``u[n] = k (e[n] + kz e[n-1]) - kp tau[n-1] + kb v[n] + tau_o``,
``tau[n] = clip(u[n], -tau_m, tau_m)``; e desired minus actual position, v the filtered actual
velocity. In force mode ``u = force + kb v + tau_o``. Damping is ``kb < 0``. Where an axis is given an integral
gain ki, which the section does not have, u gets ``ki sum(e dt)``, bounded by tau_m and not growing while u is clipped.

Stepper: the same form slews the output position: e is desired minus output position, the law gives
the output velocity w (``kp`` acts on w[n-1], ``kb`` on the desired velocity), which is clipped to
the limits of velocity and acceleration, and to what can be braked, before it moves the output. k = 1/tick with the rest
zero is dead beat: the output is on the set-point in every tick as long as the limits allow it.
"""

from __future__ import annotations

import math
from typing import Final

from sioms.native.language import Flags, Floats, Integers, Record, step
from sioms.native.numbers import is_finite
from sioms.protocol.flags import AxisStatus

from .settings import SWITCH_MINUS, SWITCH_PLUS
from .watch import JITTER_S, SETTLE_NS

# What the running plan of an axis is. Plain integers: they live in arrays.
HOLD: Final = 0
POSITION: Final = 1
RATE: Final = 2
"""Velocity, acceleration or jerk command."""
FORCE: Final = 3
BRAKE: Final = 4
STOP: Final = 5
"""A brake that was asked for or forced by a limit."""
SETTLING: Final = 6
"""The set-point is at rest, the axis is still on its way there."""

# What a tick has found.
NOT_FINITE: Final = 1
WIDE: Final = 2
ODD: Final = 4
AT_LIMIT: Final = 8
FOLLOWS_BADLY: Final = 16
ON_SWITCH: Final = 32
LATE: Final = 64
ENDS: Final = 128
SETTLED: Final = 256

REST: Final = 0.01
"""Part of the velocity limit below which an axis may be at rest."""
BACK: Final = 0.1
"""Part of the force limit with which an axis that is thrown back may be braked in any case."""

SLOW: Final = 0.1
"""Part of the velocity limit below which an axis that is within its tolerance has settled."""
REST_NS: Final = 50_000_000
"""So long an axis stands before it is at rest, wherever that is [ns]."""

LOOK_NS: Final = 10_000_000
AGAINST: Final = 3.0
"""Tolerances by which an axis may run against the commanded velocity: it follows late when that changes its sign."""
TOO_FAST: Final = 1
MOVED: Final = 2
AWAY: Final = 4


class Loop(Record):
    """The arrays of n axes, (n,) each unless it is said; lengths in the unit of the axis, times in s or ns.

    Readings: ``measured`` and ``switches`` as they come, taken at ``seen_ns``, which may be long before the tick, and
    the same in several ticks; ``raw`` of this tick, ``last_raw`` of the last with a newer reading, taken at ``raw_ns``;
    ``position`` is raw + ``offset``; ``velocity`` filtered with the time constant ``filter_s``.

    Plans: ``present`` (6 n) coefficients of the polynomials, begun at ``segment_ns``; the next ends at ``next_ns``.
    ``kind`` of each, ``guard`` where soft limits are watched; ``begun`` commands since the last tick. Axes that settle
    were seen to move last at ``moved_ns``; ``settled`` tells which have done so in this tick.

    Law: gains, ``force_offset`` and limits; ``error``, ``integral``, ``output``, ``saturated`` its state; of steppers
    ``slewed``, ``anchor``, ``start_velocity``, ``last_velocity``; ``direction``, ``most``, ``asked``, ``presses`` of
    force_end.py; ``limp`` axes are let go; of ``tuned`` axes a command has set the gains, or the greatest force.

    Watch: see host_watch.py; ``derived`` where the axes are made of others, which are watched themselves.

    Shown: ``desired``, ``desired_velocity``, ``following``, ``force``, ``status``, ``buffered``. Answer: ``actuator``.
    """

    n: int
    tick_s: float
    late_ns: int
    last_ns: int
    previous_ns: int
    dt: float
    next_ns: int
    any_guard: int
    any_integral: int
    has_switches: int
    measured: Floats
    switches: Integers
    raw: Floats
    last_raw: Floats
    offset: Floats
    position: Floats
    velocity: Floats
    filter_s: Floats
    present: Floats
    segment_ns: Integers
    kind: Integers
    guard: Flags
    begun: Integers
    moved_ns: Integers
    settled: Flags
    minimum: Floats
    maximum: Floats
    speed_most: Floats
    deceleration: Floats
    k: Floats
    kz: Floats
    kp: Floats
    kb: Floats
    ki: Floats
    force_offset: Floats
    force_limit: Floats
    velocity_limit: Floats
    acceleration_limit: Floats
    error: Floats
    integral: Floats
    output: Floats
    saturated: Flags
    stepper: Flags
    slewed: Floats
    anchor: Floats
    start_velocity: Floats
    last_velocity: Floats
    direction: Floats
    most: Floats
    asked: Floats
    presses: Flags
    limp: Flags
    tuned: Flags
    desired: Floats
    desired_velocity: Floats
    following: Floats
    force: Floats
    status: Integers
    buffered: Integers
    actuator: Floats
    error_max: Floats
    latched: Integers
    event_status: Integers
    waiting: Integers
    has_head: Flags
    derived: int
    doubted: int
    any_odd: int
    bound: float
    seen_ns: int
    raw_ns: int
    before_ns: int
    watched_ns: int
    looked_ns: int
    earlier_ns: int
    due_ns: int
    factor: Floats
    tolerance: Floats
    watched: Flags
    place: Floats
    reference: Floats
    way: Floats
    excess: Floats
    against: Floats
    fast: Integers
    off: Integers
    heading: Integers
    turned_ns: Integers
    since_ns: Integers
    odd: Integers


@step
def take(a: Loop, now_ns: int) -> int:
    """Take the readings. Returns NOT_FINITE, and nothing is taken, or WIDE when the watch has to look at a step."""
    for i in range(a.n):
        if not is_finite(a.measured[i]):
            return NOT_FINITE
    wide = 0.0
    for i in range(a.n):
        raw = a.measured[i]
        way = raw - a.last_raw[i]
        a.raw[i] = raw
        a.position[i] = raw + a.offset[i]
        wide += way * way
    return WIDE if a.doubted or wide > a.bound else 0


@step
def watch(a: Loop, now_ns: int) -> int:
    """Judge what has added up since the last look: ``odd`` of each axis; returns ODD when there is any.

    All of it is judged by when the readings were taken, not by when they came.
    """
    seen_ns = a.seen_ns
    longest = (seen_ns - a.earlier_ns) * 1e-9
    a.looked_ns = seen_ns
    a.earlier_ns = a.watched_ns
    a.due_ns = seen_ns + LOOK_NS
    found = 0
    for i in range(a.n):
        raw = a.raw[i]
        way = raw - a.place[i]
        a.way[i] = way
        a.place[i] = raw
        limp = a.limp[i] != 0
        holds = a.kind[i] == HOLD
        fastest = a.factor[i] * a.velocity_limit[i]
        beyond = 0.0 if limp else abs(way) - fastest * longest
        a.excess[i] = max(0.0, a.excess[i] + beyond)
        a.fast[i] = a.fast[i] + 1 if beyond > 0.0 else 0
        # an axis that settles, or is let go, may be anywhere
        if not holds or limp or not a.watched[i]:
            a.since_ns[i] = seen_ns
        if seen_ns - a.since_ns[i] <= SETTLE_NS:
            a.reference[i] = raw
        a.off[i] = a.off[i] + 1 if abs(raw - a.reference[i]) > a.tolerance[i] else 0
        commanded = a.desired_velocity[i]
        heading = 1 if commanded > 0.0 else (-1 if commanded < 0.0 else 0)
        if heading != a.heading[i]:
            a.heading[i] = heading
            a.turned_ns[i] = now_ns
        # what was read before the last turn is no motion against what is commanded since
        along = way * heading if seen_ns >= a.turned_ns[i] else 0.0
        a.against[i] = 0.0 if holds or limp or along >= 0.0 else a.against[i] - along
        odd = 0
        if a.fast[i] > 1 and a.excess[i] > JITTER_S * fastest:
            odd = odd | TOO_FAST
        if a.off[i] > 1:
            odd = odd | MOVED
        if a.against[i] > AGAINST * a.tolerance[i] and not a.derived:
            odd = odd | AWAY
        a.odd[i] = odd
        if odd:
            found = ODD
            a.any_odd = 1
    return found


@step
def looked_at(a: Loop, now_ns: int) -> int:
    """Note that the watch has seen the readings."""
    if a.seen_ns > a.watched_ns:
        a.before_ns = a.watched_ns
        a.watched_ns = a.seen_ns
    return 0


@step
def begin_tick(a: Loop, now_ns: int) -> int:
    """Note when this tick is and how long after the last, and take the velocities from the steps of the readings."""
    a.previous_ns = a.last_ns
    a.last_ns = now_ns
    dt = max((now_ns - a.previous_ns) * 1e-9, 0.1 * a.tick_s)
    a.dt = dt
    if a.seen_ns <= a.raw_ns:
        return 0
    step_s = max((a.seen_ns - a.raw_ns) * 1e-9, 0.1 * a.tick_s)
    a.raw_ns = a.seen_ns
    for i in range(a.n):
        change = (a.raw[i] - a.last_raw[i]) / step_s - a.velocity[i]
        a.velocity[i] += change * (step_s / (a.filter_s[i] + step_s))
        a.last_raw[i] = a.raw[i]
    return 0


@step
def beyond_limit(a: Loop, i: int, position: float, velocity: float) -> int:
    """Return -1 or +1 for the limit that an axis in this state would pass when braked, else 0."""
    stand = position + velocity * abs(velocity) / (2.0 * a.deceleration[i])
    if stand < a.minimum[i] and velocity < 0.0:
        return -1
    if stand > a.maximum[i] and velocity > 0.0:
        return 1
    return 0


@step
def set_points(a: Loop, now_ns: int) -> int:
    """Evaluate the plans, with the derivative carried along. Returns AT_LIMIT where a guarded axis has to brake now."""
    n = a.n
    found = 0
    for i in range(n):
        t = (now_ns - a.segment_ns[i]) * 1e-9
        velocity = a.present[5 * n + i]
        position = velocity * t + a.present[4 * n + i]
        for j in range(4):
            velocity = velocity * t + position
            position = position * t + a.present[(3 - j) * n + i]
        a.desired[i] = position
        a.desired_velocity[i] = velocity
        if a.any_guard and a.guard[i]:
            in_force = a.kind[i] == FORCE
            if in_force:
                position = a.position[i]
                velocity = a.velocity[i]
            if beyond_limit(a, i, position, velocity) or (in_force and abs(velocity) > a.speed_most[i]):
                found = AT_LIMIT
    return found


@step
def serve(a: Loop, i: int, dt: float) -> int:
    """Advance the law of a servo."""
    limit = a.force_limit[i]
    if a.kind[i] == FORCE:
        wish = a.desired[i] + a.kb[i] * a.velocity[i] + a.force_offset[i]
        a.error[i] = 0.0
        a.integral[i] = 0.0
        a.asked[i] = a.desired[i]
        if abs(a.velocity[i]) > REST * a.velocity_limit[i]:
            a.moved_ns[i] = a.seen_ns
    else:
        old = a.error[i]
        error = a.desired[i] - a.position[i]
        a.error[i] = error
        wish = (a.kz[i] * old + error) * a.k[i]
        wish = wish - a.kp[i] * a.output[i] + a.kb[i] * a.velocity[i] + a.force_offset[i]
        if a.any_integral:
            # it does not wind up while the output is clipped (of the tick before)
            grows = a.ki[i] * error * dt
            if a.saturated[i] and grows * a.output[i] > 0.0:
                grows = 0.0
            a.integral[i] = min(max(a.integral[i] + grows, -limit), limit)
            wish += a.integral[i]
    output = min(max(wish, -limit), limit)
    toward = a.direction[i]
    a.presses[i] = False
    if toward != 0.0 and output * toward > a.most[i]:
        most = a.most[i]
        if a.velocity[i] * toward < -REST * a.velocity_limit[i]:
            most = max(most, BACK * limit)
        output = min(output * toward, most) * toward
        a.presses[i] = True
    a.output[i] = output
    a.saturated[i] = output != wish
    return 0


@step
def slew(a: Loop, i: int, dt: float) -> int:
    """Advance the law of a stepper: bound its output velocity, move its output position.

    What can still be braked on the way to the set-point bounds it, too: the lag that is not its own travel in
    this tick is closed at most within the tick, and at most as fast as half of the spare deceleration can stop there;
    else an output that was clipped, or a tick that came late, would swing about the set-point for ever.
    """
    w_last = a.output[i]
    dv = a.desired_velocity[i]
    limit = a.acceleration_limit[i]
    e = a.desired[i] - a.slewed[i]
    free = a.k[i] * (e + a.kz[i] * a.error[i]) - a.kp[i] * w_last + a.kb[i] * dv
    # what is left of the acceleration to catch up with a set-point that accelerates itself
    spare = 0.5 * max(limit - abs(dv - a.last_velocity[i]) / dt, 0.05 * limit)
    a.last_velocity[i] = dv
    lag = abs(e - dv * dt)
    half = 0.5 * spare * dt
    most = min(lag / dt, math.sqrt(2.0 * spare * lag + half * half) - half)
    wish = min(max(free, dv - most), dv + most)
    # Rounding must not count as saturation: a profile at full acceleration is within the limits.
    fastest = a.velocity_limit[i] * (1 + 1e-6)
    change = limit * dt * (1 + 1e-6)
    low = w_last - change
    high = w_last + change
    jump = a.start_velocity[i]
    if jump > 0.0 and low <= jump and high >= -jump:  # velocities up to it follow from each other at once
        low = min(low, -jump - change)
        high = max(high, jump + change)
    w = min(max(min(max(wish, low), high), -fastest), fastest)
    # Dead beat on a set-point that the limits allow to reach in this tick, however long it is.
    locked = a.k[i] * dt >= 0.999 and a.kz[i] == 0.0 and a.kp[i] == 0.0 and a.kb[i] == 0.0
    locked = locked and dv >= low and dv <= high and abs(dv) <= fastest
    near = abs(e - w_last * dt) <= 0.5 * change * dt + 1e-12
    if jump > 0.0 and abs(e) <= (jump + change) * dt:
        near = True
    locked = locked and near
    if locked:
        a.slewed[i] = a.desired[i]
        w = dv
    else:
        a.slewed[i] += w * dt
    a.output[i] = w
    a.error[i] = e
    a.saturated[i] = not locked and abs(w - free) > 1e-3 * fastest
    return 0


@step
def control(a: Loop) -> int:
    """Advance the laws by a tick; ``desired`` of axes in force mode is the force."""
    for i in range(a.n):
        if a.stepper[i]:
            slew(a, i, a.dt)
        else:
            serve(a, i, a.dt)
    return 0


@step
def settle(a: Loop, i: int) -> int:
    """Look at an axis whose set-point is at rest: returns SETTLED when it is there, or stands somewhere else."""
    speed = abs(a.output[i] if a.stepper[i] else a.velocity[i])
    limit = a.velocity_limit[i]
    if speed > REST * limit:
        a.moved_ns[i] = a.seen_ns
    there = abs(a.error[i]) <= a.tolerance[i] and speed <= SLOW * limit and not a.limp[i]
    a.settled[i] = there or a.seen_ns - a.moved_ns[i] > REST_NS
    return SETTLED if a.settled[i] else 0


@step
def follow(a: Loop) -> int:
    """Fill the answer and the following errors. Returns FOLLOWS_BADLY and ON_SWITCH where an axis has to stop, and
    SETTLED where one has come to rest.
    """
    found = 0
    for i in range(a.n):
        if a.limp[i]:
            a.output[i] = 0.0
            a.error[i] = 0.0
            a.integral[i] = 0.0
        if a.limp[i] or a.kind[i] == FORCE:  # where no position is commanded, it is the actual one
            a.desired[i] = a.position[i]
            a.desired_velocity[i] = a.velocity[i]
        a.actuator[i] = a.output[i]
        a.force[i] = a.output[i]
        if a.stepper[i]:
            a.actuator[i] = a.slewed[i] - a.anchor[i]
            a.force[i] = 0.0
            a.desired[i] = a.slewed[i]
        a.following[i] = a.desired[i] - a.position[i]
        if abs(a.following[i]) > a.error_max[i] and not a.limp[i]:
            found = found | FOLLOWS_BADLY
        if a.kind[i] == SETTLING:
            found = found | settle(a, i)
        if a.has_switches and a.switches[i] & (SWITCH_MINUS | SWITCH_PLUS):
            # an axis that is far behind goes to its set-point, wherever that goes
            v = a.error[i] if abs(a.error[i]) > a.tolerance[i] else a.desired_velocity[i]
            onto = (a.switches[i] & SWITCH_MINUS and v < 0.0) or (a.switches[i] & SWITCH_PLUS and v > 0.0)
            free = a.kind[i] == STOP or a.kind[i] == HOLD or a.latched[i] & AxisStatus.HOMING != 0
            if onto and not free:
                found = found | ON_SWITCH
    return found


@step
def show(a: Loop) -> int:
    """Fill what is shown of the status."""
    for i in range(a.n):
        status = a.event_status[i]
        if a.saturated[i]:
            status = status | AxisStatus.SATURATED
        if a.has_switches:
            status = status | (a.switches[i] & (SWITCH_MINUS | SWITCH_PLUS)) * AxisStatus.SWITCH_MINUS
        a.status[i] = status
        a.buffered[i] = a.waiting[i] + (1 if a.has_head[i] else 0)
    return 0


@step
def take_quietly(a: Loop, now_ns: int) -> int:
    """Begin a tick in which nothing is out of order: take the readings. Returns 0; or LATE, NOT_FINITE, WIDE or ODD,
    and the bank does the tick.
    """
    if now_ns - a.last_ns > a.late_ns:
        return LATE
    a.seen_ns = now_ns
    found = take(a, now_ns)
    if not found and now_ns >= a.due_ns:
        found = watch(a, now_ns)
    if found:
        return found
    looked_at(a, now_ns)
    begin_tick(a, now_ns)
    for i in range(a.n):
        a.begun[i] = 0
    return 0


@step
def command_quietly(a: Loop, now_ns: int) -> int:
    """Command the axes in the rest of such a tick. Returns 0; or AT_LIMIT, FOLLOWS_BADLY, ON_SWITCH and SETTLED: so
    much has been done as comes before that, and the bank goes on from there.
    """
    found = set_points(a, now_ns)
    if not found:
        control(a)
        found = follow(a)
    return found if found else show(a)
