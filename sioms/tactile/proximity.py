"""Find and undo the pull of a conducting indenter on the elements' fields: an output that touch brings without strain.

A grounded conductor takes field lines from unshielded elements and lowers their output wherever it is near,
whatever the load: d_i = l_i + A exp(-|t_i - t_c|/range), A < 0 (dissertation 3.3.2; its figures give the
size, the form is fitted). Only what does not grow with the load and reaches beyond the strain can be told
from strain.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]

_RANGES = np.radians(np.arange(6.0, 41.0, 1.0))
SHORTEST, LONGEST = float(_RANGES[0]), float(_RANGES[-1])
_GAIN = 0.7  # the fit must leave less than this share of the squares


@dataclass(frozen=True, slots=True)
class Proximity:
    """Hold amplitude A [output] and range [rad]; immutable."""

    amplitude: float
    range_rad: float

    def output(self, distance: ArrayLike) -> Floats:
        """Return the output [1] at angles [rad] from the touch."""
        value: Floats = self.amplitude * np.exp(-np.abs(np.asarray(distance, dtype=np.float64)) / self.range_rad)
        return value


def find_proximity(output: Floats, strain: Floats, distance: Floats) -> Proximity | None:
    """Fit the effect, every element with its own gain; None if strain alone does as well.

    Args:
        output: of every touch and element, shape (nt, ns).
        strain: by the model, or the output it gives, in any unit per element, same shape.
        distance: angle of the element less that of the touch [rad], same shape.
    """
    square = np.sum(strain**2, axis=0) + 1e-30
    alone = output - strain * (np.sum(output * strain, axis=0) / square)
    best, least = Proximity(0.0, 1.0), float(np.sum(alone**2))
    for reach in _RANGES:
        shape = np.exp(-np.abs(distance) / reach)
        # what the gains cannot take up of the shape
        rest = shape - strain * (np.sum(shape * strain, axis=0) / square)
        amplitude = float(np.sum(rest * alone) / np.sum(rest**2))
        left = float(np.sum((alone - amplitude * rest) ** 2))
        if left < least:
            best, least = Proximity(amplitude, float(reach)), left
    return best if best.amplitude < 0.0 and least < _GAIN * float(np.sum(alone**2)) else None
