"""Jogs of Grbl axes, without I/O: moves that share a line, and the chain of jogs that a velocity is made of.

Numbers are in the controller's units, mm or degrees; axes are indices into arrays.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from .codec import jog

CHAIN_BLOCKS = 8
"""Jogs of a chain that may be under way: the rest of the planner's 15 blocks is left to moves. A full planner withholds
its ok, and a line that waits there goes out after a cancel."""
SHORTEST_S = 0.01
"""The planner wants at least this between two jogs of a chain."""


def straight_jog(letters: Sequence[str], here: NDArray[np.float64], moves: Mapping[int, tuple[float, float]]) -> str:
    """Return the line that moves axes together, so fast that none passes its own speed.

    Args:
        letters: of all axes.
        here: present positions of all axes, shape (n,).
        moves: axis to target and top speed [/s].

    Example:
        >>> straight_jog("XY", np.array([0.0, 0.0]), {0: (30.0, 10.0), 1: (40.0, 10.0)})
        '$J=G53G90G21X30Y40F750'
    """
    ways = {axis: abs(target - float(here[axis])) for axis, (target, _) in moves.items()}
    length = math.hypot(*ways.values())
    slowest_s = max(ways[axis] / speed for axis, (_, speed) in moves.items())
    feed = length / slowest_s if slowest_s else next(iter(moves.values()))[1]
    return jog({letters[axis]: target for axis, (target, _) in moves.items()}, 60 * feed)


class JogChain:
    """Velocities as jogs to absolute positions that reach a little ahead, so that the motion ends when nobody lengthens
    it.

    Args:
        letters: of the axes.
        rates: their accelerations, shape (n,) [/s^2].
        poll_hz: rate at which it is lengthened.

    Attributes:
        wanted: velocities, shape (n,) [/s]; 0 for axes that are not part of it.
    """

    def __init__(self, letters: Sequence[str], rates: NDArray[np.float64], poll_hz: float) -> None:
        self.wanted = np.zeros(len(letters))
        self._letters, self._rates, self._poll_hz = letters, rates, poll_hz
        self._end = np.zeros(len(letters))
        self._until_ns = 0
        self._ways: deque[tuple[NDArray[np.float64], NDArray[np.float64]]] = deque()
        """Jogs under way: where each begins and ends."""

    def start(self, axis: int, velocity: float, here: float) -> None:
        """Begin or change the velocity of an axis."""
        if self.wanted[axis] == 0:
            self._end[axis] = here
        self.wanted[axis] = velocity

    def cut(self) -> None:
        """Note that the jogs that were sent ahead have been cancelled."""
        self._until_ns = 0
        self._ways.clear()

    def restart(self, here: NDArray[np.float64]) -> None:
        """Go on from where the axes came to rest."""
        self._end, self._until_ns = here.copy(), 0
        self._ways.clear()

    def blocks(self, here: NDArray[np.float64]) -> int:
        """Return how many of its jogs are under way yet, by where the axes are: not every controller tells."""
        while self._ways and float((here - self._ways[0][1]) @ (self._ways[0][1] - self._ways[0][0])) >= 0:
            self._ways.popleft()
        return len(self._ways)

    def next(
        self, now_ns: int, low: NDArray[np.float64], high: NDArray[np.float64]
    ) -> tuple[str, NDArray[np.float64], int] | None:
        """Return the jog that lengthens the chain, its end and how long it lasts [ns]; None while it is long enough.

        Args:
            now_ns: time.
            low, high: soft limits, shape (n,); the chain ends there.
        """
        ahead_s = max(3 / self._poll_hz, float((np.abs(self.wanted) / self._rates).max()) / 2 + 2 / self._poll_hz)
        begin_ns = max(self._until_ns, now_ns)
        duration_s = now_ns / 1e9 + ahead_s - begin_ns / 1e9
        if duration_s < max(SHORTEST_S, ahead_s / (CHAIN_BLOCKS - 2)):
            return None
        targets = np.clip(self._end + self.wanted * duration_s, low, high)
        targets = np.where(self.wanted != 0, targets, self._end)
        if float(np.abs(targets - self._end).max()) < 1e-4:
            return None
        words = {self._letters[a]: float(targets[a]) for a in np.flatnonzero(self.wanted).tolist()}
        line = jog(words, 60 * float(np.linalg.norm(self.wanted)))
        return line, targets, begin_ns + int(duration_s * 1e9)

    def sent(self, targets: NDArray[np.float64], until_ns: int) -> None:
        """Note that the controller has taken a jog."""
        self._ways.append((self._end, targets))
        self._end, self._until_ns = targets, until_ns
