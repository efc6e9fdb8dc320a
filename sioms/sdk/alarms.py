"""Limits of analog channels and the bits of those that are reached.

Concurrency: owned by the one thread of the driver process.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sioms.protocol.flags import AnalogStatus

LOLO, LOW = int(AnalogStatus.LOLO), int(AnalogStatus.LOW)
HIGH, HIHI = int(AnalogStatus.HIGH), int(AnalogStatus.HIHI)
LIMITS = LOLO | LOW | HIGH | HIHI


class Alarms:
    """The limits of n channels, none at first, and which of them are reached.

    A limit is reached at its value, and left when the value is inside of it by more than the hysteresis.
    """

    def __init__(self, n: int) -> None:
        self.lower = np.full((2, n), -np.inf)
        self.upper = np.full((2, n), np.inf)
        self._hysteresis = np.zeros(n)
        self._below, self._above = np.zeros((2, 2, n), dtype=bool)

    def watch(
        self, channels: Sequence[int], lolo: float, low: float, high: float, hihi: float, hysteresis: float
    ) -> None:
        """Give channels their limits; infinite where there is none [unit of the channels]."""
        chosen = list(channels)
        self.lower[:, chosen] = [[lolo], [low]]
        self.upper[:, chosen] = [[high], [hihi]]
        self._hysteresis[chosen] = hysteresis

    def look(self, values: NDArray[np.float64]) -> NDArray[np.int64]:
        """Return the LOLO, LOW, HIGH and HIHI bits of the channels at these values (n,); not a number has none."""
        slack = self._hysteresis
        below, above = self._below, self._above
        np.less_equal(values, self.lower + slack * below, out=below)
        np.greater_equal(values, self.upper - slack * above, out=above)
        bits: NDArray[np.int64] = below[0] * LOLO + below[1] * LOW + above[0] * HIGH + above[1] * HIHI
        return bits
