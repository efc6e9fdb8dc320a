"""Plans of regrasps alone: an object that stays where it is, closings by the statics of its contacts.

What a plan is worth does not need a world that moves: the object is fixed, each finger comes along the line of centres
until it bears the force of a touch, and feels the place and curvature that the contact has there, with the deviations
of the estimator. An object takes some 50 to 100 ms of a processor instead of 4 s.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from sioms.hand.around import Around
from sioms.hand.contacts import FINGER_M, Grasp, classify, grasp_of
from sioms.hand.kinematics import Hand, Six
from sioms.hand.regrasp import NEUTRAL, beside
from sioms.hand.seeking import Seeking, held_by
from sioms.hand.shape import Parallel, Touch
from sioms.hand.skills import Skills
from sioms.hand.touch import Felt, Manner, Reading, Sensed
from sioms.hand.trials import Subject
from sioms.plant.planar import Body, Mount, World

_PLACE = math.radians(0.03)  # deviation of an average place
_LIGHT_BEND, _BEND = 4.0, 0.6  # of a flat contact's curvature, touched lightly and squeezed [1/m]
_TAP_N, _TAP_RAD, _TAP_M = 0.05, math.radians(0.15), 1e-5  # of one finger alone: force, place and axes
_FAR_M, _NEAR_M = 0.15, -0.1
_HALVINGS, _INSTANT_S = 22, 1e-9


@dataclass(frozen=True, slots=True)
class Planned:
    """What the plans came to; immutable.

    Args:
        etas: true max |eta| of the first touch and after each regrasp [rad]; infinite where nothing is met.
        rolls: whether the skill would have rolled it instead of the first regrasp.
    """

    etas: tuple[float, ...]
    rolls: bool


def plan_regrasps(subject: Subject, seed: int = 0, steps: int = 2, manner: Manner | None = None) -> Planned:
    """Touch an object and regrasp it, as `Skills` plans it, at most `steps` times.

    Args:
        subject: of a draw.
        seed: of the noise.
        steps: regrasps.
        manner: of the skills.
    """
    manner = manner or Manner()
    object_, hand = _Still(subject, seed), Hand()
    joints = hand.inverse((0.0, 0.0, 0.0, _FAR_M, NEUTRAL, NEUTRAL))
    skills = _Planner(hand, Reading(0.0, joints, (Felt(False), Felt(False))), manner)
    found = object_.touch(0.0, 0.0, 0.0, manner)
    if found is None:
        return Planned((math.inf,), False)
    etas = [found[0].quality]
    rolls = found[1].force > manner.light_n and skills.would_roll(found[1])
    for _ in range(steps):
        if etas[-1] < manner.held_rad - 3.0 * _PLACE:
            break
        target = skills.after(found[1])
        found = object_.touch(*target[:3], manner)
        if found is None:
            etas.append(math.inf)
            break
        etas.append(found[0].quality)
    return Planned(tuple(etas), rolls)


def feel_round(subject: Subject, pairs: int, seed: int = 0, regrasps: int = 2) -> tuple[float, int]:
    """Touch an object that does not move with one finger at a time, as `Skills` does between grasps, and squeeze it.

    Return the true max |eta| [rad] after at most so many regrasps, squeezed, and how many pairs of touches that took.

    Args:
        subject: of a draw.
        pairs: at most so many after the first.
        seed: of the noise.
        regrasps: the first one goes where touches are parallel, each other one as the squeezed fingers tell.
    """
    object_, manner = _Still(subject, seed), Manner()
    seeking = Seeking(around := Around())
    one: Parallel | None = Parallel(0.0, 0.0, 0.0, 0.0, math.inf)
    many = -1  # after the first
    while one is not None and many < pairs:
        many += 1
        touches = object_.tap(one.x, one.y, one.direction)
        psi = one.direction
        if touches:
            around.add(touches, one.x, one.y, psi)
            psi = held_by(touches)[1][2]
            if seeking.is_done(touches, one):
                break
        else:
            around.missed(one.x, one.y, psi)
            seeking.missed()
        one = seeking.next(psi)
    found = seeking.found or (0.0, 0.0, 0.0)
    held = object_.touch(*found, manner)
    for _ in range(regrasps - 1):
        if held is None or held[0].quality < manner.held_rad - 3.0 * _PLACE:
            break
        held = object_.touch(*beside(held[1].grasp, held[1].curvatures)[:3], manner)
    return (math.inf if held is None else held[0].quality), many


class _Planner(Skills):
    """Plans without moving."""

    def would_roll(self, found: Sensed) -> bool:
        return self._can_roll(found)

    def after(self, found: Sensed) -> Six:
        self._past.append(found)
        self.regrasps += 1
        return self.plan(found)


class _Still:
    """An object that does not move, and two fingers without links."""

    def __init__(self, subject: Subject, seed: int) -> None:
        mount = Mount(link_m=0.0)
        self._subject = subject
        self._world = World(Body(subject.outline), [mount, mount], [[-0.3, 0.0, 0.0], [0.3, 0.0, 0.0]], subject.pose)
        self._random = np.random.default_rng([seed, subject.number])

    def touch(self, x: float, y: float, psi: float, manner: Manner) -> tuple[Grasp, Sensed] | None:
        """Close about a place; squeeze what a skill would. Return the true grasp and what is sensed of it."""
        found = self._close(x, y, psi, manner.light_n, _LIGHT_BEND)
        if found is None or found[0].quality > manner.squeeze_rad:
            return found
        return self._close(x, y, psi, manner.force_n, _BEND)

    def tap(self, x: float, y: float, psi: float) -> list[Touch]:
        """Touch with both fingers, one after the other; return what is felt, nothing where one of them passes."""
        for index, sign in enumerate((-1.0, 1.0)):
            if not self._press(index, x, y, psi, sign, _TAP_N):
                return []
        one, two = self._world.fingers
        turn, place = self._random.normal(0.0, _TAP_RAD, 2), self._random.normal(0.0, _TAP_M, 4)
        first = one.centre[0] + place[0], one.centre[1] + place[1]
        second = two.centre[0] + place[2], two.centre[1] + place[3]
        held = grasp_of(first, second, one.phi + turn[0], two.phi + turn[1])
        contacts = ((held.contact1, held.normal1), (held.contact2, held.normal2))
        return [Touch(at, normal + math.pi, math.inf, math.inf) for at, normal in contacts]

    def _close(self, x: float, y: float, psi: float, force: float, spread: float) -> tuple[Grasp, Sensed] | None:
        for index, sign in enumerate((-1.0, 1.0)):
            if not self._press(index, x, y, psi, sign, force):
                return None
        one, two = self._world.fingers
        true = grasp_of(one.centre, two.centre, one.phi, two.phi)
        noise = self._random.normal(0.0, _PLACE, 2)
        held = grasp_of(one.centre, two.centre, one.phi + noise[0], two.phi + noise[1])
        bends, spreads = [], []
        for finger in (one, two):
            bend = 1.0 / finger.radius_m
            spreads.append(spread * (1.0 + bend * FINGER_M) ** 2)
            told = 1.0 / (bend + 1.0 / FINGER_M)  # R, of which a corner's is told to a fifth
            told *= 1.0 + float(self._random.normal(0.0, min(spreads[-1] * told, 0.2)))
            bends.append(1.0 / max(told, 1e-6) - 1.0 / FINGER_M)
        places = NEUTRAL - held.eta1, NEUTRAL - held.eta2
        likeness = classify(held.eta1, held.eta2, _PLACE)
        return true, Sensed(held, _PLACE, (bends[0], bends[1]), (spreads[0], spreads[1]), places, force, likeness)

    def _press(self, index: int, x: float, y: float, psi: float, sign: float, force: float) -> bool:
        """Bring a finger along the line until it bears the force; return whether it met the object."""
        finger, u, v = self._world.fingers[index], sign * math.cos(psi), sign * math.sin(psi)
        out = _FAR_M
        while True:
            px, py = self._subject.outline.nearest(self._subject.pose, x + out * u, y + out * v)
            gap = math.hypot(px - x - out * u, py - y - out * v) - FINGER_M
            if gap < 1e-6:
                break
            out -= 0.999 * gap
            if out < _NEAR_M:
                return False
        low, high = out - 2e-3, out + 1e-4
        for _ in range(_HALVINGS):
            middle = 0.5 * (low + high)
            joints = [list(one.place) for one in self._world.fingers]
            joints[index] = [x + middle * u, y + middle * v, 0.0]
            self._world.place(joints)
            self._world.advance(_INSTANT_S, 1)
            if finger.normal > force:
                low = middle
            else:
                high = middle
        return finger.normal > 0.0
