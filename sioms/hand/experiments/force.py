"""The damper law on a held disk, at its gains' end: where it becomes unstable, and how it behaves below."""

from __future__ import annotations

import math
from dataclasses import dataclass

from sioms.hand.contacts import FINGER_M
from sioms.hand.control import Controller, Gains
from sioms.hand.kinematics import Hand
from sioms.hand.regrasp import NEUTRAL
from sioms.hand.statics import damped_limit
from sioms.plant.outline import disk
from sioms.plant.planar import Body, Mount, World

FROM_N, TO_N = 0.3, 0.35
"""A step of the wanted force that leaves the rubber in contact."""
_RADIUS_M, _PREPARE_S, _STEP_S = 0.03, 1.2, 0.25e-3
_SWINGS = 0.5  # of the step: more than that at the end of a trial is no rest


@dataclass(frozen=True, slots=True)
class Loop:
    """A force loop; immutable.

    Args:
        sample_s: T.
        filter_s: low-pass of the force.
    """

    sample_s: float
    filter_s: float = 0.0


@dataclass(frozen=True, slots=True)
class Answer:
    """What a step of the wanted force came to; immutable.

    Args:
        overshoot: of the step, as its share; below 0 where it has not been reached.
        swing: peak to peak of the last third, as a share of the step.
    """

    overshoot: float
    swing: float


def quasi_static_limit(loop: Loop, mount: Mount) -> float:
    """Return K_v [m/(s N)] at which the loop becomes unstable without inertia, 2/(k T + 2 c), two links in series."""
    length = mount.link_m**2
    damping = 2.0 * mount.damping_ratio * math.sqrt(mount.turn_stiffness * mount.inertia) / length
    return damped_limit(0.5 * mount.turn_stiffness / length, 0.5 * damping, loop.sample_s)


def answer(loop: Loop, gain: float, mount: Mount, time_s: float) -> Answer:
    """Return what becomes of a step of the force at a gain K_v [m/(s N)]; the force is the true one."""
    apart = 2.0 * (_RADIUS_M + FINGER_M)
    hand, goal = Hand(), [0.0, 0.0, 0.0, apart, NEUTRAL, NEUTRAL]
    joints = list(hand.inverse(goal))
    world = World(Body(disk(_RADIUS_M)), [mount, mount], [joints[:3], joints[3:]])
    fast = Loop(2.5e-3, 0.05)
    _run(world, hand, goal, joints, fast, Controller(Gains(opening_max=0.5)), FROM_N, _PREPARE_S)
    law = Controller(Gains(damper=gain, filter_s=loop.filter_s, opening_max=10.0, position=1e-6))
    law.felt = FROM_N
    _run(world, hand, goal, joints, loop, law, FROM_N, loop.sample_s)  # it begins at rest
    seen = _run(world, hand, goal, joints, loop, law, TO_N, time_s)
    tail = seen[-max(len(seen) // 3, 3) :]
    step = TO_N - FROM_N
    return Answer((max(seen) - TO_N) / step, (max(tail) - min(tail)) / step)


def _run(
    world: World, hand: Hand, goal: list[float], joints: list[float], loop: Loop, law: Controller, wanted: float,
    time_s: float,
) -> list[float]:  # fmt: skip
    seen = []
    for _ in range(round(time_s / loop.sample_s)):
        one, two = world.fingers
        now = hand.forward([*one.place, *two.place])
        rates = law.rates(goal, [0.0] * 6, now, wanted, _force(world), loop.sample_s)
        turn = hand.joint_rates(now, rates)
        joints[:] = [joint + loop.sample_s * rate for joint, rate in zip(joints, turn, strict=True)]
        world.command([joints[:3], joints[3:]], loop.sample_s)
        world.advance(loop.sample_s, max(round(loop.sample_s / _STEP_S), 1))
        seen.append(_force(world))
    return seen


def _force(world: World) -> float:
    return 0.5 * sum(math.hypot(finger.normal, finger.tangential) for finger in world.fingers)


def measured_limit(loop: Loop, mount: Mount, time_s: float, steps: int = 7) -> float:
    """Return K_v [m/(s N)] at which a step no longer comes to rest, by bisection to one part in 2^steps."""
    low, high = 0.0, 1.5 * quasi_static_limit(loop, mount)
    for _ in range(steps):
        gain = 0.5 * (low + high)
        if answer(loop, gain, mount, time_s).swing > _SWINGS:
            high = gain
        else:
            low = gain
    return 0.5 * (low + high)
