"""A hand in a simulated plane, without processes: the six coordinates held, the squeeze by the damper law."""

from __future__ import annotations

import math
from collections.abc import Sequence

from sioms.hand.contacts import Grasp, grasp_of
from sioms.hand.control import Controller, Gains
from sioms.hand.kinematics import Hand
from sioms.plant.outline import Outline
from sioms.plant.planar import Body, Mount, World

RB, HAND = 12.7e-3, Hand()


class HandRig:
    """Fingers on the x axis, a distance apart, with the object at a pose; truth for its sensors."""

    def __init__(
        self, body: Body | Outline, pose: Sequence[float], d_m: float, force: float = 0.5, mount: Mount | None = None,
        gains: Gains | None = None, tick_s: float = 2.5e-3,
    ) -> None:  # fmt: skip
        mount = mount or Mount()
        body = Body(body) if isinstance(body, Outline) else body
        self.goal = [0.0, 0.0, 0.0, d_m, math.pi / 2, math.pi / 2]
        self.joints = list(HAND.inverse(self.goal))
        self.world = World(body, [mount, mount], [self.joints[:3], self.joints[3:]], pose)
        self.wanted, self.tick_s = force, tick_s
        self.controller = Controller(gains or Gains(opening_max=0.5))

    @property
    def actual(self) -> list[float]:
        """Return where the joints are."""
        return [*self.world.fingers[0].place, *self.world.fingers[1].place]

    @property
    def force(self) -> float:
        """Return the mean force of the two contacts [N]."""
        return 0.5 * sum(math.hypot(finger.normal, finger.tangential) for finger in self.world.fingers)

    def run(self, time_s: float, rates: Sequence[float] = (0, 0, 0, 0, 0, 0), steps: int = 10) -> None:
        """Go on, the goal at these rates."""
        tick_s = self.tick_s
        for _ in range(round(time_s / tick_s)):
            now = HAND.forward(self.actual)
            self.goal = [at + tick_s * rate for at, rate in zip(self.goal, rates, strict=True)]
            wanted = self.controller.rates(self.goal, rates, now, self.wanted, self.force, tick_s)
            turn = HAND.joint_rates(now, wanted)
            self.joints = [joint + tick_s * rate for joint, rate in zip(self.joints, turn, strict=True)]
            self.world.command([self.joints[:3], self.joints[3:]], tick_s)
            self.world.advance(tick_s, steps)

    def grasp(self) -> Grasp:
        """Return the true grasp."""
        first, second = self.world.fingers
        return grasp_of(first.centre, second.centre, first.phi + first.place[2], second.phi + second.place[2], RB)
