"""Tell what a touch must do to all elements together: whether a lone reading can be one, and whether one could go
unseen.

A touch moves the neighbours of the element that it moves most, by a share that the contact's mechanics gives. So an
element that moves alone is at fault; and elements that are left beside a hole of bad ones still feel what happens in
it, from some load on.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sioms.tactile.finger import Finger
from sioms.tactile.model import StrainTable

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]

FEWEST = 4  # elements that can tell a touch from anything else
TOUCH_SIGMA = 8.0  # of the chi square of all elements against their noise, above its mean: a touch
_WIDTHS = (0.0, 0.05, 0.1, 0.2, 0.3)  # rad, of the touches looked at
_WORSE = 4.0  # times the least load that the whole finger notices everywhere: unnoticed, the finger is blind
_SURE = 5.0  # standard deviations between what a touch does to the others and what they did


@dataclass(frozen=True, slots=True, eq=False)
class Sight:
    """Hold what some elements can tell; immutable.

    Args:
        blind: a touch of several times the load that the whole finger notices could go unseen, or they are fewer than
            four.
        followed: least share of an element's chi square that the others have in a touch which moves it most, shape
            (ns,).
    """

    blind: bool
    followed: Floats


class Witness:
    """The touches of one finger as its elements feel them.  One caller at a time."""

    def __init__(self, finger: Finger, table: StrainTable) -> None:
        angles, used = np.array(finger.angles_rad), np.array(finger.elements.used)
        place = table.first + table.step * np.arange(table.nodes.shape[1])
        known = angles[used] if used.any() else angles
        rows = np.searchsorted(table.half_widths, _WIDTHS).clip(0, table.half_widths.size - 1)
        there = (place >= known.min()) & (place <= known.max())
        patterns = table.nodes[rows][:, there, 0].reshape(-1, angles.size)
        self._patterns: Floats = patterns / finger.strain_noise  # of a unit load, in deviations
        self._sights: dict[bytes, Sight] = {}
        self._whole = self._unseen(used) if np.count_nonzero(used) >= FEWEST else math.inf

    def sight(self, usable: Flags) -> Sight:
        """Return what these elements can tell, shape (ns,)."""
        key = usable.tobytes()
        found = self._sights.get(key)
        if found is None:
            found = self._sights[key] = self._look(usable)
        return found

    def _look(self, usable: Flags) -> Sight:
        followed = np.zeros(usable.size)
        if np.count_nonzero(usable) < FEWEST:
            return Sight(True, followed)
        square = self._local(usable) ** 2
        most, places = square.argmax(axis=1), np.flatnonzero(usable)
        share = square.sum(axis=1) / square.max(axis=1) - 1.0
        for number, element in enumerate(places):
            mine = share[most == number]
            followed[element] = float(mine.min()) if mine.size else 0.0
        return Sight(self._unseen(usable) > _WORSE * self._whole, followed)

    def _local(self, usable: Flags) -> Floats:
        felt = self._patterns[:, usable]
        return np.asarray(felt - np.median(felt, axis=1, keepdims=True))

    def _unseen(self, usable: Flags) -> float:
        """Return the largest load [N/m] that goes unnoticed somewhere between the outermost elements."""
        count = int(np.count_nonzero(usable))
        level = count + TOUCH_SIGMA * math.sqrt(2.0 * count)
        return math.sqrt(level / max(float(np.sum(self._local(usable) ** 2, axis=1).min()), 1e-300))


def moves_alone(square: Floats, followed: Floats) -> int | None:
    """Return the element that moves as it does in no touch, None if there is none.

    Args:
        square: of each element's reading in deviations of its noise, zero where it is not usable, shape (ns,).
        followed: as in `Sight`.
    """
    element = int(square.argmax())
    own = float(square[element])
    expected, rest, count = float(followed[element]) * own, float(square.sum()) - own, square.size - 1
    # half of what is expected is margin for what the finger's file does not know
    if rest < count + 0.5 * expected - _SURE * math.sqrt(2.0 * count + 2.0 * expected):
        return element
    return None
