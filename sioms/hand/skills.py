"""What a hand can do with an unknown object: close on it, feel it, regrasp it, roll it, hold it.

Each skill is a generator: it yields a `Setpoint` a tick, is sent the `Reading` of the next, and returns what it found.
So it is deterministic, knows no clock, and runs alike on a simulated plane (`plane.PlaneHand.run`) and on a node.

    skills = Skills(hand, first_reading)
    found = plane.run(skills.hold_parallel(5.0))

The states are OPEN, CLOSE, SENSE, CLASSIFY, FEEL, REGRASP, ROLL, HOLD, FAULT. What goes wrong is a `Fault`: the hand
opens or freezes, `events` says which and why, and `Failed` is raised. What will probably go wrong is said before, as an
event.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Generator
from contextlib import suppress
from typing import TypeVar

from sioms.hand.contacts import FINGER_M, Grasp, Likeness, classify, friction_angle_deviation, grasp
from sioms.hand.feeling import Feeling
from sioms.hand.kinematics import Hand, Six
from sioms.hand.motions import STILL
from sioms.hand.regrasp import NEUTRAL, beside, disk_radii, regrasp_disk, regrasp_rectangle
from sioms.hand.rolling import correcting_law, friction_angle_rates, nearest_law
from sioms.hand.shape import Touch, expected
from sioms.hand.touch import Failed, Fault, Manner, Reading, Sensed, Setpoint, State

T = TypeVar("T")
Point = tuple[float, float]


class Skills(Feeling):
    """Skills of one hand.  One at a time; arguments, state, events and readings as of ``Motions``.

    Attributes:
        regrasps, rolls: how many it made.
        sensed: called after each grasp that was sensed.
    """

    def __init__(self, hand: Hand, first: Reading, manner: Manner | None = None) -> None:
        super().__init__(hand, first, manner)
        self.regrasps = self.rolls = 0
        self.sensed: Callable[[], None] | None = None
        self._past: list[Sensed] = []
        self._radii = [FINGER_M, FINGER_M]

    # what a user calls

    def hold_parallel(self, time_s: float) -> Generator[Setpoint, Reading, Sensed]:
        """Grasp whatever is between the fingers, bring it into a parallel grasp, hold it for a time [s].

        Raises:
            Failed: as the fault says; the hand has opened or is frozen.
            ValueError: a time below 0, or none.
        """
        return self._guarded("hold", self._hold_parallel(_lasting(time_s)))

    def grasp(self) -> Generator[Setpoint, Reading, Sensed]:
        """Close on whatever is between the fingers and feel it.

        Raises:
            Failed: nothing there, too small, too large, no reach, or a sensor that is not to be relied on.
        """
        return self._guarded("grasp", self._grasp())

    def feel(self) -> Generator[Setpoint, Reading, Sensed]:
        """Squeeze what is between both fingers already, and feel it.

        Raises:
            Failed: nothing is held, or as `grasp`.
        """
        return self._guarded("feel", self._feel())

    def regrasp(self, found: Sensed) -> Generator[Setpoint, Reading, Sensed]:
        """Open, go to the parallel grasp that `found` lets expect, close and feel again; raises as `grasp`."""
        return self._guarded("regrasp", self._regrasp(found))

    def roll(self) -> Generator[Setpoint, Reading, Sensed]:
        """Roll what is held until it is held parallel, or until an array ends; raises as `hold`."""
        return self._guarded("roll", self._roll())

    def hold(
        self, time_s: float, along: Point = (0.0, 0.0), rolling: Point | None = None
    ) -> Generator[Setpoint, Reading, Sensed]:
        """Hold for a time [s], correcting the friction angles by rolling, and carry it at a velocity x, y [m/s].

        Args:
            rolling: rates of phi1 and phi2 [rad/s], instead of correcting.

        Raises:
            Failed: contact lost, cone, end of the array, overload or a stale sensor.
            ValueError: a time below 0, or none, or a velocity that is none.
        """
        if not all(map(math.isfinite, (*along, *(rolling or ())))):
            raise ValueError(f"hold object: carry it at {along} m/s, roll it at {rolling} rad/s; want finite ones")
        return self._guarded("hold", self._hold(_lasting(time_s), along, rolling))

    def release(self) -> Generator[Setpoint, Reading, None]:
        """Open by the clearance.

        Raises:
            Failed: a sensor that is not to be relied on; the hand is frozen.
        """
        return self._guarded("release", self._release())

    # the state machine

    def _guarded(self, what: str, ticks: Generator[Setpoint, Reading, T]) -> Generator[Setpoint, Reading, T]:
        self._what, self.state, self._most_n = f"{what} object", State.IDLE, math.inf
        try:
            return (yield from ticks)
        except Failed as failed:
            self._ended(str(failed), failed.fault)
            goal: Six = tuple(self._goal)  # type: ignore[assignment]
            with suppress(Failed, OSError, ValueError):  # what ends meanwhile, the first fault is told
                if failed.fault.opens:
                    yield from self._let_go()
                yield Setpoint(goal, STILL, 0.0, frozen=True)
            raise
        except (OSError, ValueError) as error:  # of who carries it out
            self._ended(f"{self._what}: {error}", Fault.HALTED)
            raise

    def _ended(self, text: str, fault: Fault) -> None:
        self.say(text, fault)
        self.state, self._held = State.FAULT, False

    def _release(self) -> Generator[Setpoint, Reading, None]:
        yield from self._open()
        self.state = State.IDLE

    def _hold_parallel(self, time_s: float) -> Generator[Setpoint, Reading, Sensed]:
        try:
            found = yield from self._grasp()
        except Failed as failed:
            if failed.fault not in (Fault.ARRAY_END, Fault.DOUBTFUL) or not self.manner.taps:
                raise
            found = yield from self._felt_anew(failed)
        while found.grasp.quality > self._good_enough(found):
            sure = not self.manner.taps or self._by_class(found) is not None
            if sure and self.regrasps != 1 and self._can_roll(found) and found.force > 0.5 * self.manner.force_n:
                found = yield from self._roll()
                continue
            if self.regrasps >= self.manner.regrasps:
                break
            found = yield from self._regrasp(found)
        if found.force < 0.5 * self.manner.force_n:
            raise Failed(
                Fault.NOT_PARALLEL,
                f"hold object: after {self.regrasps} regrasps the friction angles are still {_degrees(found.grasp)}; "
                f"want less than {math.degrees(self.manner.squeeze_rad):.0f} degrees to squeeze it",
            )
        return (yield from self._hold(time_s))

    def _good_enough(self, found: Sensed) -> float:
        """Return the friction angle [rad] up to which a grasp is held as it is; holding rolls it the rest.

        Another regrasp of a grasp that is nearly parallel, at the end of a side, makes it worse as often as better.
        """
        squeezed = found.force > 0.5 * self.manner.force_n
        return max(self.manner.tolerance_rad, self.manner.held_rad - 3.0 * found.deviation if squeezed else 0.0)

    def _grasp(self) -> Generator[Setpoint, Reading, Sensed]:
        self._check_sensors("grasp object")
        self._check_reach("grasp object", self._goal)
        if any(finger.touched for finger in self.now.fingers):
            raise Failed(
                Fault.TOO_LARGE,
                f"grasp object: a finger touches it with the hand open to {1e3 * self._goal[3]:.0f} mm; want an object "
                "that leaves both free",
            )
        yield from self._close()
        return (yield from self._squeeze())

    def _feel(self) -> Generator[Setpoint, Reading, Sensed]:
        self._check_sensors("feel object")
        for i, finger in enumerate(self.now.fingers):
            if not finger.touched:
                raise Failed(
                    Fault.NOTHING_THERE, f"feel object: finger {i + 1} touches nothing; want an object that was grasped"
                )
        self._held = True
        return (yield from self._squeeze())

    def _squeeze(self) -> Generator[Setpoint, Reading, Sensed]:
        """Feel the touch lightly; squeeze what will not slip away, and feel it again."""
        manner = self.manner
        yield from self._settle(manner.light_n, 0.25)
        found = yield from self._sense(manner.light_n)
        if found.grasp.quality > manner.light_rad:
            self.say(f"near the friction cone: {_degrees(found.grasp)}", Fault.CONE)
        if found.grasp.quality > math.atan(manner.friction):  # it slides, or will: what was felt has to do
            return found
        if found.grasp.quality > manner.squeeze_rad:
            return (yield from self._sense(manner.light_n, _LIGHTLY * manner.frames))
        yield from self._settle(manner.force_n, 0.6)
        return (yield from self._sense(manner.force_n))

    def _regrasp(self, found: Sensed) -> Generator[Setpoint, Reading, Sensed]:
        self.state = State.REGRASP
        self._past.append(found)
        self.regrasps += 1
        self.say(f"{found.likeness.value}-like, {_degrees(found.grasp)}: regrasp")
        felt: Six | None = None
        if self._around is not None and found.grasp.quality < _BESIDE_RAD:
            target, sure = self._by_class(found) or beside(found.grasp, found.curvatures), True
        else:
            target, sure = self._planned(found)
        if not sure and self.manner.taps:
            yield from self._open()
            felt = yield from self._feel_round(_touches(found))
        target = felt or target
        opened = max(target[3], self._goal[3]) + (0.0 if felt else 2.0 * self.manner.clearance_m)
        self._check_reach("regrasp object", (*target[:3], opened, *target[4:]))
        if felt is None:
            yield from self._open()
        yield from self._move((*target[:3], opened, *target[4:]))
        yield from self._close()
        return (yield from self._squeeze())

    def _felt_anew(self, failed: Failed) -> Generator[Setpoint, Reading, Sensed]:
        """Let go of what an array does not cover, feel round it, grasp it where it is parallel.

        Raises:
            Failed: as before, where that was not found.
        """
        self.say(f"{failed}: regrasp", failed.fault)
        self.regrasps += 1
        yield from self._open()
        target = yield from self._feel_round([])
        if target is None:
            raise failed
        yield from self._move(target)
        yield from self._close()
        return (yield from self._squeeze())

    def plan(self, found: Sensed) -> Six:
        """Return where the hand goes for a parallel grasp: by the law of the class where both curvatures agree with it,
        else by the arcs that touch.
        """
        return self._planned(found)[0]

    def _by_class(self, found: Sensed) -> Six | None:
        """Return the parallel grasp of a disk or a rectangle; None where curvatures or angles tell that it is none."""
        held = found.grasp
        radius = 0.5 * sum(disk_radii(held))
        for likeness, bend in ((Likeness.DISK, 1.0 / radius), (Likeness.RECTANGLE, 0.0)):
            agrees = all(
                abs(seen - bend) < 3.0 * deviation + 2.0
                for seen, deviation in zip(found.curvatures, found.curvature_deviations, strict=True)
            )
            twist = held.eta1 + held.eta2 if likeness is Likeness.DISK else held.eta1 - held.eta2
            if agrees and found.likeness is likeness and abs(twist) < 4.0 * found.deviation + math.radians(1.0):
                return regrasp_disk(held, radius) if likeness is Likeness.DISK else regrasp_rectangle(held)
        return None

    def _planned(self, found: Sensed) -> tuple[Six, bool]:
        """Return where the hand goes for a parallel grasp, and whether what was felt is enough to know it."""
        held = found.grasp
        if (target := self._by_class(found)) is not None:
            return target, True
        known = [touch for sensed in self._past for touch in _touches(sensed)]
        low, high = self.manner.opening
        for one in expected(known, held):
            shift = math.hypot(
                one.x - 0.5 * (held.contact1[0] + held.contact2[0]), one.y - 0.5 * (held.contact1[1] + held.contact2[1])
            )
            d = one.apart_m + 2.0 * FINGER_M
            turned = abs(math.remainder(one.direction - held.direction, math.tau))
            if turned < _MOST_TURN and shift < 0.75 * held.apart_m and low < d < high - 2e-2:
                squeezed = found.force > 0.5 * self.manner.force_n  # else two light touches are little to know it by
                return (one.x, one.y, one.direction, d, NEUTRAL, NEUTRAL), one.known and squeezed
        radius = 0.5 * sum(disk_radii(held))
        return (regrasp_disk(held, radius) if found.likeness is Likeness.DISK else regrasp_rectangle(held)), False

    def _can_roll(self, found: Sensed) -> bool:
        """Return whether rolling leads to a parallel grasp before an array ends, as far as the curvatures tell: each
        contact travels L sin(eta)/2 on disk and rectangle alike.
        """
        held = found.grasp
        travel = 0.5 * held.apart_m * math.sin(held.quality) / FINGER_M
        low, high = self.manner.arc
        if self.rolls > self.regrasps:  # it has been tried
            return False
        bends = tuple(max(bend, 0.0) for bend in found.curvatures)
        first, second = nearest_law((held.eta1, held.eta2), held.apart_m, bends, 1.0, math.inf)
        a, b, c, d = friction_angle_rates(held.apart_m, bends)
        left = math.hypot(held.eta1 + a * first + b * second, held.eta2 + c * first + d * second)
        return (
            left < 0.5 * held.quality + self.manner.tolerance_rad
            and max(abs(first), abs(second)) < _MOST_TURN
            and all(
                low + _SPARE * max(travel, abs(rate)) < place < high - _SPARE * max(travel, abs(rate))
                for place, rate in zip(found.places, (first, second), strict=True)
            )
        )

    def _roll(self) -> Generator[Setpoint, Reading, Sensed]:
        self.state = State.ROLL
        self.rolls += 1
        self._past.clear()  # the object moves
        self._around = None
        manner, since, low, high = self.manner, self.now.time_s, *self.manner.arc
        latest_s = since + manner.roll_s
        self.say(f"roll from {_degrees(self._seen())}")
        filtered: tuple[float, float] | None = None
        while self.now.time_s - since < 0.15:
            seen = self._seen()
            filtered = self._smoothed(filtered, seen, _ROLL_S)
            yield from self._tick(self._law(_beyond(filtered, 0.5 * manner.let_rad)))
            if max(map(abs, filtered)) > max(0.5 * manner.tolerance_rad, manner.let_rad):
                since = self.now.time_s
            if not all(low < finger.phi < high for finger in self.now.fingers if finger.touched):
                self.say("the array ends", Fault.ARRAY_END)
                break
            if self.now.time_s > latest_s:
                self.say(f"not parallel after {manner.roll_s:g} s of rolling: {_degrees(seen)}", Fault.NOT_PARALLEL)
                break
        return (yield from self._sense(manner.force_n))

    def _smoothed(self, last: Point | None, seen: Grasp, time_s: float) -> Point:
        """Return both friction angles behind a low-pass, whatever the rate of the readings."""
        if last is None:
            return seen.eta1, seen.eta2
        share = min(self._gone_s / time_s, 1.0)
        return last[0] + share * (seen.eta1 - last[0]), last[1] + share * (seen.eta2 - last[1])

    def _law(self, eta: tuple[float, float]) -> tuple[float, float]:
        """Return the rates of rolling [rad/s]."""
        manner = self.manner
        if manner.smallest:
            return correcting_law(*eta, manner.gain, manner.rolling)
        bends = []
        for i, finger in enumerate(self.now.fingers):
            if finger.touched and not finger.doubt:
                self._radii[i] += 0.05 * (finger.radius_m - self._radii[i])
            bends.append(1.0 / min(max(self._radii[i], 1e-4), FINGER_M) - 1.0 / FINGER_M)
        return nearest_law(eta, self._seen().apart_m, bends, manner.gain, manner.rolling)

    def _hold(
        self, time_s: float, along: Point = (0.0, 0.0), rolling: Point | None = None
    ) -> Generator[Setpoint, Reading, Sensed]:
        self.state, self._held = State.HOLD, True
        self._goal[3] = self.hand.forward(self.now.joints)[3]
        end, filtered = self.now.time_s + time_s, None
        while self.now.time_s < end:
            seen = self._seen()
            filtered = self._smoothed(filtered, seen, _HOLD_S)
            self._watch_cone(max(map(abs, filtered)))
            turning = rolling or self._law(_beyond(filtered, self.manner.let_rad))
            yield from self._follow((*along, 0.0, 0.0, *turning), self.manner.force_n)
        return (yield from self._sense(self.manner.force_n))

    def _sense(self, force: float, frames: int = 0) -> Generator[Setpoint, Reading, Sensed]:
        """Average frames; the hand keeps still."""
        before, self.state = self.state, State.SENSE
        count = frames or self.manner.frames
        joints, places, radii = [0.0] * 6, [0.0, 0.0], [0.0, 0.0]
        variances, widths, doubts = [0.0, 0.0], [0.0, 0.0], ["", ""]
        doubtful, felt, first = [0, 0], 0.0, self.now.joints
        for _ in range(count):
            yield from self._tick((0.0, 0.0), force)
            felt += self.felt_force() / count
            joints = [at + (now - was) / count for at, now, was in zip(joints, self.now.joints, first, strict=True)]
            for i, finger in enumerate(self.now.fingers):
                if not finger.touched or finger.doubt:
                    doubtful[i], doubts[i] = doubtful[i] + 1, finger.doubt or "no contact"
                    continue
                places[i] += finger.phi
                variances[i] += finger.phi_deviation**2
                radii[i] += finger.radius_m
                widths[i] += finger.radius_deviation_m**2
        for i in (0, 1):
            if doubtful[i] > count // 2:
                raise Failed(
                    Fault.DOUBTFUL,
                    f"sense object: finger {i + 1} says {doubts[i]!r} in {doubtful[i]} of {count} frames; want a "
                    "contact that its array covers",
                )
        good = [count - many for many in doubtful]
        phi = places[0] / good[0], places[1] / good[1]
        held = grasp([at + was for at, was in zip(joints, first, strict=True)], phi, self.hand)
        place = max(math.sqrt(variance) / many for variance, many in zip(variances, good, strict=True))
        deviation = friction_angle_deviation(held.apart_m, math.hypot(place, _PLACE_RAD))
        bends, spreads = [], []
        for i in (0, 1):
            self._radii[i] = radii[i] / good[i]
            radius = max(radii[i] / good[i], 1e-6)
            bends.append(1.0 / radius - 1.0 / FINGER_M)
            spreads.append(math.sqrt(widths[i]) / good[i] / radius**2)
        self.state = State.CLASSIFY
        found = Sensed(
            held, deviation, (bends[0], bends[1]), (spreads[0], spreads[1]), phi, felt,
            classify(held.eta1, held.eta2, deviation),
        )  # fmt: skip
        hollow = max(-bend - 5.0 * spread for bend, spread in zip(bends, spreads, strict=True))
        if hollow > _HOLLOW and felt > 0.5 * self.manner.force_n:
            raise Failed(
                Fault.NOT_CONVEX,
                f"sense object: it feels hollow, curvatures {bends[0]:.0f} and {bends[1]:.0f} 1/m; want one that is "
                "convex where it is touched",
            )
        self.state = before
        if self.sensed is not None:
            self.sensed()
        return found


_ROLL_S, _HOLD_S = 0.025, 0.05  # low-pass of the friction angles that rolling and holding correct
_PLACE_RAD = math.radians(0.02)  # what averaging does not take from a place: of the axes' and the array's own
_HOLLOW = 15.0  # 1/m
_BESIDE_RAD = math.radians(6.0)  # so near a parallel grasp that was felt the arcs that touch tell it
_MOST_TURN = math.radians(50.0)
_SPARE = 1.2  # of an array's arc, where rolling is begun
_LIGHT_N = 0.5  # below which curvatures are felt badly
_SHARP, _FLAT = 90.0, 0.1  # 1/m
_CORNER_M = 2e-3
_LIGHTLY = 10  # times the frames, where it is only felt lightly


def _touches(found: Sensed) -> list[Touch]:
    """Return what a grasp tells of the outline.

    A light touch feels a corner rounder than it is, and a side next to it no better than its deviation.
    """
    held, touches, light = found.grasp, [], found.force < _LIGHT_N
    sharp = [light and bend > _SHARP for bend in found.curvatures]
    for i, (point, normal) in enumerate(((held.contact1, held.normal1), (held.contact2, held.normal2))):
        bend, deviation = found.curvatures[i], found.curvature_deviations[i]
        if sharp[i]:
            touches.append(Touch(point, normal + math.pi, _CORNER_M, _CORNER_M))
            continue
        straight = light and sharp[1 - i] and bend < 3.0 * deviation
        radius = 1.0 / (_FLAT if straight else max(bend, 2.0 * deviation, _FLAT))
        touches.append(Touch(point, normal + math.pi, radius, radius**2 * deviation + 0.03 * radius + 1e-4))
    return touches


def _beyond(eta: Point, let_rad: float) -> Point:
    """Return what of friction angles lies beyond what is let be."""
    one, two = (math.copysign(max(abs(angle) - let_rad, 0.0), angle) for angle in eta)
    return one, two


def _lasting(time_s: float) -> float:
    if not time_s >= 0.0:
        raise ValueError(f"hold object: for {time_s:g} s; want 0 s or more")
    return time_s


def _degrees(held: Grasp) -> str:
    return f"{math.degrees(held.eta1):.1f} and {math.degrees(held.eta2):.1f} degrees"
