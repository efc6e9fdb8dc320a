"""What the simulation believes about a hand, and what a recorded grasp should look like by it.

From what the encoders and the fingers say follows where the fingers are: behind the springs of the joints, which the
forces of the grasp bend, at the end of the links, turned as the fingers are mounted. Two contacts on one object must
then agree with its size. Forces go along the line through both contacts, unless the wrists tell them.

Sign conventions: a force is that of the object on a finger; torques are about the revolute axis, anti-clockwise.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from sioms.reconcile.hand.grasps import BAR, DISK, Floats, Grasps

ROUNDS = 10
DONE_NM = 1e-8  # change of torques in a round [N m] after which there is no further one
SHRINKS, STILL_NM = 0.5, 1e-5  # share by which each round must be nearer, and torque [N m] that counts as none
STEEPEST = 1.25  # friction angle [rad] up to which a normal force tells the whole one: the atan of 3
#: Says by parameters how far links are turned and places of contact off [rad], and how much farther than the finger's
#: radius a contact lies [m], each shape (n, 2).
Response = Callable[["Touched", Grasps, Floats], tuple[Floats, Floats, Floats]]


@dataclass(frozen=True, slots=True, eq=False)
class HandBelief:
    """The hand as the simulation has it; immutable. Pairs are of finger 1 and finger 2.

    Attributes:
        link: from the revolute axis to the finger's centre [m]; finger: radius of the fingers [m].
        mount: angle by which the finger is turned on its link [rad].
        carriage: stiffness of x and y between encoder and finger [N/m]; inf where the encoder tells the finger's place.
        joint: stiffness of th between encoder and finger [N m/rad]; inf as above.
        drive: stiffness of th between command and encoder [N m/rad].
        gain: relative departure of the load that a finger tells.
        soft_load, soft: approach of finger and a flat [m] at line loads [N/m], rising from 0, 0.
        length: of the contact along a finger [m]; pitch: angle between elements of a finger [rad].
        bend, coefficient: coefficient of friction over 1/R of the contact [1/m].
        level, power, bow: relative departure of it, the power of the load in newtons that it goes with, and by which
            share of itself that power changes with the load's logarithm.
        responses: further changes with their parameters, in order.
    """

    link: Floats
    finger: float
    mount: Floats
    carriage: Floats
    joint: Floats
    drive: Floats
    gain: Floats
    soft_load: Floats
    soft: Floats
    length: float
    pitch: float
    bend: Floats
    coefficient: Floats
    level: float = 0.0
    power: float = 0.0
    bow: float = 0.0
    responses: tuple[tuple[Response, Floats], ...] = field(default=())

    def responding(self, response: Response, parameters: Floats) -> HandBelief:
        """Return the belief with one more response."""
        return replace(self, responses=(*self.responses, (response, parameters)))


@dataclass(frozen=True, slots=True, eq=False)
class Touched:
    """Where the fingers are in each grasp, shape (n, 2), vectors (n, 2, 2): grasp, finger, axis of the platen.

    Attributes:
        centre, contact: of each finger [m]; normal: direction out of the finger [rad].
        eta: friction angle [rad]; force: of the object on the finger [N]; torque: on the link [N m].
        press: normal force [N]; give: approach of the rubber [m].
    """

    centre: Floats
    contact: Floats
    normal: Floats
    eta: Floats
    force: Floats
    torque: Floats
    press: Floats
    give: Floats


@dataclass(frozen=True, slots=True, eq=False)
class Gaps:
    """By how much recorded grasps contradict a belief; nan where a row does not tell.

    Attributes:
        along, across: of two contacts and the object's size, along and across the line of contacts [m], shape (n,).
        normals: of the two sides of a bar [rad], shape (n,).
        drive: of each link's deflection between command and encoder [rad], shape (n, 2).
        balance: logarithm of the ratio of both fingers' forces, shape (n,).
        wrist: logarithm of the ratio of each finger's load and its wrist's, shape (n, 2).
        slip: logarithm of the ratio of the coefficients of friction, shape (n,).
    """

    along: Floats
    across: Floats
    normals: Floats
    drive: Floats
    balance: Floats
    wrist: Floats
    slip: Floats


def direction(angle: Floats) -> Floats:
    """Return unit vectors, shape (..., 2)."""
    return np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def wrapped(angle: Floats) -> Floats:
    """Return angles within -pi to pi."""
    return np.asarray((angle + np.pi) % (2.0 * np.pi) - np.pi)


def crossed(a: Floats, b: Floats) -> Floats:
    """Return the cross products of vectors in the plane."""
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])


def bend_of(b: HandBelief, g: Grasps) -> Floats:
    """Return 1/R of each grasp's contacts [1/m]: of finger and object; of a side and of what is not known, the
    finger's own, shape (n,).
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        own = np.where((g.kind == DISK) & g.known, 1.0 / g.size, 0.0)
    return np.asarray(1.0 / b.finger + own)


def approach(b: HandBelief, press: Floats, bend: Floats) -> Floats:
    """Return how far rubber gives [m]: P R is one curve of delta R for round contacts of any R."""
    share = 1.0 / (b.finger * bend[:, None])
    return np.asarray(np.interp(press / b.length * share, b.soft_load, b.soft) / share)


def touched(b: HandBelief, g: Grasps, stray: Floats | None = None) -> Touched:
    """Find the fingers of recorded grasps: forces bend the joints, and where the fingers are says how forces act.

    Args:
        stray: forces on the fingers that nothing tells [N], shape (n, 2, 2); none by default.
    """
    *_, out = _rounds(b, g, stray)
    return out


def settles(b: HandBelief, g: Grasps) -> NDArray[np.bool_]:
    """Say of which grasps forces and bent joints agree soon, shape (n,).

    Of the others a soft joint turns the line of force by as much as that line bends the joint: they tell nothing.
    """
    found = list(_rounds(b, g, None))
    steps = [np.abs(after.torque - before.torque).max(1) for before, after in pairwise(found)]
    nearer = [after <= SHRINKS * before + STILL_NM for before, after in pairwise(steps)]
    held = (np.abs(found[-1].eta) < STEEPEST).all(1) | g.weighed
    return np.asarray(np.all(nearer, axis=0) & held if nearer else held)


def _rounds(b: HandBelief, g: Grasps, stray: Floats | None) -> Iterator[Touched]:
    """Yield the fingers as they are found, nearer and nearer."""
    still = np.zeros((len(g), 2))
    loose = np.zeros((len(g), 2, 2)) if stray is None else stray
    out = _posed(b, g, loose, loose, still, (still, still, still))
    rigid = not (np.isfinite([*b.joint, *b.carriage]).any() or b.responses)
    if not rigid and not g.weighed.all():  # forces along the normals bend the joints nearly enough to begin with
        push = -out.press[..., None] * direction(out.normal)
        out = replace(out, force=push, torque=crossed(out.contact - g.joints.reshape(-1, 2, 3)[..., :2], push))
    for _ in range(1 if rigid else ROUNDS):
        changes = [still, still, still]
        for response, p in b.responses:
            changes = [a + c for a, c in zip(changes, response(out, g, p), strict=True)]
        before, out = out, _posed(b, g, loose, out.force, out.torque, (changes[0], changes[1], changes[2]))
        yield out
        if np.max(np.abs(out.torque - before.torque), initial=0.0) < DONE_NM:
            return


def _posed(
    b: HandBelief, g: Grasps, stray: Floats, force: Floats, torque: Floats, changes: tuple[Floats, Floats, Floats]
) -> Touched:
    """Pose the fingers under known forces and torques; return what these are then."""
    place, press = g.joints.reshape(-1, 2, 3), g.load / (1.0 + b.gain)
    give = approach(b, np.maximum(press, 0.0), bend_of(b, g))
    turn, at, longer = changes
    th = place[..., 2] + torque / b.joint + turn
    root = place[..., :2] + force / b.carriage[:, None]
    normal = th + g.place + b.mount + at
    centre = root + b.link[:, None] * direction(th)
    contact = centre + (b.finger - give + longer)[..., None] * direction(normal)
    way = line_of(g, contact, direction(normal))
    eta = wrapped(np.stack([way, way + np.pi], axis=1) - normal)
    lean = np.clip(eta, -STEEPEST, STEEPEST)  # no contact bears more
    by_line = -(press / np.cos(lean))[..., None] * direction(normal + lean)
    force = np.where(g.weighed[:, None, None], g.wrist, by_line) + stray
    return Touched(centre, contact, normal, eta, force, crossed(contact - root, force), press, give)


def line_of(g: Grasps, contact: Floats, n: Floats) -> Floats:
    """Return the direction of the line from contact 1 to contact 2 [rad]; on a disk the normals tell it, shape (n,).

    Contacts on a small disk are so near each other that what bends the joints turns the line through them much more.
    """
    line = np.where((g.kind == DISK)[:, None], n[:, 0] - n[:, 1], contact[:, 1] - contact[:, 0])
    return np.asarray(np.arctan2(line[:, 1], line[:, 0]))


def friction(b: HandBelief, press: Floats, bend: Floats) -> Floats:
    """Return the coefficient of friction at normal forces [N] and 1/R [1/m], shape (n,)."""
    table = np.interp(bend, b.bend, b.coefficient)
    size = np.log(np.maximum(press, 1e-6))
    return np.asarray(table * (1.0 + b.level) * np.exp(b.power * (1.0 + b.bow * size) * size))


def gaps(b: HandBelief, g: Grasps, axis: Floats | None = None, stray: Floats | None = None) -> Gaps:
    """Return by how much grasps contradict a belief.

    Args:
        axis: direction of the line of contacts to which along and across refer [rad]; that of the belief by default.
        stray: as of ``touched``.
    """
    t = touched(b, g, stray)
    axis = line_of(g, t.contact, direction(t.normal)) if axis is None else axis
    along, across = _closure(t, g, axis)
    normals = np.where(g.kind == BAR, wrapped(t.normal[:, 0] - t.normal[:, 1] - np.pi), np.nan)
    th = g.joints.reshape(-1, 2, 3)[..., 2]
    told = np.where(g.told[:, None], g.command.reshape(-1, 2, 3)[..., 2], np.nan)
    drive = told - th + t.torque / b.drive
    with np.errstate(divide="ignore", invalid="ignore"):
        pressed = np.log(np.maximum(t.press, 1e-9))
        whole = pressed - np.log(np.cos(np.clip(t.eta, -STEEPEST, STEEPEST)))
        normal = np.einsum("nij,nij->ni", -t.force, direction(t.normal))
        shear = np.abs(crossed(direction(t.normal), -t.force))
        wrist = np.where(g.weighed[:, None], pressed - np.log(np.maximum(normal, 1e-9)), np.nan)
        balance = np.where(g.weighed, np.nan, whole[:, 0] - whole[:, 1])
        slip = _slip(b, g, t, np.log(np.maximum(shear, 1e-9) / np.maximum(normal, 1e-9)))
    return Gaps(along, across, normals, drive, balance, wrist, slip)


def _closure(t: Touched, g: Grasps, axis: Floats) -> tuple[Floats, Floats]:
    """Return the gaps along and across."""
    n = direction(t.normal)
    line = t.contact[:, 1] - t.contact[:, 0]
    disk = line + g.size[:, None] * (n[:, 1] - n[:, 0])
    e = direction(axis)
    mean = n[:, 0] - n[:, 1]
    mean = mean / np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-9)
    bar = np.einsum("ij,ij->i", line, mean) - g.size
    along = np.where(g.kind == DISK, np.einsum("ij,ij->i", disk, e), np.where(g.kind == BAR, bar, np.nan))
    return along, np.where(g.kind == DISK, crossed(e, disk), np.nan)


def _slip(b: HandBelief, g: Grasps, t: Touched, ratio: Floats) -> Floats:
    """Return the gaps of friction, where a finger begins to slide."""
    row, which = np.arange(len(g)), np.maximum(g.slip - 1, 0).astype(np.int64)
    own = friction(b, t.press[row, which], bend_of(b, g))
    return np.where(g.slip > 0, ratio[row, which] - np.log(own), np.nan)
