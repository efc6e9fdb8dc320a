"""The homing cycle of a simulated Grbl controller, as ``limits.c`` of Grbl 1.1h (``limits_go_home``) runs it.

Z first, then the other axes together. Each part has four motions: to the switches at the seek rate, off them, to them
again at the feed rate, off them; each begins by counting from 0 anew, an axis ends dead where its switch closes, and
between them the debounce is waited for. Lengths in mm, speeds in mm/s.
"""

from __future__ import annotations

import math
from collections.abc import Generator, Mapping, Sequence

from .planner import Planner

FEED, SEEK, DEBOUNCE_MS, PULL_OFF, DIRECTIONS, TRAVEL = 24, 25, 26, 27, 23, 130
SEARCH, LOCATE = 1.5, 5.0
"""How far it looks for a switch: in travels of the longest axis, and in pull-offs."""
NOT_OFF, NOT_FOUND = 8, 9
"""Alarms: the switch is still closed after the pull-off, or was not found."""


class Homing:
    """Switches, and the cycle that looks for them.

    Args:
        planner: moved by it, past its blocks.
        settings: of the controller.
    """

    def __init__(self, planner: Planner, settings: Mapping[int, float]) -> None:
        self._planner, self._settings = planner, settings
        self._axes = range(len(planner.position))
        self.switches = [10.0] * len(self._axes)
        """Where each closes, in the direction in which it is looked for, from where the axes were when it began."""
        self._cycle: Generator[None, float, int] | None = None

    @property
    def is_on(self) -> bool:
        """Whether it runs."""
        return self._cycle is not None

    def begin(self) -> None:
        """Begin the cycle."""
        self._cycle = self._run()
        next(self._cycle)

    def end(self) -> None:
        """Forget it."""
        self._cycle = None

    def step(self, dt: float) -> int | None:
        """Go on for a moment; return None while it runs, at its end the number of an alarm, or 0."""
        assert self._cycle is not None
        try:
            self._cycle.send(dt)
        except StopIteration as end:
            self._cycle = None
            self._planner.speed = 0.0
            return int(end.value)
        return None

    def put_near(self, distance: float) -> None:
        """Put the switches at a distance ahead of the axes."""
        self.switches = [self._sign(i) * self._real(i) + distance for i in self._axes]

    def _sign(self, axis: int) -> float:
        return -1.0 if int(self._settings[DIRECTIONS]) >> axis & 1 else 1.0

    def _real(self, axis: int) -> float:
        return self._planner.position[axis] + self._planner.slip[axis]

    def _is_closed(self, axis: int) -> bool:
        return self._sign(axis) * self._real(axis) >= self.switches[axis]

    def _count_from(self, axis: int, position: float) -> None:
        self._planner.slip[axis] = self._real(axis) - position
        self._planner.position[axis] = position

    def _run(self) -> Generator[None, float, int]:
        for axes in ([i for i in self._axes if i == 2], [i for i in self._axes if i != 2]):
            if not axes:
                continue
            off = self._settings[PULL_OFF]
            travel = max(self._settings[TRAVEL + i] for i in axes)
            for way, rate in ((SEARCH * travel, SEEK), (-off, SEEK), (LOCATE * off, FEED), (-off, SEEK)):
                if alarm := (yield from self._move(axes, way, self._settings[rate] / 60)):
                    return alarm
            for i in axes:
                end = -off if self._sign(i) > 0 else off - self._settings[TRAVEL + i]
                self._count_from(i, end)
        return 0

    def _move(self, axes: Sequence[int], way: float, rate: float) -> Generator[None, float, int]:
        """Move axes towards their switches, or off them if the way is negative; return the number of an alarm."""
        for i in axes:
            self._count_from(i, 0.0)
        top = min(rate, *(self._settings[110 + i] / 60 for i in axes))
        pace = min(self._settings[120 + i] for i in axes)
        moving, speed, gone = list(axes), 0.0, 0.0
        while gone < abs(way):
            dt = yield
            if way > 0:
                moving = [i for i in moving if not self._is_closed(i)]
                if not moving:
                    break
            speed = min(speed + pace * dt, top, math.sqrt(2 * pace * (abs(way) - gone)) + pace * dt)
            step = min(speed * dt, abs(way) - gone)
            gone += step
            for i in moving:
                self._planner.position[i] += math.copysign(step, way * self._sign(i))
            self._planner.speed = speed * math.sqrt(len(moving))
        else:
            if way > 0:
                return NOT_FOUND
            if any(self._is_closed(i) for i in axes):
                return NOT_OFF
        self._planner.speed = waited = 0.0
        while waited < self._settings[DEBOUNCE_MS] / 1000:
            waited += yield
        return 0
