"""What a hand does tick by tick: close, open, move, wait for a force; and what is watched meanwhile.

The base of `skills.Skills`, which say what for. Generators, as there.
"""

from __future__ import annotations

import math
from collections.abc import Generator, Sequence

from sioms.hand.contacts import FINGER_M, Grasp, grasp
from sioms.hand.kinematics import Hand, Six
from sioms.hand.regrasp import NEUTRAL
from sioms.hand.touch import Event, Failed, Fault, Felt, Manner, Reading, Setpoint, State

Ticks = Generator[Setpoint, Reading, None]
STILL: Six = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
LETTING_GO_N = -0.1


class Motions:
    """Motions of one hand.  One at a time.

    Args:
        hand: its modules.
        first: what is read of it at the start.
        manner: how it does it.

    Attributes:
        state: where it is.
        events: what it had to say.
        now: the last reading.
    """

    def __init__(self, hand: Hand, first: Reading, manner: Manner | None = None) -> None:
        self.hand, self.manner, self.now = hand, manner or Manner(), first
        self.state, self.events = State.IDLE, list[Event]()
        self._goal: list[float] = list(hand.forward(first.joints))
        self._free_m = self._goal[3]  # where the hand was open
        self._held, self._what = False, ""
        self._missing = [0.0, 0.0]
        self._warned = False
        self._most_n = math.inf  # of each finger by itself
        self._gone_s = 0.0  # of the last tick

    def say(self, text: str, fault: Fault | None = None) -> None:
        """Add an event."""
        self.events.append(Event(self.now.time_s, self.state, text, fault))

    def felt_force(self) -> float:
        """Return the internal force that both fingers tell [N]: 0 unless both are touched."""
        one, two = self.now.fingers
        return 0.5 * (one.force + two.force) if one.touched and two.touched else 0.0

    def _feels(self, index: int) -> Felt:
        """Return what a finger feels of the lightest touch."""
        return (self.now.light or self.now.fingers)[index]

    @property
    def holds(self) -> bool:
        """Return whether the object is meant to be between both fingers now."""
        return self._held

    # motions

    def _close(self) -> Ticks:
        """Close until both fingers are touched; the finger that is touched first waits for the other."""
        self.state, self._held = State.CLOSE, False
        manner, speed = self.manner, self.manner.closing
        self._goal = list(self.hand.forward(self.now.joints)[:4]) + self._goal[4:]
        pressed_s, since = 0.0, [math.inf, math.inf]  # since when each finger has felt nothing
        latest_s = self.now.time_s + manner.close_s
        while pressed_s < _MET_S:
            if self.now.time_s > latest_s:
                free = [f"finger {i}" for i, gone_s in enumerate(since, 1) if gone_s >= _MET_S] or ["both, in turns"]
                raise Failed(
                    Fault.NOTHING_THERE,
                    f"grasp object: not between both fingers after {manner.close_s:g} s of closing, "
                    f"{' and '.join(free)} not touched; want an object that both fingers press on",
                )
            one, two = (gone_s < _MET_S for gone_s in since)
            before_s, both = self.now.time_s, one and two
            self._most_n = math.inf if both else manner.yield_n  # the first one waits, and pushes nothing away
            drift = 0.0 if one == two else (-0.5 if one else 0.5) * speed
            pressed = all(finger.touched for finger in self.now.fingers)
            shut = 0.0 if pressed else -_CREEP * speed if both else -speed
            u, v = math.cos(self._goal[2]), math.sin(self._goal[2])
            yield from self._follow((drift * u, drift * v, 0.0, shut, 0.0, 0.0), manner.light_n if both else 0.0)
            gone_s, apart = self.now.time_s - before_s, self.hand.forward(self.now.joints)[3]
            # light fingers bounce: the goal does not run away from where they are
            self._goal[3] = apart if both else max(self._goal[3], apart - _AHEAD_M)
            pressed_s = (pressed_s + gone_s * pressed) if both else 0.0
            since = [0.0 if self._feels(i).touched else past + gone_s for i, past in enumerate(since)]
            if self._goal[3] < manner.opening[0] and not both:
                raise Failed(
                    Fault.TOO_SMALL if one or two else Fault.NOTHING_THERE,
                    f"grasp object: {'one finger is' if one or two else 'nothing is'} touched with the fingers' "
                    f"centres {1e3 * self._goal[3]:.0f} mm apart; want an object between them, wider than "
                    f"{1e3 * (manner.opening[0] - 2.0 * FINGER_M):.0f} mm",
                )
        self._held = True
        self._missing = [0.0, 0.0]

    def _settle(self, force: float, time_s: float) -> Ticks:
        """Wait until the force is within a tenth of what is wanted, and then for a time [s]; five seconds at most."""
        since, start = self.now.time_s, self.now.time_s
        while self.now.time_s - since < time_s and self.now.time_s - start < 5.0:
            yield from self._tick((0.0, 0.0), force)
            if self._seen().quality > self.manner.squeeze_rad and force > self.manner.light_n:
                return
            if abs(self.felt_force() - force) > 0.1 * force:
                since = self.now.time_s

    def _open(self) -> Ticks:
        """Let go and leave the object by the clearance."""
        self.state, self._held = State.OPEN, False
        at = self.hand.forward(self.now.joints)
        self._goal = [*at[:4], *self._goal[4:]]
        end = at[3] + 2.0 * self.manner.clearance_m
        start = self.now.time_s
        while self.felt_force() > 0.5 * self.manner.light_n and self.now.time_s - start < 2.0:
            yield from self._follow(STILL, 0.25 * self.manner.light_n)
        yield from self._let_go()
        while self._goal[3] < end:
            yield from self._follow((0.0, 0.0, 0.0, self.manner.moving, 0.0, 0.0), LETTING_GO_N)

    def _let_go(self) -> Ticks:
        """Open until nothing is touched, two seconds at most."""
        start = self.now.time_s
        while any(finger.touched for finger in self.now.fingers) and self.now.time_s - start < 2.0:
            self._goal[3] = max(self._goal[3], self.hand.forward(self.now.joints)[3] + 1e-3)
            yield from self._follow(STILL, LETTING_GO_N)

    def _move(self, target: Sequence[float]) -> Generator[Setpoint, Reading, bool]:
        """Go to hand coordinates in free space, evenly; what is touched on the way makes the hand open further.

        Return whether anything was.
        """
        start, manner = list(self._goal), self.manner
        way = [to - at for to, at in zip(target, start, strict=True)]
        way[2] = math.remainder(way[2], math.tau)
        time_s = max(
            math.hypot(way[0], way[1]) / manner.moving, abs(way[3]) / manner.moving,
            *(abs(way[i]) / manner.turning for i in (2, 4, 5)), 1e-3,
        ) * 1.5  # fmt: skip
        begin, more = self.now.time_s, 0.0
        while (gone := (self.now.time_s - begin) / time_s) < 1.0:
            share, pace = gone * gone * (3.0 - 2.0 * gone), 6.0 * gone * (1.0 - gone) / time_s
            if any(finger.touched for finger in self.now.fingers):
                wider = (*start[:3], start[3] + more + 2e-4, *start[4:])
                if self.state is not State.FEEL or self._reaches(wider):  # else it is pushed, and sought anew
                    more += 2e-4
                    self._check_reach("move to object", wider)
            self._goal = [at + share * by for at, by in zip(start, way, strict=True)]
            self._goal[3] += more
            yield from self._follow([pace * by for by in way], LETTING_GO_N, advance=False)
        for _ in range(_ARRIVE):
            yield from self._follow(STILL, LETTING_GO_N)
        return more > 0.0

    # one tick

    def _tick(self, rolling: tuple[float, float], force: float | None = None) -> Ticks:
        """Hold on for a tick while the fingers roll at these rates [rad/s]."""
        wanted = self.manner.force_n if force is None else force
        yield from self._follow((0.0, 0.0, 0.0, 0.0, *rolling), wanted)

    def _follow(self, along: Sequence[float], force: float, advance: bool = True) -> Ticks:
        last_s = self.now.time_s
        goal: Six = tuple(self._goal)  # type: ignore[assignment]
        rates: Six = tuple(along)  # type: ignore[assignment]
        self.now = yield Setpoint(goal, rates, force, most_n=self._most_n)
        gone_s = self._gone_s = self.now.time_s - last_s
        if not gone_s > 0.0:  # every wait would last for ever
            raise Failed(
                Fault.STALE,
                f"{self._what}: readings do not go on in time, by {gone_s:g} s; want one a tick, each later",
            )
        if advance:
            self._goal = [at + gone_s * rate for at, rate in zip(self._goal, along, strict=True)]
        self._watch(gone_s)

    def _seen(self) -> Grasp:
        """Return the grasp of this tick; of a finger without contact its last place counts."""
        one, two = (finger.phi if math.isfinite(finger.phi) else NEUTRAL for finger in self.now.fingers)
        return grasp(self.now.joints, (one, two), self.hand)

    # what is watched

    def _watch(self, gone_s: float) -> None:
        if self.state is State.FAULT:  # it is letting go, of whatever
            return
        manner = self.manner
        what = self._what
        try:
            self.hand.forward(self.now.joints)
        except ValueError as error:
            raise Failed(Fault.SINGULAR, f"{what}: {error}") from None
        for i, (finger, age_s) in enumerate(zip(self.now.fingers, self.now.ages_s, strict=True)):
            unknown = not math.isfinite(finger.force)
            if not age_s <= manner.stale_s or finger.touched is None or unknown:
                why = "its force is not known" if unknown else "it is blind"
                if not age_s <= manner.stale_s:
                    why = f"its frame is {age_s:.2f} s old"
                raise Failed(
                    Fault.STALE,
                    f"{what}: finger {i + 1} cannot be relied on: {why}; want a frame every {manner.stale_s:g} s",
                )
            if self._most_n < math.inf and self._feels(i).touched is None:
                raise Failed(
                    Fault.STALE,
                    f"{what}: nothing tells what finger {i + 1} touches; want its force sensor, which yielding needs",
                )
            if finger.force > manner.most_n:
                raise Failed(
                    Fault.OVERLOAD,
                    f"{what}: finger {i + 1} bears {finger.force:.1f} N; want at most {manner.most_n:g} N",
                )
            self._missing[i] = 0.0 if finger.touched else self._missing[i] + gone_s
            if self._held and self._missing[i] > manner.lost_s:
                raise Failed(
                    Fault.LOST_CONTACT,
                    f"{what}: finger {i + 1} has felt nothing for {self._missing[i]:.2f} s; the other may still touch",
                )
        if self._held and self.state is not State.CLOSE:
            self._watch_arrays(what)

    def _watch_arrays(self, what: str) -> None:
        low, high = self.manner.arc
        margin = _END_RAD
        for i, finger in enumerate(self.now.fingers):
            if finger.touched and not low - margin < finger.phi < high + margin:
                raise Failed(
                    Fault.ARRAY_END,
                    f"{what}: finger {i + 1} is touched at {math.degrees(finger.phi):.0f} degrees; its array ends at "
                    f"{math.degrees(low - margin):.0f} and {math.degrees(high + margin):.0f} degrees",
                )

    def _watch_cone(self, eta: float) -> None:
        """Warn of friction angles that grow; let go beyond the cone."""
        manner = self.manner
        if eta > math.atan(manner.friction):
            raise Failed(
                Fault.CONE,
                f"hold object: a friction angle of {math.degrees(eta):.1f} degrees; want less than "
                f"{math.degrees(math.atan(manner.friction)):.1f}, or it slides",
            )
        if eta > manner.light_rad and not self._warned:
            self.say(f"near the friction cone: {math.degrees(eta):.1f} degrees", Fault.CONE)
        self._warned = eta > manner.light_rad

    def _check_sensors(self, what: str) -> None:
        for i, calibrated in enumerate(self.now.calibrated):
            if not calibrated:
                raise Failed(
                    Fault.UNCALIBRATED,
                    f"{what}: finger {i + 1} has no calibration; want one for each finger (sioms tactile calibrate)",
                )
        self._watch(0.0)

    def _reaches(self, coordinates: Sequence[float]) -> bool:
        """Return whether the modules reach coordinates."""
        try:
            self._check_reach("feel object", coordinates)
        except Failed:
            return False
        return True

    def _check_reach(self, what: str, coordinates: Sequence[float]) -> None:
        """Refuse coordinates that the modules do not reach."""
        low, high = self.manner.opening
        d = coordinates[3]
        if not math.isfinite(sum(coordinates)) or d < self.hand.least_m:
            raise Failed(Fault.SINGULAR, f"{what}: the fingers' centres would coincide; want d of {1e3 * low:.0f} mm")
        if d > high:
            raise Failed(
                Fault.TOO_LARGE, f"{what}: it needs the hand open to {1e3 * d:.0f} mm; want at most {1e3 * high:.0f} mm"
            )
        x1, y1, _, x2, y2, _ = self.hand.inverse(coordinates)
        left, right, bottom, top = self.manner.reach
        for i, (x, y) in enumerate(((x1, y1), (x2, y2))):
            if not (left <= x <= right and bottom <= y <= top):
                raise Failed(
                    Fault.OUT_OF_REACH,
                    f"{what}: module {i + 1} would have to be at {1e3 * x:.0f}, {1e3 * y:.0f} mm; its platen reaches "
                    f"from {1e3 * left:.0f}, {1e3 * bottom:.0f} to {1e3 * right:.0f}, {1e3 * top:.0f} mm",
                )


_END_RAD = math.radians(6.0)
_ARRIVE = 40  # ticks
_CREEP = 0.1  # of the closing speed, while both fingers have met it and press too lightly to be felt
_MET_S = 0.1  # how long a finger that bounces counts as touched
_AHEAD_M = 1e-3
