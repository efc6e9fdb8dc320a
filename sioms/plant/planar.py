"""A simulated plane: rubber fingers on compliant modules, and an object with mass and friction on the platen.

A finger is carried by three joints (x, y, th) whose commanded places come from elsewhere; between the command and the
finger lies each joint's spring, so that a force moves the finger and not what the axis reads.  The link is balanced
about its axis: masses do not couple.  Contacts obey `skin`: the line load of the elastic layer over the overlap of the
undeformed finger with the outline, tangential stiffness of the same layer, stick and slip by bristles, and the creep
of rolling (stressed rubber leaves the contact, unstressed rubber comes in) at Carter's rate a T/(2 R N) for small
tangential forces.  The
resultant of the pressure on a round finger goes through its centre, so the normal does too.

Friction on the platen obeys the elliptic limit surface (Howe and Cutkosky): force and moment share one budget.  It
stops the object within a step and never drives it.

Integration: positions by half steps before and after each change of velocity, of second order where nothing slides.

Plain floats in lists, one function of the state for each thing: it runs some ten thousand times a second.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from sioms.plant.outline import Outline
from sioms.plant.skin import Skin, friction, skin

GRAVITY = 9.80665
LOST = math.inf


FARTHEST_M, NARROWEST_M = 0.72, 1e-3
"""Of an object: how far it may reach from its centroid, and how wide it must be at least [m]."""
_MOUNTS = {
    "link_m": (0.0, 10.0), "stiffness": (1e-12, 1e10), "turn_stiffness": (1e-12, 1e8), "mass": (1e-6, 1e7),
    "inertia": (1e-9, 1e6), "damping_ratio": (0.0, 1e3), "length_m": (1e-4, 1.0), "friction": (0.0, 100.0),
    "loss_s": (0.0, 1e4), "shear_loss_s": (0.0, 10.0),
}  # fmt: skip
RUBBER_PA = 1.5e6
"""Stiffness of a contact for each metre along the finger at 500 N/m, on a flat [N/m^2]; steps are to follow that."""
_BODIES = {"mass": (1e-6, 1e12), "platen_friction": (0.0, 1e3)}
"""Bounds of numbers that measure a hand; masses and times are those of slow motion, too (`sioms.hand.slow`)."""


@dataclass(frozen=True, slots=True)
class Mount:
    """Carry a finger: a module's joints and the finger on its link.

    Args:
        link_m: from the revolute axis to the finger's centre, >= 0.
        stiffness: of x and y [N/m].
        turn_stiffness: of th [N m/rad].
        mass: of what x and y move [kg].
        inertia: of what th moves [kg m^2].
        damping_ratio: of each joint with its own mass.
        length_m: of the contact along the finger: force over line load.
        friction: coefficient, or None for that of table 4.2 by the contact's relative radius.
        friction_by_load: normal forces [N], rising, each with a factor of the coefficient there; none: 1 at all.
        loss_s: the normal force grows by this share for each m/s of closing [s/m].
        shear_loss_s: damping over stiffness of the tangential spring [s].
        creep: whether rolling lets tangential stress go.
    """

    link_m: float = 0.140
    stiffness: float = 17e3
    turn_stiffness: float = 0.275
    mass: float = 1.0
    inertia: float = 5e-4
    damping_ratio: float = 0.7
    length_m: float = 20e-3
    friction: float | None = None
    friction_by_load: tuple[tuple[float, float], ...] = ()
    loss_s: float = 1.0
    shear_loss_s: float = 3e-4
    creep: bool = True

    def least_mass(self, step_s: float) -> tuple[float, float]:
        """Return mass [kg] and inertia [kg m^2] below which springs and rubber outrun steps of this length.

        Springs are integrated explicitly: from a frequency of 2/step on they gain energy. This asks for half of it.
        """
        rubber = RUBBER_PA * self.length_m
        return step_s**2 * (self.stiffness + rubber), step_s**2 * (self.turn_stiffness + rubber * self.link_m**2)

    @property
    def springs(self) -> tuple[tuple[float, float, float], ...]:
        """Stiffness and damping of x, y [N/m, N s/m] and th [N m/rad, N m s/rad], and the mass behind each."""
        return tuple(
            (stiff, 2.0 * self.damping_ratio * math.sqrt(stiff * mass), mass)
            for stiff, mass in (
                (self.stiffness, self.mass), (self.stiffness, self.mass), (self.turn_stiffness, self.inertia),
            )
        )  # fmt: skip

    def __post_init__(self) -> None:
        for name, (least, most) in _MOUNTS.items():
            value = getattr(self, name)
            if value is not None and not least <= value <= most:
                raise ValueError(f"describe finger's mount: {name} is {value:g}; want {least:g} to {most:g}")
        loads, most = [load for load, _ in self.friction_by_load], _MOUNTS["friction"][1]
        odd = loads != sorted(set(loads)) or not all(0.0 <= factor <= most for _, factor in self.friction_by_load)
        if odd or not all(0.0 <= load < math.inf for load in loads):
            raise ValueError(
                f"describe finger's mount: friction_by_load is {self.friction_by_load}; want forces of 0 or more that "
                f"rise, each with a factor of 0 or more, at most {most:g}"
            )

    def coefficient(self, radius_m: float, normal: float) -> float:
        """Return the coefficient of friction of a contact with this relative radius [m], under a normal force [N]."""
        plain = friction(radius_m) if self.friction is None else self.friction
        return plain * _between(self.friction_by_load, normal) if self.friction_by_load else plain


@dataclass(slots=True)
class Finger:
    """A finger's state, and what it felt in the last step.

    Attributes:
        mount: what carries it.
        place: x, y [m], th [rad] of the joints behind their springs.
        speed: of these.
        command, rate: where the joints are told to be, and how fast that moves.
        normal, tangential: force on the object along the normal, and anti-clockwise across it [N].
        phi: place of contact in the finger's own angle [rad]; the nearest point's without contact.
        radius_m: rc of the object as the contact feels it; infinite for a side.
        gap_m: clearance without contact, else minus the approach.
        slides: whether the contact slid.
        friction: coefficient of this contact.
        joint_force: with which the joints' springs act on their axes, x, y [N], th [N m].
    """

    mount: Mount
    place: list[float]
    speed: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])
    command: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])
    rate: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])
    normal: float = 0.0
    tangential: float = 0.0
    phi: float = 0.0
    radius_m: float = math.inf
    gap_m: float = math.inf
    slides: bool = False
    friction: float = 0.0
    joint_force: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])
    stretch: float = 0.0
    side: int = 0

    @property
    def centre(self) -> tuple[float, float]:
        """Return the finger's centre [m, m]."""
        x, y, th = self.place
        return x + self.mount.link_m * math.cos(th), y + self.mount.link_m * math.sin(th)


@dataclass(frozen=True, slots=True)
class Body:
    """An object on the platen.

    Args:
        outline: its shape.
        mass: [kg].
        platen_friction: coefficient on the platen.
    """

    outline: Outline
    mass: float = 0.1
    platen_friction: float = 0.2

    def __post_init__(self) -> None:
        for name, (least, most) in _BODIES.items():
            value = getattr(self, name)
            if not least <= value <= most:
                raise ValueError(f"describe object: {name} is {value:g}; want {least:g} to {most:g}")
        reach, narrow = self.outline.reach_m, self.outline.narrowest_m
        if not reach <= FARTHEST_M:
            raise ValueError(
                f"describe object: it reaches {reach:.3g} m from its centroid; want at most {FARTHEST_M:g} m, which a "
                "platen of 0.8 m by 1.2 m holds"
            )
        if not narrow >= NARROWEST_M:
            raise ValueError(
                f"describe object: it is {narrow:.3g} m wide where it is narrowest; want at least {NARROWEST_M:g} m, "
                "or rubber fingers would touch each other round it"
            )


class World:
    """Integrate one object and its fingers.

    Args:
        body: the object.
        mounts: of the fingers.
        joints: x, y, th of each finger's joints at the start, [m, m, rad]; at rest.
        pose: of the object at the start.
        rubber: of all fingers.

    Attributes:
        fingers: their states.
        pose, speed: of the object, x, y [m], angle [rad].
        lifted: whether the object is off the platen, where no finger meets it.
        time_s: gone so far.

    Raises:
        ValueError: not three joints for each mount.

    Concurrency: one caller at a time.
    """

    def __init__(
        self,
        body: Body,
        mounts: Sequence[Mount],
        joints: Sequence[Sequence[float]],
        pose: Sequence[float] = (0.0, 0.0, 0.0),
        rubber: Skin | None = None,
    ) -> None:
        if len(mounts) != len(joints) or any(len(joint) != 3 for joint in joints):
            raise ValueError(f"build world: joints {joints} for {len(mounts)} mounts; want x, y, th for each")
        self.body = body
        self.skin = skin() if rubber is None else rubber
        self.fingers = [
            Finger(mount, list(joint), command=list(joint)) for mount, joint in zip(mounts, joints, strict=True)
        ]
        self.pose, self.speed = list(pose), [0.0, 0.0, 0.0]
        self.lifted, self.time_s = False, 0.0
        outline = body.outline
        self._points: list[tuple[float, float]] = [(float(x), float(y)) for x, y in outline.points]
        self._inertia = body.mass * outline.gyration_m**2
        self._most_force = body.platen_friction * body.mass * GRAVITY
        self._most_moment = self._most_force * _mean_distance(outline)
        for finger in self.fingers:
            self._touch(finger, 0.0)

    def command(self, places: Sequence[Sequence[float]], time_s: float) -> None:
        """Let the joints' commands go evenly from where they are to `places` within `time_s` [s]."""
        for finger, place in zip(self.fingers, places, strict=True):
            finger.rate = [(to - now) / time_s for to, now in zip(place, finger.command, strict=True)]

    def place(self, joints: Sequence[Sequence[float]]) -> None:
        """Put the fingers, at rest, where their joints are."""
        for finger, joint in zip(self.fingers, joints, strict=True):
            finger.place, finger.command = list(joint), list(joint)
            finger.speed, finger.rate, finger.stretch = [0.0, 0.0, 0.0], [0.0, 0.0, 0.0], 0.0

    def shift(self, joints: Sequence[Sequence[float]]) -> None:
        """Move the joints' commands to where they are now, at once, and the fingers with them, at rest.

        Springs stay bent as they are: a finger that holds the object holds it on.
        """
        for finger, joint in zip(self.fingers, joints, strict=True):
            finger.place = [at + to - was for at, to, was in zip(finger.place, joint, finger.command, strict=True)]
            finger.command = list(joint)
            finger.speed, finger.rate = [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]

    def clearances(self, pose: Sequence[float] | None = None) -> list[float]:
        """Return how far each finger is from the object [m], below 0 where they overlap, even one inside the other.

        Args:
            pose: of the object; where it is now by default.
        """
        ox, oy, turn = self.pose if pose is None else pose
        corners = np.array(self._points)
        sides = np.roll(corners, -1, axis=0) - corners
        c, s = math.cos(turn), math.sin(turn)
        found = []
        for finger in self.fingers:
            dx, dy = finger.centre[0] - ox, finger.centre[1] - oy
            way = np.array([c * dx + s * dy, c * dy - s * dx]) - corners
            share = np.clip(np.einsum("ij,ij->i", way, sides) / np.einsum("ij,ij->i", sides, sides), 0.0, 1.0)
            apart = float(np.min(np.linalg.norm(way - share[:, None] * sides, axis=1)))
            inside = bool(np.all(sides[:, 0] * way[:, 1] - sides[:, 1] * way[:, 0] > 0.0))
            found.append((-apart if inside else apart) - self.skin.outer_m)
        return found

    def lift(self) -> None:
        """Take the object off the platen: fingers meet nothing."""
        self.lifted, self.speed = True, [0.0, 0.0, 0.0]
        for finger in self.fingers:
            self._touch(finger, 0.0)

    def lay(self, pose: Sequence[float]) -> None:
        """Lay the object on the platen, at rest."""
        self.lifted, self.pose, self.speed = False, list(pose), [0.0, 0.0, 0.0]
        for finger in self.fingers:
            self._touch(finger, 0.0)

    def advance(self, time_s: float, steps: int) -> None:
        """Go on by `time_s` in equal steps; 0.25 ms or less follow the stiffest contacts."""
        h = time_s / steps
        for _ in range(steps):
            self._step(h)
        self.time_s += time_s

    @property
    def energy(self) -> float:
        """Return the kinetic energy and that of joints, contacts and bristles [J]."""
        vx, vy, w = self.speed
        total = 0.5 * self.body.mass * (vx * vx + vy * vy) + 0.5 * self._inertia * w * w
        for finger in self.fingers:
            m, (fx, fy, turn) = finger.mount, finger.speed
            total += 0.5 * m.mass * (fx * fx + fy * fy) + 0.5 * m.inertia * turn * turn
            ex, ey, et = (c - p for c, p in zip(finger.command, finger.place, strict=True))
            total += 0.5 * m.stiffness * (ex * ex + ey * ey) + 0.5 * m.turn_stiffness * et * et
            chord, area, *_ = self._overlap(finger)
            if chord > 0.0:
                depth = 0.75 * area / chord
                radius = 0.5 * chord * chord / depth
                total += self.skin.stored(depth, radius) * m.length_m
                total += 0.5 * self.skin.press(depth, radius)[2] * m.length_m * finger.stretch**2
        return total

    def _step(self, h: float) -> None:
        half, body, speed, pose = 0.5 * h, self.body, self.speed, self.pose
        pose[0] += half * speed[0]
        pose[1] += half * speed[1]
        pose[2] += half * speed[2]
        fx = fy = moment = 0.0
        for finger in self.fingers:
            place, rate, command, own = finger.place, finger.speed, finger.command, finger.rate
            for i in (0, 1, 2):
                place[i] += half * rate[i]
                command[i] += half * own[i]
            px, py, at_x, at_y = self._touch(finger, h)
            fx += px
            fy += py
            moment += (at_x - pose[0]) * py - (at_y - pose[1]) * px
            self._push(finger, px, py, at_x, at_y, h)
            for i in (0, 1, 2):
                place[i] += half * rate[i]
                command[i] += half * own[i]
        self._slide(
            speed[0] + h * fx / body.mass, speed[1] + h * fy / body.mass, speed[2] + h * moment / self._inertia, h
        )
        pose[0] += half * speed[0]
        pose[1] += half * speed[1]
        pose[2] += half * speed[2]

    def _push(self, finger: Finger, px: float, py: float, at_x: float, at_y: float, h: float) -> None:
        """Change a finger's velocity by its springs and the contact's reaction; damping by the trapezoidal rule."""
        m, place, speed, force = finger.mount, finger.place, finger.speed, finger.joint_force
        twist = -((at_x - place[0]) * py - (at_y - place[1]) * px)
        for i, stiff, mass, load in (
            (0, m.stiffness, m.mass, -px),
            (1, m.stiffness, m.mass, -py),
            (2, m.turn_stiffness, m.inertia, twist),
        ):
            spring = stiff * (finger.command[i] - place[i])
            damping = 2.0 * m.damping_ratio * math.sqrt(stiff * mass)
            share = 0.5 * h * damping / mass
            past = speed[i] - finger.rate[i]
            after = (past * (1.0 - share) + h * (spring + load) / mass) / (1.0 + share)
            force[i] = -spring + damping * 0.5 * (past + after)
            speed[i] = after + finger.rate[i]

    def _slide(self, vx: float, vy: float, w: float, h: float) -> None:
        """Take the platen's friction from the object's velocity, at most all of it."""
        force, turning, mass, inertia = self._most_force, self._most_moment, self.body.mass, self._inertia
        speed = self.speed
        if force > 0.0:
            needed = (mass * mass * (vx * vx + vy * vy)) / (force * force) + (inertia * w / turning) ** 2
            if needed <= h * h:
                speed[0] = speed[1] = speed[2] = 0.0
                return
            whole = math.sqrt(force * force * (vx * vx + vy * vy) + turning * turning * w * w)
            keep = 1.0 - min(1.0, h * force * force / (whole * mass))
            vx, vy, w = vx * keep, vy * keep, w * (1.0 - min(1.0, h * turning * turning / (whole * inertia)))
        speed[0], speed[1], speed[2] = vx, vy, w

    def _touch(self, finger: Finger, h: float) -> tuple[float, float, float, float]:
        """Find a finger's contact; return the force on the object [N, N] and where it acts [m, m]."""
        chord, area, angle, reach, cx, cy = self._overlap(finger)
        phi = math.remainder(angle - finger.place[2], math.tau)
        rolled, finger.phi = math.remainder(phi - finger.phi, math.tau), phi
        if chord <= 0.0:
            finger.normal = finger.tangential = finger.stretch = 0.0
            finger.gap_m, finger.slides, finger.radius_m = reach, False, math.inf
            return 0.0, 0.0, cx, cy
        m = finger.mount
        depth = 0.75 * area / chord
        radius = 0.5 * chord * chord / depth
        load, width, shear = self.skin.press(depth, radius)
        nx, ny = math.cos(angle), math.sin(angle)
        at_x, at_y = cx + reach * nx, cy + reach * ny
        # the finger's surface there against the object's
        speed, own, pose = finger.speed, self.speed, self.pose
        ux = speed[0] - speed[2] * (at_y - finger.place[1]) - own[0] + own[2] * (at_y - pose[1])
        uy = speed[1] + speed[2] * (at_x - finger.place[0]) - own[1] - own[2] * (at_x - pose[0])
        closing, across = ux * nx + uy * ny, uy * nx - ux * ny
        normal = m.length_m * load * max(0.0, 1.0 + m.loss_s * closing)
        stiff = m.length_m * shear
        coefficient = m.coefficient(radius, normal)
        stretch = finger.stretch
        if m.creep:
            stretch *= math.exp(-abs(rolled) * reach * width * shear / (2.0 * radius * load))
        middle = stretch + 0.5 * h * across
        tangential = stiff * (middle + m.shear_loss_s * across)
        stretch += h * across
        most = coefficient * normal
        finger.slides = abs(tangential) > most
        if finger.slides:
            tangential = math.copysign(most, tangential)
        held = coefficient * m.length_m * load / stiff
        finger.stretch = min(max(stretch, -held), held)
        finger.normal, finger.tangential, finger.friction, finger.gap_m = normal, tangential, coefficient, -depth
        bend = 1.0 / radius - 1.0 / self.skin.outer_m  # below 1/m it is the arc's difference from its parabola
        finger.radius_m = 1.0 / bend if bend > 1.0 else math.inf
        return normal * nx - tangential * ny, normal * ny + tangential * nx, at_x, at_y

    def _overlap(self, finger: Finger) -> tuple[float, float, float, float, float, float]:
        """Return half chord [m], area [m^2], direction of the normal [rad], distance of the contact from the finger's
        centre [m] and that centre [m, m]; without contact a half chord of 0, and the clearance for the distance.
        """
        points, (ox, oy, turn), rb = self._points, self.pose, self.skin.outer_m
        cx, cy = finger.centre
        if self.lifted:
            return 0.0, 0.0, finger.phi + finger.place[2], LOST, cx, cy
        c, s = math.cos(turn), math.sin(turn)
        dx, dy = cx - ox, cy - oy
        u, v = c * dx + s * dy, c * dy - s * dx
        count, at = len(points), finger.side
        came = seen = 0
        while True:  # the side that is nearest to the centre: downhill along the convex outline
            ax, ay = points[at]
            bx, by = points[at + 1 - count]
            ex, ey = bx - ax, by - ay
            along = (u - ax) * ex + (v - ay) * ey
            square = ex * ex + ey * ey
            if came > 0 and along < 0.0:  # a corner between two sides, of which it sees one from behind if it is sharp
                fx, fy = ax, ay
                break
            if came < 0 and along > square:
                fx, fy = bx, by
                break
            if seen < count and ex * (v - ay) - ey * (u - ax) > 0.0:  # it shows this side its back
                came, at, seen = 0, (at + 1) % count, seen + 1
                continue
            if along < 0.0:
                came, at = -1, (at - 1) % count
                continue
            if along > square:
                came, at = 1, (at + 1) % count
                continue
            fx, fy = ax + along / square * ex, ay + along / square * ey
            break
        finger.side = at
        gx, gy = fx - u, fy - v
        apart = gx * gx + gy * gy
        limit = rb * rb
        if apart >= limit:
            return 0.0, 0.0, turn + math.atan2(gy, gx), math.sqrt(apart) - rb, cx, cy
        # from the foot along the outline both ways, until it leaves the finger
        lx, ly, area = gx, gy, 0.0
        place = at + 1
        while True:
            qx, qy = points[place % count]
            qx, qy = qx - u, qy - v
            if qx * qx + qy * qy >= limit or place > at + count:
                break
            area += (lx - gx) * (qy - gy) - (ly - gy) * (qx - gx)
            lx, ly, place = qx, qy, place + 1
        right_x, right_y = _crossing(lx, ly, qx, qy, limit)
        area += (lx - gx) * (right_y - gy) - (ly - gy) * (right_x - gx)
        lx, ly, place = gx, gy, at
        while True:
            qx, qy = points[place]
            qx, qy = qx - u, qy - v
            if qx * qx + qy * qy >= limit or place < at - count + 1:
                break
            area -= (lx - gx) * (qy - gy) - (ly - gy) * (qx - gx)
            lx, ly, place = qx, qy, place - 1
        left_x, left_y = _crossing(lx, ly, qx, qy, limit)
        area -= (lx - gx) * (left_y - gy) - (ly - gy) * (left_x - gx)
        # close by the chord: the cap between outline and chord, then the finger's segment beyond it
        area += (right_x - gx) * (left_y - gy) - (right_y - gy) * (left_x - gx)
        cap = 0.5 * area
        mx, my = 0.5 * (left_x + right_x), 0.5 * (left_y + right_y)
        chord = 0.5 * math.hypot(right_x - left_x, right_y - left_y)
        if chord < 1e-9:
            return 0.0, 0.0, turn + math.atan2(gy, gx), 0.0, cx, cy
        deep = math.hypot(mx, my)
        segment = limit * math.atan2(chord, deep) - chord * deep
        return chord, cap + segment, turn + math.atan2(my, mx), deep - 0.5 * cap / chord, cx, cy


def _between(curve: Sequence[tuple[float, float]], at: float) -> float:
    """Return the value of a curve of points, beyond its ends that of the end."""
    if at <= curve[0][0]:
        return curve[0][1]
    for (low, first), (high, last) in pairwise(curve):
        if at < high:
            return first + (last - first) * (at - low) / (high - low)
    return curve[-1][1]


def _crossing(ax: float, ay: float, bx: float, by: float, limit: float) -> tuple[float, float]:
    """Return where the line from a within the circle about the origin to b outside crosses it."""
    ex, ey = bx - ax, by - ay
    square = ex * ex + ey * ey
    if square == 0.0:
        return ax, ay
    along, inside = ax * ex + ay * ey, limit - ax * ax - ay * ay
    share = (-along + math.sqrt(max(along * along + square * inside, 0.0))) / square
    return ax + share * ex, ay + share * ey


def _mean_distance(outline: Outline) -> float:
    """Return the mean distance of the area from the centroid [m], triangle by triangle about the centroid."""
    p = outline.points
    q = np.roll(p, -1, axis=0)
    weight = p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]
    node, share = np.polynomial.legendre.leggauss(8)
    ray = sum(0.5 * s * np.hypot(*(p + 0.5 * (1.0 + n) * (q - p)).T) for n, s in zip(node, share, strict=True))
    return float(np.sum(weight * ray) / np.sum(weight) * 2.0 / 3.0)
