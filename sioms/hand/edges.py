"""Tell a face from a vertex while a finger rolls: by how fast the place of contact moves with the link.

On a face the place of contact moves in the finger's own angle about as fast as the link turns; on a vertex it stays
(phi_c' = rho (w - th')/(rb + rho)). The rate over a stretch of the link's turn, against the other finger's side that
gives the object's own turn, decides, with hysteresis; the radius that is felt only breaks the tie before there has been
enough of a turn. Source: dissertation, section 4.4.
"""

from __future__ import annotations

import math
from collections import deque
from enum import Enum

from sioms.hand.contacts import FINGER_M


class Edge(Enum):
    """What a finger rolls on."""

    UNKNOWN = "unknown"
    FACE = "face"
    VERTEX = "vertex"


STRETCH = math.radians(3.0)
"""Turn of the link over which the rate is taken: small against a contact's width, large against the place's noise."""
LEAVES, RETURNS = 0.4, 0.6
"""Rates |phi_c'/th'| below which a face is left, and above which a vertex is."""
_ROUND_M = 0.35 * FINGER_M  # R of the contact below which it is taken for a vertex before the link has turned


class EdgeDetector:
    """Decide between face and vertex, frame by frame.  One caller at a time.

    Args:
        stretch: turn of the link over which the rate is taken [rad].

    Attributes:
        edge: what it rolls on.
        rate: |phi_c'/th'| over the last stretch; nan before there is one.
    """

    def __init__(self, stretch: float = STRETCH) -> None:
        self.stretch, self.edge, self.rate = stretch, Edge.UNKNOWN, math.nan
        self._seen: deque[tuple[float, float]] = deque()

    def see(self, link: float, place: float, radius_m: float) -> Edge:
        """Take a frame; return what it rolls on.

        Args:
            link: th [rad], of the same finger.
            place: phi_c [rad].
            radius_m: R of the contact, as felt; nan where it is not known.
        """
        seen = self._seen
        seen.append((link, place))
        while len(seen) > 2 and abs(link - seen[1][0]) >= self.stretch:
            seen.popleft()
        turned = link - seen[0][0]
        if abs(turned) >= self.stretch:
            self.rate = abs(_slope(seen))
            self._decide()
        elif self.edge is Edge.UNKNOWN and math.isfinite(radius_m):
            self.edge = Edge.VERTEX if radius_m < _ROUND_M else Edge.FACE
        return self.edge

    def _decide(self) -> None:
        if self.rate < LEAVES:
            self.edge = Edge.VERTEX
        elif self.rate > RETURNS or self.edge is Edge.UNKNOWN:
            self.edge = Edge.FACE


def _slope(seen: deque[tuple[float, float]]) -> float:
    """Return the slope of places over turns, by least squares."""
    count = len(seen)
    middle, level = sum(x for x, _ in seen) / count, sum(y for _, y in seen) / count
    return sum((x - middle) * (y - level) for x, y in seen) / sum((x - middle) ** 2 for x, _ in seen)
