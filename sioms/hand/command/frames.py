"""What a demonstration keeps of each instant, for the terminal, the picture and the animation."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from sioms.hand.kinematics import LINK_M
from sioms.hand.plane import PlaneHand
from sioms.hand.skills import Skills
from sioms.hand.touch import Setpoint

Point = tuple[float, float]


@dataclass(frozen=True, slots=True)
class Side:
    """A finger at an instant; immutable.

    Args:
        centre: of the finger [m].
        axis: of its link's revolute axis [m].
        contact: true place of contact, None without.
        force: true force along the normal [N].
        felt: the force that it tells [N].
    """

    centre: Point
    axis: Point
    contact: Point | None
    force: float
    felt: float


@dataclass(frozen=True, slots=True)
class Frame:
    """An instant; immutable.

    Args:
        time_s: simulated.
        state: of the skill.
        pose: x, y [m], angle [rad] of the object: the truth.
        sides: the two fingers.
        eta: true friction angles [rad], nan without two contacts.
        told: what the skill has said last.
    """

    time_s: float
    state: str
    pose: tuple[float, float, float]
    sides: tuple[Side, Side]
    eta: tuple[float, float]
    told: str


@dataclass(slots=True)
class Film:
    """Frames of a hand in a plane, `rate_hz` a second of simulated time; ``look`` is called after every tick."""

    skills: Skills
    rate_hz: float = 20.0
    frames: list[Frame] = field(default_factory=list)

    def look(self, hand: PlaneHand, _: Setpoint) -> Frame | None:
        """Keep a frame when its time has come; return it."""
        if self.frames and hand.world.time_s < self.frames[-1].time_s + 1.0 / self.rate_hz - 1e-9:
            return None
        frame = self._frame(hand)
        self.frames.append(frame)
        return frame

    def _frame(self, hand: PlaneHand) -> Frame:
        world, skills = hand.world, self.skills
        grasp = hand.truth()
        eta = (grasp.eta1, grasp.eta2) if hand.is_held() else (math.nan, math.nan)
        sides = []
        for finger, felt, contact in zip(
            world.fingers, hand.reading.fingers, (grasp.contact1, grasp.contact2), strict=True
        ):
            x, y, th = finger.place
            touches = finger.normal > 0.0
            sides.append(
                Side(
                    (x + LINK_M * math.cos(th), y + LINK_M * math.sin(th)), (x, y), contact if touches else None,
                    finger.normal, felt.force if felt.touched else 0.0,
                )
            )  # fmt: skip
        pose = (world.pose[0], world.pose[1], world.pose[2])
        told = skills.events[-1].text if skills.events else ""
        return Frame(world.time_s, skills.state.value, pose, (sides[0], sides[1]), eta, told)
