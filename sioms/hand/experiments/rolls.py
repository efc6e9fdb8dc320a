"""Rolling a disk or a rectangle at constant speed until it is held parallel, in the plane and rigidly."""

from __future__ import annotations

import math
from collections.abc import Generator
from dataclasses import dataclass, field

from sioms.hand.contacts import Likeness
from sioms.hand.experiments.starts import Start
from sioms.hand.kinematics import Hand
from sioms.hand.plane import PlaneHand, Rig
from sioms.hand.regrasp import NEUTRAL
from sioms.hand.rolling import RigidGrasp, disk_time, rectangle_time, rolling_law
from sioms.hand.skills import Skills
from sioms.hand.touch import Manner, Reading, Setpoint, State
from sioms.plant.outline import disk, rectangle
from sioms.plant.planar import Mount

SPEED = math.radians(5.0)
FORCE_N = 0.5
_FINE_M, _ENDLESS_M = 1e-8, 1.0  # of a rigid disk's polygon, and a rectangle without corners
_SHARE = 0.2  # of a new friction angle in the filtered one
MIDDLE = math.radians(82.0)
"""Place on the finger about which a roll is laid."""
MOST_LINK, MOST_TRAVEL = math.radians(100.0), math.radians(80.0)
"""How far a link turns and a contact moves at most: beyond, links point along the line of contacts, or arrays end."""


class ConstantSpeed(Skills):
    """Rolls by the source's laws: |phi'| constant until the friction angle is 0."""

    def roll_evenly(self, likeness: Likeness) -> Generator[Setpoint, Reading, None]:
        """Roll by the law of a class until the friction angle of finger 1, as it is felt, has changed its sign."""
        self.state = State.ROLL
        before = self._seen()
        rates = rolling_law(likeness, before.eta1, before.eta2, SPEED)
        felt = before.eta1
        while felt * before.eta1 > 0.0:
            yield from self._tick(rates)
            felt += _SHARE * (self._seen().eta1 - felt)
        self.state = State.HOLD


def closed_form(start: Start, speed: float = SPEED) -> float:
    """Return how long the roll takes by the closed form [s]."""
    if start.likeness is Likeness.DISK:
        return disk_time(start.eta, start.size_m, speed)
    return rectangle_time(start.tilt, start.size_m, speed)


def fits_the_arrays(start: Start) -> bool:
    """Return whether the links and the arrays reach far enough for it."""
    return start.travel <= MOST_TRAVEL and closed_form(start) * SPEED <= MOST_LINK


def rigid_time(start: Start, reversed_sign: bool = False) -> float:
    """Return how long rigid fingers take [s], by the integrator that knows the no-slip equations only.

    Args:
        start: of the roll.
        reversed_sign: take the friction angles with the other sign; the laws then diverge.

    Raises:
        ValueError: it does not become parallel in three times the closed form's time.
    """
    hand = Hand()
    first = [0.0, 0.0, 0.0, start.distance_m, NEUTRAL, NEUTRAL]
    disk_like = start.likeness is Likeness.DISK
    outline = disk(start.size_m, _FINE_M) if disk_like else rectangle(start.size_m, _ENDLESS_M)
    held = RigidGrasp(outline, hand, first, list(start.pose))
    seen = held.grasp()
    sign = -1.0 if reversed_sign else 1.0
    rates = rolling_law(start.likeness, sign * seen.eta1, sign * seen.eta2, SPEED)
    return held.roll_until_parallel((0.0, 0.0, 0.0, 0.0, *rates), (1.2 if reversed_sign else 3.0) * closed_form(start))


@dataclass(slots=True)
class Rolled:
    """A roll in the plane.

    Attributes:
        first: true friction angle of finger 1 when the roll began [rad].
        time_s: until the sensors told that it was 0.
        expected_s: by the closed form, from `first`.
        last: true max |eta| in the end [rad].
        trace: time [s], true eta 1 and 2 [rad], distance L of the contacts [m], place of contact on finger 1 [rad].
    """

    first: float
    time_s: float
    expected_s: float
    last: float
    trace: list[tuple[float, float, float, float, float]] = field(default_factory=list)


def places(start: Start) -> tuple[float, float]:
    """Return phi1 and phi2 [rad] from which the contacts roll about the middle of the arrays."""
    signs = (1.0, -1.0 if start.likeness is Likeness.DISK else 1.0)  # of the friction angles, against finger 1
    along = -1.0 if start.likeness is Likeness.DISK else 1.0
    eta = [sign * start.eta for sign in signs]
    one, two = (MIDDLE + angle - along * math.copysign(0.5 * start.travel, angle) for angle in eta)
    return one, two


def roll(start: Start, rig: Rig, seed: int = 0, friction: float | None = 2.0) -> Rolled:
    """Grasp an object in the plane and roll it at constant speed; raises as the skills do."""
    plane = start.plane(rig, Mount(friction=friction), seed, places(start))
    skills = ConstantSpeed(plane.hand, plane.reading, Manner(force_n=FORCE_N))
    plane.run(skills.grasp())
    truth = plane.truth()
    found = Rolled(truth.eta1, math.nan, closed_form(Start(start.likeness, start.size_m, truth.eta1)), math.nan)
    began = plane.world.time_s

    def look(hand: PlaneHand, _: Setpoint) -> None:
        if skills.state is not State.ROLL:
            return
        now, gone = hand.truth(), hand.world.time_s - began
        found.trace.append((gone, now.eta1, now.eta2, now.apart_m, hand.world.fingers[0].phi))

    plane.seen = look
    plane.run(skills.roll_evenly(start.likeness), 3.0 * found.expected_s)
    found.time_s, found.last = plane.world.time_s - began, plane.truth().quality
    return found
