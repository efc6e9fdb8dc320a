"""A hand in a simulated plane, without processes: the six coordinates held, the squeeze by the damper law."""

from __future__ import annotations

import math
from collections.abc import Sequence

from sioms.hand.contacts import Grasp, grasp_of
from sioms.hand.kinematics import Hand
from sioms.plant.outline import Outline
from sioms.plant.planar import Body, Mount, World

RB, HAND = 12.7e-3, Hand()
TICK_S, FILTER_S = 2.5e-3, 0.02


class HandRig:
    """Fingers on the x axis, a distance apart, with the object at a pose; truth for its sensors."""

    def __init__(
        self, body: Body | Outline, pose: Sequence[float], d_m: float, force: float = 0.5, mount: Mount | None = None
    ) -> None:
        mount = mount or Mount()
        body = Body(body) if isinstance(body, Outline) else body
        self.goal = [0.0, 0.0, 0.0, d_m, math.pi / 2, math.pi / 2]
        self.joints = list(HAND.inverse(self.goal))
        self.world = World(body, [mount, mount], [self.joints[:3], self.joints[3:]], pose)
        self.wanted, self._felt = force, 0.0

    @property
    def actual(self) -> list[float]:
        """Return where the joints are."""
        return [*self.world.fingers[0].place, *self.world.fingers[1].place]

    @property
    def force(self) -> float:
        """Return the mean force of the two contacts [N]."""
        return 0.5 * sum(math.hypot(finger.normal, finger.tangential) for finger in self.world.fingers)

    def run(self, time_s: float, rates: Sequence[float] = (0, 0, 0, 0, 0, 0), steps: int = 10) -> None:
        """Go on: 5 1/s on each coordinate, 0.4 m/(s N) on the filtered force."""
        for _ in range(round(time_s / TICK_S)):
            now = HAND.forward(self.actual)
            self._felt += TICK_S / FILTER_S * (self.force - self._felt)
            wanted = [0.0] * 6
            for i in (0, 1, 2, 4, 5):
                self.goal[i] += rates[i] * TICK_S
                wanted[i] = rates[i] + 5.0 * math.remainder(self.goal[i] - now[i], math.tau)
            wanted[3] = max(-0.5, -0.4 * (self.wanted - self._felt)) if self.force else -0.02
            turn = HAND.joint_rates(now, wanted)
            self.joints = [joint + TICK_S * rate for joint, rate in zip(self.joints, turn, strict=True)]
            self.world.command([self.joints[:3], self.joints[3:]], TICK_S)
            self.world.advance(TICK_S, steps)

    def grasp(self) -> Grasp:
        """Return the true grasp."""
        first, second = self.world.fingers
        return grasp_of(first.centre, second.centre, first.phi + first.place[2], second.phi + second.place[2], RB)
