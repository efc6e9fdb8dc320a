"""Average a finger's untouched frames into a baseline, and tell whether it stood still meanwhile."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]


class Rest:
    """Averages frames of a finger at rest.

    Args:
        count: elements.
        frames: to be averaged.
    """

    def __init__(self, count: int, frames: int) -> None:
        self.frames = self.left = frames
        self.seen = np.zeros(count)  # frames in which an element read something
        self._half_seen = np.zeros(count)
        # what was read is kept as the difference from each element's first reading: offsets are large, noise is small
        self._origin, self._sum, self._half, self._square = (np.zeros(count) for _ in range(4))

    def take(self, output: Floats, alive: Flags) -> None:
        """Add a frame."""
        self._origin = np.where(alive & (self.seen == 0.0), output, self._origin)
        off = np.where(alive, output - self._origin, 0.0)
        if 2 * self.left > self.frames:
            self._half += off
            self._half_seen += alive
        self._sum += off
        self._square += off**2
        self.seen += alive
        self.left -= 1

    @property
    def mean(self) -> Floats:
        """Return the mean of each element, shape (ns,)."""
        return np.asarray(self._origin + self._sum / np.maximum(self.seen, 1.0))

    @property
    def known(self) -> Flags:
        """Return which elements read something in half of the frames."""
        return np.asarray(self.seen >= 0.5 * self.frames)

    @property
    def variance(self) -> Floats:
        """Return the variance of one reading, shape (ns,), nan where there were fewer than two."""
        seen = np.where(self.seen > 1.0, self.seen, np.nan)
        return np.asarray((self._square - self._sum**2 / seen) / (seen - 1.0))

    def moved(self, noise: Floats) -> Floats:
        """Return the square of the step from the first to the second half, in units of its noise, shape (ns,)."""
        first, second = self._half_seen, self.seen - self._half_seen
        both = np.minimum(first, second) > 0.0
        first, second = np.where(both, first, 1.0), np.where(both, second, 1.0)
        step = (self._sum - self._half) / second - self._half / first
        return np.where(both, step**2 / (noise * (1.0 / first + 1.0 / second)), 0.0)


@dataclass(slots=True, eq=False)
class Rebase:
    """A new baseline in the making, see `SignalChain.rebase`.

    Args:
        rest: the frames so far.
        since_ns: frames with older stamps do not count.
        touched: whether something seemed to touch at the beginning.
        missed: frames so far in which the finger was blind.
        done: it is in force.
        refused: why it is not; the baseline is still the old one.
    """

    rest: Rest
    since_ns: int
    touched: bool
    missed: int = 0
    done: bool = False
    refused: str = ""
