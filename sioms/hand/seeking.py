"""Which touches of an object that stays where it is show that it is held parallel there, and where to touch next."""

from __future__ import annotations

import math
from collections.abc import Sequence

from sioms.hand.around import Around
from sioms.hand.contacts import FINGER_M, grasp_of
from sioms.hand.shape import Parallel, Touch

FITS_RAD, _NEARLY = math.radians(0.5), (True, math.radians(4.0))
SPARE_M = 1.5e-3
"""How far from the end of a side a finger that is squeezed feels nothing of it: half the width of a contact at 1 N."""
END_RAD = math.radians(2.0)
"""What is parallel by touches nearer to an end is off by, squeezed, a degree or more."""
_BEYOND_M = 0.2e-3
_MOST_BEYOND = 2  # each way


class Seeking:
    """Judges pairs of touches, one after the other.  One at a time.

    Args:
        around: all touches so far.

    Attributes:
        found: x, y, psi of the best place so far [m, m, rad]; None before any is nearly parallel.
    """

    def __init__(self, around: Around) -> None:
        self.around = around
        self.found: tuple[float, float, float] | None = None
        self._best = _NEARLY
        self._many = self._beyond = 0
        self._fitting: tuple[Sequence[Touch], float, tuple[float, float, float], Parallel] | None = None
        self._next: Parallel | None = None

    def is_done(self, touches: Sequence[Touch], one: Parallel) -> bool:
        """Take the touches of both fingers along a line, which `around` has; return whether it is held parallel there,
        or where an earlier pair was: a side is felt farther along before it is believed to go on.
        """
        self._many += 1
        off, at = held_by(touches)
        fits = off < FITS_RAD * (1.0 + 0.1 * self._many)
        if self._fitting is None and fits:
            self._fitting, self._beyond = (touches, off, at, one), 0
        if self._fitting is None:
            self._take(off, at, False)
            return False
        touches, off, at, one = self._fitting
        room_m, way = self.around.spare(touches)
        if room_m < SPARE_M and way is not None and self._beyond < _MOST_BEYOND:
            by = SPARE_M + _BEYOND_M
            self._beyond += 1
            self._next = Parallel(one.x + by * way[0], one.y + by * way[1], one.direction, one.apart_m, math.inf)
            return False
        self._fitting = None
        return self._take(off, at, room_m >= SPARE_M)

    def missed(self) -> None:
        """A finger has met nothing: a side that was felt farther along has ended."""
        if self._fitting is not None:
            _, off, at, _ = self._fitting
            self._fitting = None
            self._take(off, at, False)

    def next(self, direction: float, least_m: float = 0.0) -> Parallel | None:
        """Return where to touch next; arguments as of `Around.next`."""
        one, self._next = self._next, None
        return one or self.around.next(direction, least_m)

    def _take(self, off: float, at: tuple[float, float, float], fits: bool) -> bool:
        near = (not fits, off if fits else off + END_RAD * (off < FITS_RAD))
        if near < self._best:
            self._best, self.found = near, at
        return fits


def held_by(touches: Sequence[Touch]) -> tuple[float, tuple[float, float, float]]:
    """Return the larger friction angle of a grasp on two touches [rad], and x, y, psi of the hand there."""
    (ax, ay), (bx, by) = (
        (one.point[0] + FINGER_M * math.cos(one.normal), one.point[1] + FINGER_M * math.sin(one.normal))
        for one in touches
    )
    off = grasp_of((ax, ay), (bx, by), *(one.normal + math.pi for one in touches)).quality
    return off, (0.5 * (ax + bx), 0.5 * (ay + by), math.atan2(by - ay, bx - ax))
