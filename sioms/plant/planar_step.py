"""Steps of the simulated plane: one object on the platen, its fingers and their contacts; ``planar`` says what physics.

The state is one array: pose and speed of the object, then each finger; what a finger is made of is another.
"""

from __future__ import annotations

import math

from sioms.native.language import Floats, Record, step

POSE, SPIN, FINGERS = 0, 3, 6
"""Of the state: x, y, angle of the object, their rates, and the first finger."""
PLACE, RATE, COMMAND, PACE = 0, 3, 6, 9
"""Of a finger: x, y, th of its joints, their speeds, where they are told to be, and how fast that moves."""
NORMAL, TANGENTIAL, PHI, RADIUS, GAP, SLIDES, COEFFICIENT, STRETCH, SIDE, JOINT_FORCE, LENGTH = (
    12, 13, 14, 15, 16, 17, 18, 19, 20, 21, 24,
)  # fmt: skip
LINK, SPRINGS, WIDE, RUBS, LOSS, SHEAR_LOSS, CREEPS, LOADS, LOADS_END, MOUNT = 0, 1, 10, 11, 12, 13, 14, 15, 16, 17
"""Of a mount: link, stiffness, damping and mass of each joint, length of contact, its coefficient or none, losses,
whether rolling lets stress go, and its part of the curve over the load."""
CX, CY, AREA, ANGLE, REACH = 0, 1, 2, 3, 4
"""Of what is found: the finger's centre, area, direction and distance of the overlap."""
PX, PY, AT_X, AT_Y = 5, 6, 7, 8
"""Force on the object, and where it acts."""
FOUND = 9


class Plane(Record):
    """An object with ``points`` corners, ``fingers`` and the tables of their rubber over sqrt(delta R), ``per_row`` a
    row of ``rows``; ``bend`` and ``rubbing`` are the friction over 1/R, ``load`` and ``factor`` over the force.
    """

    fingers: int
    points: int
    lifted: int
    rows: int
    bends: int
    mass: float
    inertia: float
    most_force: float
    most_moment: float
    outer_m: float
    per_row: float
    outline: Floats
    state: Floats
    mounts: Floats
    found: Floats
    product: Floats
    half_width: Floats
    shear: Floats
    bend: Floats
    rubbing: Floats
    load: Floats
    factor: Floats


@step
def advance_plane(p: Plane, h: float, steps: int) -> int:
    """Go on by some steps of h [s]: positions by half steps before and after each change of velocity."""
    s = p.state
    half = 0.5 * h
    for _ in range(steps):
        for j in range(3):
            s[POSE + j] += half * s[SPIN + j]
        fx = 0.0
        fy = 0.0
        moment = 0.0
        for i in range(p.fingers):
            f = FINGERS + LENGTH * i
            for j in range(3):
                s[f + PLACE + j] += half * s[f + RATE + j]
                s[f + COMMAND + j] += half * s[f + PACE + j]
            touch_object(p, i, h)
            fx += p.found[PX]
            fy += p.found[PY]
            moment += (p.found[AT_X] - s[POSE]) * p.found[PY] - (p.found[AT_Y] - s[POSE + 1]) * p.found[PX]
            push_finger(p, i, h)
            for j in range(3):
                s[f + PLACE + j] += half * s[f + RATE + j]
                s[f + COMMAND + j] += half * s[f + PACE + j]
        turned = s[SPIN + 2] + h * moment / p.inertia
        slide_object(p, s[SPIN] + h * fx / p.mass, s[SPIN + 1] + h * fy / p.mass, turned, h)
        for j in range(3):
            s[POSE + j] += half * s[SPIN + j]
    return 0


@step
def push_finger(p: Plane, i: int, h: float) -> int:
    """Change a finger's velocity by its springs and the contact's reaction; damping by the trapezoidal rule."""
    s = p.state
    f = FINGERS + LENGTH * i
    twist = -((p.found[AT_X] - s[f + PLACE]) * p.found[PY] - (p.found[AT_Y] - s[f + PLACE + 1]) * p.found[PX])
    for j in range(3):
        k = MOUNT * i + SPRINGS + 3 * j
        damping = p.mounts[k + 1]
        mass = p.mounts[k + 2]
        load = -p.found[PX] if j == 0 else -p.found[PY] if j == 1 else twist
        spring = p.mounts[k] * (s[f + COMMAND + j] - s[f + PLACE + j])
        share = 0.5 * h * damping / mass
        past = s[f + RATE + j] - s[f + PACE + j]
        after = (past * (1.0 - share) + h * (spring + load) / mass) / (1.0 + share)
        s[f + JOINT_FORCE + j] = -spring + damping * 0.5 * (past + after)
        s[f + RATE + j] = after + s[f + PACE + j]
    return 0


@step
def slide_object(p: Plane, vx: float, vy: float, w: float, h: float) -> int:
    """Take the platen's friction from the object's velocity, at most all of it."""
    s = p.state
    force = p.most_force
    turning = p.most_moment
    if force > 0.0:
        whole = p.mass * p.mass * (vx * vx + vy * vy) / (force * force)
        spun = p.inertia * w / turning
        if whole + spun * spun <= h * h:
            vx = 0.0
            vy = 0.0
            w = 0.0
        else:
            whole = math.sqrt(force * force * (vx * vx + vy * vy) + turning * turning * w * w)
            keep = 1.0 - min(1.0, h * force * force / (whole * p.mass))
            vx = vx * keep
            vy = vy * keep
            w = w * (1.0 - min(1.0, h * turning * turning / (whole * p.inertia)))
    s[SPIN] = vx
    s[SPIN + 1] = vy
    s[SPIN + 2] = w
    return 0


@step
def rubbing_of(p: Plane, i: int, radius: float, normal: float) -> float:
    """Return the coefficient of friction of a contact with this relative radius [m], under a normal force [N]."""
    found = p.mounts[MOUNT * i + RUBS]
    if found < 0.0:
        bend = 1.0 / radius
        found = p.rubbing[p.bends - 1]
        for k in range(1, p.bends):
            if bend <= p.bend[k]:
                share = (bend - p.bend[k - 1]) / (p.bend[k] - p.bend[k - 1])
                found = p.rubbing[k - 1] + (p.rubbing[k] - p.rubbing[k - 1]) * share
                break
    first = int(p.mounts[MOUNT * i + LOADS])
    last = int(p.mounts[MOUNT * i + LOADS_END])
    if first == last:
        return found
    if normal <= p.load[first]:
        return found * p.factor[first]
    for k in range(first + 1, last):
        if normal < p.load[k]:
            share = (normal - p.load[k - 1]) / (p.load[k] - p.load[k - 1])
            return found * (p.factor[k - 1] + (p.factor[k] - p.factor[k - 1]) * share)
    return found * p.factor[last - 1]


@step
def touch_object(p: Plane, i: int, h: float) -> int:
    """Find a finger's contact: the force on the object and where it acts."""
    s = p.state
    found = p.found
    f = FINGERS + LENGTH * i
    m = MOUNT * i
    chord = overlap_of(p, i)
    angle = found[ANGLE]
    reach = found[REACH]
    phi = math.remainder(angle - s[f + PLACE + 2], math.tau)
    rolled = math.remainder(phi - s[f + PHI], math.tau)
    s[f + PHI] = phi
    found[PX] = 0.0
    found[PY] = 0.0
    found[AT_X] = found[CX]
    found[AT_Y] = found[CY]
    if chord <= 0.0:
        s[f + NORMAL] = 0.0
        s[f + TANGENTIAL] = 0.0
        s[f + STRETCH] = 0.0
        s[f + GAP] = reach
        s[f + SLIDES] = 0.0
        s[f + RADIUS] = math.inf
        return 0
    depth = 0.75 * found[AREA] / chord
    radius = 0.5 * chord * chord / depth
    at = math.sqrt(depth * radius) / p.per_row
    row = p.rows - 2
    if at < p.rows - 1:
        row = int(at)
    share = at - row
    load = (p.product[row] + share * (p.product[row + 1] - p.product[row])) / radius
    width = p.half_width[row] + share * (p.half_width[row + 1] - p.half_width[row])
    shear = p.shear[row] + share * (p.shear[row + 1] - p.shear[row])
    nx = math.cos(angle)
    ny = math.sin(angle)
    at_x = found[CX] + reach * nx
    at_y = found[CY] + reach * ny
    # the finger's surface there against the object's
    ux = s[f + RATE] - s[f + RATE + 2] * (at_y - s[f + PLACE + 1]) - s[SPIN] + s[SPIN + 2] * (at_y - s[POSE + 1])
    uy = s[f + RATE + 1] + s[f + RATE + 2] * (at_x - s[f + PLACE]) - s[SPIN + 1] - s[SPIN + 2] * (at_x - s[POSE])
    closing = ux * nx + uy * ny
    across = uy * nx - ux * ny
    wide = p.mounts[m + WIDE]
    normal = wide * load * max(0.0, 1.0 + p.mounts[m + LOSS] * closing)
    stiff = wide * shear
    rubs = rubbing_of(p, i, radius, normal)
    stretch = s[f + STRETCH]
    if p.mounts[m + CREEPS] > 0.0:
        stretch = stretch * math.exp(-abs(rolled) * reach * width * shear / (2.0 * radius * load))
    middle = stretch + 0.5 * h * across
    tangential = stiff * (middle + p.mounts[m + SHEAR_LOSS] * across)
    stretch += h * across
    most = rubs * normal
    s[f + SLIDES] = 0.0
    if abs(tangential) > most:
        s[f + SLIDES] = 1.0
        tangential = math.copysign(most, tangential)
    held = rubs * wide * load / stiff
    s[f + STRETCH] = min(max(stretch, -held), held)
    s[f + NORMAL] = normal
    s[f + TANGENTIAL] = tangential
    s[f + COEFFICIENT] = rubs
    s[f + GAP] = -depth
    bend = 1.0 / radius - 1.0 / p.outer_m  # below 1/m it is the arc's difference from its parabola
    s[f + RADIUS] = math.inf
    if bend > 1.0:
        s[f + RADIUS] = 1.0 / bend
    found[PX] = normal * nx - tangential * ny
    found[PY] = normal * ny + tangential * nx
    found[AT_X] = at_x
    found[AT_Y] = at_y
    return 0


@step
def overlap_of(p: Plane, i: int) -> float:
    """Return half the chord of a finger's overlap with the object [m]; without contact 0, and REACH its clearance."""
    s = p.state
    found = p.found
    o = p.outline
    f = FINGERS + LENGTH * i
    rb = p.outer_m
    th = s[f + PLACE + 2]
    cx = s[f + PLACE] + p.mounts[MOUNT * i + LINK] * math.cos(th)
    cy = s[f + PLACE + 1] + p.mounts[MOUNT * i + LINK] * math.sin(th)
    found[CX] = cx
    found[CY] = cy
    found[AREA] = 0.0
    if p.lifted:
        found[ANGLE] = s[f + PHI] + th
        found[REACH] = math.inf
        return 0.0
    turn = s[POSE + 2]
    c = math.cos(turn)
    n = math.sin(turn)
    u = c * (cx - s[POSE]) + n * (cy - s[POSE + 1])
    v = c * (cy - s[POSE + 1]) - n * (cx - s[POSE])
    count = p.points
    at = int(s[f + SIDE])
    came = 0
    seen = 0
    fx = 0.0
    fy = 0.0
    while count > 0:  # the side that is nearest to the centre: downhill along the convex outline
        after = at + 1 if at + 1 < count else 0
        ax = o[2 * at]
        ay = o[2 * at + 1]
        bx = o[2 * after]
        by = o[2 * after + 1]
        ex = bx - ax
        ey = by - ay
        along = (u - ax) * ex + (v - ay) * ey
        square = ex * ex + ey * ey
        if came > 0 and along < 0.0:  # a corner between two sides, of which it sees one from behind if it is sharp
            fx = ax
            fy = ay
            break
        if came < 0 and along > square:
            fx = bx
            fy = by
            break
        if seen < count and ex * (v - ay) - ey * (u - ax) > 0.0:  # it shows this side its back
            came = 0
            at = after
            seen += 1
        elif along < 0.0:
            came = -1
            at = at - 1 if at > 0 else count - 1
        elif along > square:
            came = 1
            at = after
        else:
            fx = ax + along / square * ex
            fy = ay + along / square * ey
            break
    s[f + SIDE] = at
    gx = fx - u
    gy = fy - v
    apart = gx * gx + gy * gy
    limit = rb * rb
    if apart >= limit:
        found[ANGLE] = turn + math.atan2(gy, gx)
        found[REACH] = math.sqrt(apart) - rb
        return 0.0
    # from the foot along the outline both ways, until it leaves the finger
    area = 0.0
    left_x = 0.0
    left_y = 0.0
    right_x = 0.0
    right_y = 0.0
    for way in range(2):
        sign = 1.0 - 2.0 * way
        lx = gx
        ly = gy
        k = at
        if way == 0:
            k = at + 1 if at + 1 < count else 0
        qx = o[2 * k] - u
        qy = o[2 * k + 1] - v
        gone = 0
        while qx * qx + qy * qy < limit and gone < count:
            area += sign * ((lx - gx) * (qy - gy) - (ly - gy) * (qx - gx))
            lx = qx
            ly = qy
            gone += 1
            k += 1 - 2 * way
            if k == count:
                k = 0
            if k < 0:
                k = count - 1
            qx = o[2 * k] - u
            qy = o[2 * k + 1] - v
        share = share_within(lx, ly, qx, qy, limit)
        right_x = left_x
        right_y = left_y
        left_x = lx + share * (qx - lx)
        left_y = ly + share * (qy - ly)
        area += sign * ((lx - gx) * (left_y - gy) - (ly - gy) * (left_x - gx))
    # close by the chord: the cap between outline and chord, then the finger's segment beyond it
    area += (right_x - gx) * (left_y - gy) - (right_y - gy) * (left_x - gx)
    cap = 0.5 * area
    mx = 0.5 * (left_x + right_x)
    my = 0.5 * (left_y + right_y)
    wide_x = right_x - left_x
    wide_y = right_y - left_y
    chord = 0.5 * math.sqrt(wide_x * wide_x + wide_y * wide_y)
    if chord < 1e-9:
        found[ANGLE] = turn + math.atan2(gy, gx)
        found[REACH] = 0.0
        return 0.0
    deep = math.sqrt(mx * mx + my * my)
    found[AREA] = cap + limit * math.atan2(chord, deep) - chord * deep
    found[ANGLE] = turn + math.atan2(my, mx)
    found[REACH] = deep - 0.5 * cap / chord
    return chord


@step
def share_within(ax: float, ay: float, bx: float, by: float, limit: float) -> float:
    """Return which share of the line from a within the circle about the origin to b outside lies within it."""
    ex = bx - ax
    ey = by - ay
    square = ex * ex + ey * ey
    if square == 0.0:
        return 0.0
    along = ax * ex + ay * ey
    inside = limit - ax * ax - ay * ay
    return (-along + math.sqrt(max(along * along + square * inside, 0.0))) / square
