"""The friction cone: where a held object begins to slide, and ellipses that are lost or kept."""

from __future__ import annotations

import math
from dataclasses import dataclass

from sioms.hand.contacts import FINGER_M, Likeness
from sioms.hand.experiments.starts import Start
from sioms.hand.kinematics import Hand
from sioms.hand.plane import PlaneHand, Rig
from sioms.hand.skills import Skills
from sioms.hand.touch import Event, Failed, Fault, Manner, Setpoint, State
from sioms.plant.outline import ellipse
from sioms.plant.planar import Body, Mount

_RADIUS_M = 0.01
_BEGIN, _MIDDLE = math.radians(3.0), math.radians(82.0)
_LIGHT_KG = 0.01  # the platen's friction is no part of the question


@dataclass(frozen=True, slots=True)
class Slip:
    """A grasp whose friction angle grows until it slides; immutable.

    Args:
        cone: atan mu [rad].
        at: true max |eta| when a contact first slid for good [rad]; nan if none did.
        warned_at: true max |eta| when the program warned [rad]; nan if it did not.
        warned_s: between the warning and the slip [s].
    """

    cone: float
    at: float
    warned_at: float
    warned_s: float


class WrongWay(Skills):
    """Rolls the wrong way round while it holds, so that friction angles grow."""

    def _law(self, eta: tuple[float, float]) -> tuple[float, float]:
        rates = [math.copysign(self.manner.rolling, one) for one in eta]
        return rates[0], rates[1]


def slip(friction: float, rig: Rig, seed: int = 0, light: float = math.radians(20.0)) -> Slip:
    """Hold a disk at a few degrees and let its friction angle grow until a contact slides.

    Args:
        friction: coefficient, of both fingers.
        rig: of the hand.
        seed: of the noise.
        light: |eta| [rad] from which on the program warns.
    """
    start = Start(Likeness.DISK, _RADIUS_M, _BEGIN)
    half = 0.5 * (math.atan(friction) - _BEGIN) * (_RADIUS_M + FINGER_M) / FINGER_M  # by which each link will turn
    plane = start.plane(rig, Mount(friction=friction), seed, (_MIDDLE - half, _MIDDLE + half), _LIGHT_KG)
    manner = Manner(light_rad=light, friction=10.0, rolling=math.radians(6.0), force_n=0.5)
    skills = WrongWay(plane.hand, plane.reading, manner)
    plane.run(skills.grasp())
    found: list[tuple[float, float]] = []
    warned: list[tuple[float, float]] = []
    sliding = 0

    def look(hand: PlaneHand, _: Setpoint) -> None:
        nonlocal sliding
        sliding = sliding + 1 if any(finger.slides for finger in hand.world.fingers) else 0
        if sliding == 4 and not found:
            found.append((hand.world.time_s, hand.truth().quality))
        if not warned and any(event.fault is Fault.CONE for event in skills.events):
            warned.append((hand.world.time_s, hand.truth().quality))

    plane.seen = look
    ticks = skills.hold(60.0)
    setpoint = next(ticks)
    try:
        while not found:
            setpoint = ticks.send(plane.tick(setpoint))
    except (Failed, StopIteration):
        pass
    ticks.close()
    at_s, at = found[0] if found else (math.nan, math.nan)
    warned_s, warned_at = warned[0] if warned else (math.nan, math.nan)
    return Slip(math.atan(friction), at, warned_at, at_s - warned_s)


@dataclass(frozen=True, slots=True)
class Kept:
    """What became of an ellipse; immutable.

    Args:
        angle: of its minor axis against the line of centres at the start [rad].
        beside_m: of its centre from that line.
        first: friction angles of the first grasp, true, max [rad].
        fault: by which the skill ended, if it did.
        held: whether both fingers hold it in the end.
        last: true max |eta| in the end [rad].
        apart_m: distance of the contacts in the end.
        events: what the skill had to say.
    """

    angle: float
    beside_m: float
    first: float
    fault: Fault | None
    held: bool
    last: float
    apart_m: float
    events: tuple[Event, ...]


def keep_ellipse(
    half_long_m: float, half_short_m: float, angle: float, beside_m: float, rig: Rig, seed: int = 0
) -> Kept:
    """Hold an ellipse by rolling towards its smallest diameter, without a regrasp, with friction of the rubber."""
    outline = ellipse(half_long_m, half_short_m)
    first = (0.0, 0.0, 0.0, 2.0 * (half_long_m + FINGER_M) + 20e-3, _MIDDLE, _MIDDLE)
    plane = PlaneHand(Body(outline), (0.0, beside_m, 0.5 * math.pi + angle), rig, Mount(friction=None), seed, first)
    skills = Skills(Hand(), plane.reading, Manner(smallest=True, regrasps=0))
    touched: list[float] = []

    def sensed() -> None:
        touched.append(plane.truth().quality)

    skills.sensed = sensed
    fault = None
    try:
        plane.run(skills.hold_parallel(10.0))
    except Failed as failed:
        fault = failed.fault
    held = plane.is_held() and skills.state is State.HOLD
    truth = plane.truth()
    return Kept(
        angle, beside_m, touched[0] if touched else math.nan, fault, held, truth.quality, truth.apart_m,
        tuple(skills.events),
    )  # fmt: skip
