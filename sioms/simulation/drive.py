"""The mechanics of one positioning drive: trapezoidal profiles in pulses, in time, between hard ends.

The drive integrates its own motion whenever somebody looks, in steps of at most 1 ms of the given
clock, so an idle simulator costs nothing and what happened meanwhile (the end of a move, a dead-man
that ran out) happened at its time. Units: pulses, pulses/s, pulses/s^2, seconds.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Protocol

from .control import number

STEP_S = 0.001


@dataclass
class Mover:
    """A load on a motor.

    Args:
        position, velocity: actual.
        low, high: hard ends, where the motion stops dead.
        slip: feedback minus commanded position [pulses], grows when steps are lost.
        origin: where the drive's zero is, on the machine [pulses].
        shoved: velocity at which the motor turns by itself, a defect.
    """

    position: float = 0.0
    velocity: float = 0.0
    low: float = -1e12
    high: float = 1e12
    target: float | None = None
    top_speed: float = 0.0
    acceleration: float = 1.0
    deceleration: float = 1.0
    slip: float = 0.0
    origin: float = 0.0
    shoved: float = 0.0

    @property
    def turns(self) -> float:
        """How fast the motor turns, by whatever cause."""
        return self.shoved or self.velocity

    def count_from(self, position: float) -> None:
        """Preset the position counter here; the mechanical ends stay where they are."""
        shift = position - self.position - self.slip
        self.origin -= shift
        self.low += shift
        self.high += shift
        self.position, self.slip = position, 0.0

    @property
    def home(self) -> float:
        """Position of the machine's zero, where the homing sensor is."""
        return -self.slip - self.origin

    @property
    def busy(self) -> bool:
        """Whether a motion is under way."""
        return self.target is not None or self.velocity != 0.0 or self.top_speed != 0.0

    @property
    def feedback(self) -> int:
        """What the encoder counts, as a 32-bit number."""
        return (round(self.position + self.slip) + 2**31) % 2**32 - 2**31

    def seen(self) -> dict[str, float]:
        """Return what a bystander sees of it."""
        return {
            "position": self.position,
            "place": self.position + self.slip + self.origin,
            "feedback": self.feedback,
            "velocity": self.turns,
            "moving": int(self.busy),
        }

    def go_to(self, target: float, speed: float, acceleration: float, deceleration: float) -> None:
        """Move to a position; replaces what is under way."""
        self.target, self.top_speed = target, abs(speed)
        self.acceleration, self.deceleration = acceleration, deceleration

    def run(self, velocity: float, acceleration: float, deceleration: float) -> None:
        """Run at a velocity until told otherwise."""
        self.target, self.top_speed = None, velocity
        self.acceleration, self.deceleration = acceleration, deceleration

    def stop(self, deceleration: float | None = None) -> None:
        """Slow down to rest."""
        self.target, self.top_speed = None, 0.0
        if deceleration is not None:
            self.deceleration = deceleration

    def halt(self) -> None:
        """Stand still at once."""
        self.target, self.top_speed, self.velocity = None, 0.0, 0.0

    def step(self, dt: float) -> bool:
        """Integrate one step; returns whether a hard end was hit in it."""
        if self.shoved:
            self.position = min(max(self.position + self.shoved * dt, self.low), self.high)
            return False
        wanted = self.top_speed
        if self.target is not None:
            distance = self.target - self.position
            if abs(distance) <= max(abs(self.velocity) * dt, 0.5) and abs(self.velocity) <= 2 * self.deceleration * dt:
                self.position = self.target
                self.halt()
                return False
            half = self.deceleration * dt / 2
            reachable = math.sqrt(half * half + 2 * self.deceleration * abs(distance)) - half
            wanted = math.copysign(min(self.top_speed, reachable), distance)
        slowing = abs(wanted) < abs(self.velocity) or wanted * self.velocity < 0
        change = (self.deceleration if slowing else self.acceleration) * dt
        self.velocity += max(-change, min(change, wanted - self.velocity))
        self.position += self.velocity * dt
        if self.low <= self.position <= self.high:
            return False
        self.position = min(max(self.position, self.low), self.high)
        outward = self.velocity * (1 if self.position == self.high else -1) > 0
        if outward:
            self.halt()
        return outward


class Stepper:
    """Brings a simulation up to the present in steps of 1 ms.

    Args:
        step: called with the time of each step [s] and its length [s].
        idle: tells that steps would change nothing, so that a long rest takes no time to catch up.
        clock: the present [s].
    """

    def __init__(
        self, step: Callable[[float, float], None], idle: Callable[[], bool], clock: Callable[[], float]
    ) -> None:
        self._step, self._idle, self._clock = step, idle, clock
        self._reached_s = clock()

    def catch_up(self) -> float:
        """Integrate up to now and return now [s]."""
        now_s = self._clock()
        while self._reached_s + STEP_S <= now_s:
            if self._idle():
                self._reached_s = now_s
                break
            self._reached_s += STEP_S
            self._step(self._reached_s, STEP_S)
        return now_s


class SimulatedDrive(Protocol):
    """What the drives of all families offer a bystander."""

    mover: Mover

    def state(self) -> dict[str, float]:
        """Return what a bystander sees."""

    def raise_alarm(self, code: int) -> None:
        """Go into fault."""

    def foreign(self, kind: str, value: float) -> None:
        """Obey another master: ``velocity``, ``position``, ... ; ValueError for a kind that the drive does not have."""

    def shove(self, velocity: float) -> None:
        """Turn by itself at a velocity; 0 ends it."""


def drive_handlers(drives: Mapping[int, SimulatedDrive]) -> dict[str, Callable[..., object]]:
    """Return the commands of drives, those of the first unless one is named.

    ``state [UNIT]``, ``alarm CODE [UNIT]``, ``slip PULSES [UNIT]``, ``ends LOW HIGH [UNIT]``, ``foreign KIND VALUE
    [UNIT]``, ``shove VELOCITY [UNIT]``.
    """
    first = str(next(iter(drives)))

    def state(unit: str = first) -> dict[str, float]:
        return drives[int(unit)].state()

    def alarm(code: str, unit: str = first) -> None:
        drives[int(unit)].raise_alarm(int(number(code)))

    def slip(pulses: str, unit: str = first) -> None:
        drives[int(unit)].mover.slip += number(pulses)

    def ends(low: str, high: str, unit: str = first) -> None:
        mover = drives[int(unit)].mover
        mover.low, mover.high = number(low), number(high)

    def foreign(kind: str, value: str, unit: str = first) -> None:
        drives[int(unit)].foreign(kind, number(value))

    def shove(velocity: str, unit: str = first) -> None:
        drives[int(unit)].shove(number(velocity))

    return {
        "state": state, "alarm": alarm, "slip": slip, "ends": ends, "foreign": foreign, "shove": shove,
    }  # fmt: skip
