"""Random convex objects under a hand that knows nothing of them: what becomes of each grasp.

Size, shape, friction and place are drawn; strain frames are noisy and estimated. Judged by the truth of the plane.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import ConvexHull

from sioms.hand.contacts import LEAST_FRICTION
from sioms.hand.plane import PlaneHand, Rig
from sioms.hand.skills import Skills
from sioms.hand.touch import Failed, Fault, Manner, State
from sioms.plant.outline import Outline, disk, ellipse, polygon, rectangle, spline
from sioms.plant.planar import Body, Mount

SHAPES = ("disk", "ellipse", "rectangle", "polygon", "spline")
FAMILIES = (*SHAPES, "hull")
"""Polygons have their corners on an ellipse; a hull is that of random points, a third of them with sharp corners."""
SURE = LEAST_FRICTION
"""Coefficient from which on nothing may be dropped."""
WITHIN_RAD = math.radians(1.0)
RIG = Rig(free_m=1e-3)
_MOST_TRIES = 200
_MOST_S = 400.0  # of its time


@dataclass(frozen=True, slots=True)
class Subject:
    """An object at a place; immutable.

    Args:
        number: of the draw.
        shape: its family.
        outline: of it.
        friction: coefficient at both fingers.
        pose: x, y [m], angle [rad].
    """

    number: int
    shape: str
    outline: Outline
    friction: float
    pose: tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Outcome:
    """What became of a grasp; immutable.

    Args:
        number, shape, friction: of the subject.
        first_rad: true max |eta| of the first touch.
        last_rad: true max |eta| in the end, while held.
        counted_rad: the same in the last grasp that was sensed after at most two regrasps or one roll.
        regrasps, rolls: made.
        held: whether it is truly held in the end.
        fault: by which the skill ended, if it did.
        dropped: whether a contact was truly lost while the skill meant to hold, and did not come back.
        warned: whether the skill had said so before, since it last closed; true if no contact was lost.
        time_s: simulated.
    """

    number: int
    shape: str
    friction: float
    first_rad: float
    last_rad: float
    counted_rad: float
    regrasps: int
    rolls: int
    held: bool
    fault: Fault | None
    dropped: bool
    warned: bool
    time_s: float


def draw(number: int, seed: int = 1, shapes: Sequence[str] = SHAPES) -> Subject:
    """Draw object `number`: width 20 to 80 mm, friction 0.8 to 3.4, any angle, up to 10 mm beside the hand's middle.

    Args:
        shapes: families, of which the objects are in turn.
    """
    random = np.random.default_rng([seed, number])
    shape = shapes[number % len(shapes)]
    size = float(random.uniform(0.02, 0.07))
    outline = _outline(shape, size, random)
    least = min(outline.width(math.radians(a)) for a in range(0, 180, 5))
    beside = min(0.010, 0.2 * least)
    x, y = random.uniform(-beside, beside, 2)
    return Subject(
        number,
        shape,
        outline,
        float(random.uniform(0.8, 3.4)),
        (float(x), float(y), float(random.uniform(0, math.tau))),
    )


def _outline(shape: str, size: float, random: np.random.Generator) -> Outline:
    if shape == "disk":
        return disk(0.5 * size)
    aspect = float(random.uniform(1.1, 2.0))
    long = min(aspect * size, 0.1)
    if shape == "ellipse":
        return ellipse(0.5 * long, 0.5 * size)
    if shape == "rectangle":
        return rectangle(long, size, float(random.uniform(0.5e-3, 3e-3)))
    for _ in range(_MOST_TRIES):
        if shape == "hull":
            found = _hull(0.5 * long, 0.5 * size, random)
            if _is_graspable(found):
                return found
            continue
        count = int(random.integers(3, 9)) if shape == "polygon" else int(random.integers(5, 9))
        turns = np.sort(random.uniform(0.0, math.tau, count)) if shape == "polygon" else (
            math.tau * (np.arange(count) + random.uniform(-0.15, 0.15, count)) / count
        )  # fmt: skip
        reach = random.uniform(0.85, 1.15, count) if shape == "spline" else np.ones(count)
        points = 0.5 * size * (reach * np.stack([aspect**0.5 * np.cos(turns), np.sin(turns)])).T
        try:
            found = polygon(points, float(random.uniform(0.5e-3, 3e-3))) if shape == "polygon" else spline(points)
        except ValueError:
            continue
        if _is_graspable(found):
            return found
    return ellipse(0.5 * long, 0.5 * size)


def _is_graspable(outline: Outline) -> bool:
    widths = [outline.width(math.radians(a)) for a in range(0, 180, 5)]
    return min(widths) > 0.015 and max(widths) < 0.1


def _hull(half_x_m: float, half_y_m: float, random: np.random.Generator) -> Outline:
    """Return the convex hull of random points in a rectangle, its corners sharp or rounded as far as they allow."""
    points = random.uniform(-1.0, 1.0, (int(random.integers(3, 13)), 2)) * [half_x_m, half_y_m]
    corners = points[ConvexHull(points).vertices]
    sharp, corner_m = random.random() < 1.0 / 3.0, float(random.uniform(0.2e-3, 3e-3))
    try:
        return polygon(corners, 0.0 if sharp else corner_m)
    except ValueError:  # a side is too short for that
        return polygon(corners)


def carry_out(subject: Subject, hold_s: float = 2.0, rig: Rig = RIG, manner: Manner = Manner()) -> Outcome:  # noqa: B008
    """Grasp an object, bring it into a parallel grasp and hold it; return what became of it."""
    hand = PlaneHand(Body(subject.outline), subject.pose, rig, Mount(friction=subject.friction), seed=subject.number)
    skills = Skills(hand.hand, hand.reading, manner)
    counted = lost_s = math.inf
    closed_s = 0.0
    seen: list[float] = []

    def look(hand: PlaneHand, _: object) -> None:
        nonlocal lost_s, closed_s
        if skills.state is State.CLOSE:
            closed_s = hand.world.time_s
        if hand.is_held() or skills.state in (State.CLOSE, State.OPEN, State.FEEL, State.REGRASP):
            lost_s = math.inf
        elif skills.holds and lost_s == math.inf:
            lost_s = hand.world.time_s

    def sensed() -> None:
        nonlocal counted
        truth = hand.truth().quality
        seen.append(truth)
        if (skills.regrasps <= 2 and not skills.rolls) or (skills.rolls == 1 and not skills.regrasps):
            counted = truth

    hand.seen, skills.sensed = look, sensed
    fault = None
    try:
        hand.run(skills.hold_parallel(hold_s), _MOST_S)
    except Failed as failed:
        fault = failed.fault
    except TimeoutError:
        fault = Fault.NOT_PARALLEL
    held = hand.is_held()
    first = seen[0] if seen else math.inf
    dropped = lost_s < math.inf or fault is Fault.LOST_CONTACT
    warned = not dropped or any(event.fault and closed_s <= event.time_s <= lost_s for event in skills.events)
    return Outcome(
        subject.number, subject.shape, subject.friction, first, hand.truth().quality if held else math.inf, counted,
        skills.regrasps, skills.rolls, held, fault, dropped, warned, hand.world.time_s,
    )  # fmt: skip


def share(outcomes: Sequence[Outcome], shape: str = "") -> float:
    """Return the share of outcomes (of a shape) with a friction angle of at most 1 degree by the counted steps."""
    these = [one for one in outcomes if not shape or one.shape == shape]
    return sum(one.counted_rad <= WITHIN_RAD for one in these) / max(len(these), 1)


@dataclass(frozen=True, slots=True)
class Losses:
    """How often objects were lost; immutable.

    Args:
        sure, of_sure: objects that were lost, and all, with a coefficient of `SURE` and more.
        slippery, of_slippery: the same below it.
        silent: of those below it that were lost, how many without a word before.
    """

    sure: int
    of_sure: int
    slippery: int
    of_slippery: int
    silent: int


def losses(outcomes: Sequence[Outcome]) -> Losses:
    """Count the objects that were lost."""
    sure = [one for one in outcomes if one.friction >= SURE]
    slippery = [one for one in outcomes if one.friction < SURE]
    return Losses(
        sum(one.dropped for one in sure), len(sure), sum(one.dropped for one in slippery), len(slippery),
        sum(one.dropped and not one.warned for one in slippery),
    )  # fmt: skip
