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

The steps are in ``planar_step``, compiled where they can be: they run some ten thousand times a second.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sioms.plant.outline import Outline
from sioms.plant.planar_step import AREA, FINGERS, FOUND, LENGTH, Plane, advance_plane, overlap_of, touch_object
from sioms.plant.skin import FRICTION, Skin, skin

GRAVITY = 9.80665

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
        self._make_plane()
        self._look()

    def _make_plane(self) -> None:
        self._state = np.zeros(FINGERS + LENGTH * len(self.fingers))
        self._plane = _plane(self.body, [finger.mount for finger in self.fingers], self.skin, self._state)

    def __getstate__(self) -> dict[str, Any]:
        """Return all but what steps work on, which is made anew: copies are worlds of their own."""
        return {name: value for name, value in vars(self).items() if name not in ("_plane", "_state")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Take what `__getstate__` returned."""
        vars(self).update(state)
        self._make_plane()

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
        corners = self.body.outline.points
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
        self._look()

    def lay(self, pose: Sequence[float]) -> None:
        """Lay the object on the platen, at rest."""
        self.lifted, self.pose, self.speed = False, list(pose), [0.0, 0.0, 0.0]
        self._look()

    def advance(self, time_s: float, steps: int) -> None:
        """Go on by `time_s` in equal steps; 0.25 ms or less follow the stiffest contacts."""
        self._put()
        advance_plane(self._plane, time_s / steps, steps)
        self._take()
        self.time_s += time_s

    @property
    def energy(self) -> float:
        """Return the kinetic energy and that of joints, contacts and bristles [J]."""
        vx, vy, w = self.speed
        total = 0.5 * self._plane.mass * (vx * vx + vy * vy) + 0.5 * self._plane.inertia * w * w
        self._put()
        for i, finger in enumerate(self.fingers):
            m, (fx, fy, turn) = finger.mount, finger.speed
            total += 0.5 * m.mass * (fx * fx + fy * fy) + 0.5 * m.inertia * turn * turn
            ex, ey, et = (c - p for c, p in zip(finger.command, finger.place, strict=True))
            total += 0.5 * m.stiffness * (ex * ex + ey * ey) + 0.5 * m.turn_stiffness * et * et
            chord = overlap_of(self._plane, i)
            if chord > 0.0:
                depth = 0.75 * self._plane.found[AREA] / chord
                radius = 0.5 * chord * chord / depth
                total += self.skin.stored(depth, radius) * m.length_m
                total += 0.5 * self.skin.press(depth, radius)[2] * m.length_m * finger.stretch**2
        return total

    def _look(self) -> None:
        """Find the contacts as they are now."""
        self._put()
        for i in range(len(self.fingers)):
            touch_object(self._plane, i, 0.0)
        self._take()

    def _put(self) -> None:
        """Hand the state to the steps."""
        state = [*self.pose, *self.speed]
        for one in self.fingers:
            state += (
                *one.place, *one.speed, *one.command, *one.rate, one.normal, one.tangential, one.phi, one.radius_m,
                one.gap_m, one.slides, one.friction, one.stretch, one.side, *one.joint_force,
            )  # fmt: skip
        self._state[:] = state
        self._plane.lifted = int(self.lifted)

    def _take(self) -> None:
        """Take the state from the steps."""
        state = self._state.tolist()
        self.pose, self.speed = state[:3], state[3:6]
        for at, one in zip(range(FINGERS, len(state), LENGTH), self.fingers, strict=True):
            one.place, one.speed, one.command, one.rate = (state[at + i : at + i + 3] for i in (0, 3, 6, 9))
            one.normal, one.tangential, one.phi, one.radius_m, one.gap_m, slides, one.friction, one.stretch, side = (
                state[at + 12 : at + 21]
            )
            one.slides, one.side, one.joint_force = slides > 0.0, int(side), state[at + 21 : at + 24]


def _plane(body: Body, mounts: Sequence[Mount], rubber: Skin, state: NDArray[np.float64]) -> Plane:
    """Return what the steps work on."""
    rows, load, factor = list[float](), list[float](), list[float]()
    for mount in mounts:
        own = mount.friction_by_load
        springs = (number for spring in mount.springs for number in spring)
        rows += (
            mount.link_m, *springs, mount.length_m, -1.0 if mount.friction is None else mount.friction, mount.loss_s,
            mount.shear_loss_s, mount.creep, len(load), len(load) + len(own),
        )  # fmt: skip
        load += (at for at, _ in own)
        factor += (share for _, share in own)
    most = body.platen_friction * body.mass * GRAVITY
    bend, rubbing = np.array(FRICTION).T
    tables = {name: np.array(getattr(rubber, name)) for name in ("product", "half_width", "shear")}
    return Plane(
        fingers=len(mounts), points=len(body.outline.points), lifted=0, rows=len(rubber.product), bends=len(FRICTION),
        mass=float(body.mass), inertia=float(body.mass * body.outline.gyration_m**2), most_force=float(most),
        most_moment=float(most * _mean_distance(body.outline)), outer_m=float(rubber.outer_m),
        per_row=float(rubber.step), outline=np.ascontiguousarray(body.outline.points, dtype=np.float64).reshape(-1),
        state=state, mounts=np.array(rows, dtype=np.float64), found=np.zeros(FOUND),
        bend=bend.copy(), rubbing=rubbing.copy(), load=np.array(load), factor=np.array(factor), **tables,
    )  # fmt: skip


def _mean_distance(outline: Outline) -> float:
    """Return the mean distance of the area from the centroid [m], triangle by triangle about the centroid."""
    p = outline.points
    q = np.roll(p, -1, axis=0)
    weight = p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]
    node, share = np.polynomial.legendre.leggauss(8)
    ray = sum(0.5 * s * np.hypot(*(p + 0.5 * (1.0 + n) * (q - p)).T) for n, s in zip(node, share, strict=True))
    return float(np.sum(weight * ray) / np.sum(weight) * 2.0 / 3.0)
