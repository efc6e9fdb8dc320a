"""A hand in a simulated plane, in one process: world, two tactile fingers with noise, estimator, controller.

    hand = PlaneHand(Body(disk(0.02)), pose=(0.003, -0.004, 0.3), seed=1)
    skills = Skills(hand.hand, hand.reading)
    held = hand.run(skills.hold_parallel(3.0))

Strain frames come from the world's contacts as `sioms.plant.finger` makes them; place, load and radius come back
through the estimator of `sioms.tactile`, with its errors. What is true is in `world`, for pictures and judgement only.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Generator
from dataclasses import dataclass, field
from functools import lru_cache
from typing import TypeVar

import numpy as np

from sioms.hand.contacts import FINGER_M, Grasp, grasp_of
from sioms.hand.control import Controller, Gains
from sioms.hand.kinematics import LINK_M, Hand, Six
from sioms.hand.regrasp import NEUTRAL
from sioms.hand.running import carried_out
from sioms.hand.touch import Felt, Reading, Setpoint
from sioms.hand.yielding import Push, yielded
from sioms.plant.finger import FingerShape, TactileArray
from sioms.plant.planar import Body, Mount, World
from sioms.tactile.cylinder import Cylinder
from sioms.tactile.estimator import Estimator
from sioms.tactile.finger import Finger, nominal_finger
from sioms.tactile.quality import Quality, State

T = TypeVar("T")
SHAPE = FingerShape()
_FREE_STEPS = 2
_YIELDING, _RETREATS = 0.2, 0.1  # damper of a finger that yields [m/(s N)], and how fast it retreats [m/s]
RUBBER_M = SHAPE.radius_m - SHAPE.core_m


@dataclass(frozen=True, slots=True)
class Rig:
    """How a simulated hand is built; immutable.

    Args:
        tick_s: of the controller.
        every: a frame of each finger every so many ticks.
        steps: of the world in a tick.
        noise, resolution: of the elements' outputs [%].
        place_m, turn_rad: resolution of the axes (table 4.1).
        open_m: d at the start.
        gains: of the controller.
        compiled: the estimator, see `sioms.tactile.estimator.Estimator`; the first takes some seconds.
        turned_rad: by which each finger is turned on its link, anti-clockwise.
        free_m: from which clearance on a finger's frame is taken for one without contact, unmade, and the world goes
            on by fewer steps while both are as free; infinite: never.
    """

    tick_s: float = 2.5e-3
    every: int = 1
    steps: int = 5
    noise: float = 0.02
    resolution: float = 0.01
    place_m: float = 0.030e-3
    turn_rad: float = math.radians(0.006)
    open_m: float = 0.17
    gains: Gains = field(default_factory=lambda: Gains(link_m=LINK_M))
    compiled: bool | None = None
    turned_rad: tuple[float, float] = (0.0, 0.0)
    free_m: float = math.inf


@lru_cache(maxsize=4)
def calibrated(noise: float) -> Finger:
    """Return the finger's calibration: that of the design, with this noise [%]."""
    body = Cylinder(SHAPE.core_m, SHAPE.radius_m, SHAPE.poisson_ratio, SHAPE.shear_modulus_pa)
    angles = np.array(SHAPE.angles_rad)
    return nominal_finger(body, angles, SHAPE.radius_m - SHAPE.depth_m, gain=0.01, noise=max(noise, 1e-3))


@lru_cache(maxsize=4)
def _estimator(noise: float, compiled: bool | None) -> Estimator:
    return Estimator(calibrated(noise), compiled=compiled)


class PlaneHand:
    """A hand of two modules over one object; the hand's middle is at the origin, its line of centres along x.

    Args:
        body: the object.
        pose: x, y [m], angle [rad] of the object at the start; unknown to a skill.
        rig: how the hand is built.
        mount: of both fingers, or of each.
        seed: of the noise.
        start: hand coordinates at the start, instead of the open hand at the origin.

    Attributes:
        world: the truth.
        reading: of the last tick.
        silent: fingers that give no more frames, and since when [s].
        seen: called with the hand and the set-point after every tick.

    Raises:
        ValueError: a finger deeper in the object than its rubber at the start, or coordinates that have no joints.

    Concurrency: one caller at a time.
    """

    def __init__(
        self, body: Body, pose: tuple[float, float, float], rig: Rig = Rig(),
        mount: Mount | tuple[Mount, Mount] | None = None,
        seed: int = 0, start: Six | None = None,
    ) -> None:  # fmt: skip
        self.hand, self.rig = Hand(), rig
        mounts = mount if isinstance(mount, tuple) else (mount or Mount(),) * 2
        first = start or (0.0, 0.0, 0.0, rig.open_m, NEUTRAL, NEUTRAL)
        self.joints = list(self.hand.inverse(first))
        self.world = World(body, mounts, [self.joints[:3], self.joints[3:]], pose)
        inside = [number for number, gap in enumerate(self.world.clearances(), 1) if gap < -RUBBER_M]
        if inside:
            raise ValueError(
                f"build hand over object: finger {' and '.join(map(str, inside))} would be deeper in the object than "
                f"its rubber is thick; it lies at {pose[0]:g}, {pose[1]:g} m with a turn of {pose[2]:g} rad; want it "
                "between the fingers"
            )
        self.controller = Controller(rig.gains)
        self._arrays = [TactileArray(SHAPE, 1.0, 0.0, rig.noise, rig.resolution, 2 * seed + i) for i in (0, 1)]
        for array in self._arrays:
            array.mount_all()
        self._estimate = _estimator(math.hypot(rig.noise, rig.resolution / math.sqrt(12.0)), rig.compiled)
        self._raw = np.zeros(len(SHAPE.angles_rad))
        self._ticks = 0
        self._felt = [Felt(False), Felt(False)]
        self.seen: Callable[[PlaneHand, Setpoint], None] | None = None
        self.silent: dict[int, float] = {}
        self.reading = self._read()

    def run(self, ticks: Generator[Setpoint, Reading, T], most_s: float = 120.0) -> T:
        """Carry out a skill to its end; return what it found.

        Raises:
            Failed: as the skill does.
            TimeoutError: it takes longer than `most_s`.
        """
        return carried_out(ticks, self.tick, self.reading.time_s, most_s)

    def tick(self, setpoint: Setpoint) -> Reading:
        """Go on by a tick; return what is read then."""
        tick_s, world = self.rig.tick_s, self.world
        if not setpoint.frozen:
            one, two = self._felt
            force = 0.5 * (one.force + two.force) if one.touched and two.touched else 0.0
            now = self.hand.forward(self.reading.joints)
            rates = self.controller.rates(setpoint.goal, setpoint.along, now, setpoint.force, force, tick_s)
            if setpoint.most_n < math.inf:
                pushes = [
                    Push(finger.force, self.reading.joints[3 * i + 2] + finger.phi) if finger.touched else None
                    for i, finger in enumerate(self._felt)
                ]
                rates = yielded(rates, now, pushes, setpoint.most_n, _YIELDING, _RETREATS)
            turn = self.hand.joint_rates(now, rates)
            self.joints = [joint + tick_s * rate for joint, rate in zip(self.joints, turn, strict=True)]
        world.command([self.joints[:3], self.joints[3:]], tick_s)
        free = all(finger.normal == 0.0 and finger.gap_m > self.rig.free_m for finger in world.fingers)
        world.advance(tick_s, min(self.rig.steps, _FREE_STEPS) if free else self.rig.steps)
        self._ticks += 1
        self.reading = self._read()
        if self.seen is not None:
            self.seen(self, setpoint)
        return self.reading

    def truth(self) -> Grasp:
        """Return the true grasp: of the nearest points where nothing touches."""
        one, two = self.world.fingers
        return grasp_of(one.centre, two.centre, one.phi + one.place[2], two.phi + two.place[2], FINGER_M)

    def beside(self) -> list[float]:
        """Return joints, places, loads, commanded joints, and the forces of the object on both fingers [m, rad, N]."""
        forces: list[float] = []
        for finger in self.world.fingers:
            angle = finger.phi + finger.place[2]
            c, s = math.cos(angle), math.sin(angle)
            forces += [finger.tangential * s - finger.normal * c, -finger.normal * s - finger.tangential * c]
        one, two = self._felt
        return [*self.reading.joints, one.phi, two.phi, one.force, two.force, *self.joints, *forces]

    def is_held(self) -> bool:
        """Return whether both fingers truly touch the object."""
        return all(finger.normal > 0.0 for finger in self.world.fingers)

    def _read(self) -> Reading:
        joints: list[float] = []
        for i, finger in enumerate(self.world.fingers):
            x, y, th = finger.place
            rig = self.rig
            joints += [_stepped(x, rig.place_m), _stepped(y, rig.place_m), _stepped(th, rig.turn_rad)]
            if self._ticks % rig.every == 0 and i not in self.silent:
                self._felt[i] = self._feel(i)
        age = (self._ticks % self.rig.every) * self.rig.tick_s
        ages = [age if i not in self.silent else self.world.time_s - self.silent[i] for i in (0, 1)]
        six: Six = tuple(joints)  # type: ignore[assignment]
        return Reading(self.world.time_s, six, (self._felt[0], self._felt[1]), (ages[0], ages[1]))

    def _feel(self, index: int) -> Felt:
        """Make a strain frame of a finger's contact and estimate what touches."""
        finger = self.world.fingers[index]
        if finger.normal == 0.0 and finger.gap_m > self.rig.free_m:
            return Felt(False)
        turned = finger.phi - self.rig.turned_rad[index]
        self._arrays[index].read(finger.normal, turned, finger.radius_m, self._raw)
        shape = self._estimate.frame(-0.01 * self._raw)
        if not shape.usable:
            return Felt(False if shape.state is State.UNTOUCHED or shape.quality & Quality.WRONG_SIGN else None)
        if not math.isfinite(shape.angle_rad + shape.load_n_per_m):
            return Felt(False)  # too light to be told
        place, _, radius = shape.deviations
        length = SHAPE.length_m
        doubt = shape.quality.name or "" if shape.doubtful else ""
        return Felt(True, shape.angle_rad, place, shape.load_n_per_m * length, shape.equivalent_radius_m, radius, doubt)


def _stepped(value: float, step: float) -> float:
    return round(value / step) * step
