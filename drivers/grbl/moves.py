"""Moves of Grbl axes, without I/O: what was asked for, what is under way, and what a stop of another axis has cut
short.

Positions and speeds are in the units of the axes (m or rad); the controller's, mm or degrees, stay inside.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from sioms.sdk.exchange import DeviceError

AT_MM = 0.002
"""So near to its target an axis has arrived [mm or degrees]; reports have three digits."""

Moves = dict[int, tuple[float, float]]
"""Axis to target and top speed."""


class GrblMoves:
    """The moves of all axes.

    Args:
        per_unit: mm or degrees in a unit of each axis, shape (n,).

    Attributes:
        asked: moves that go out with the next line.
        refused: what the controller said against the last move of an axis.
        interrupted: jogs of all axes were cancelled; those that nobody has stopped shall go on.
    """

    def __init__(self, per_unit: NDArray[np.float64]) -> None:
        self._per_unit = per_unit
        self._targets = np.full(len(per_unit), np.nan)
        self._speeds = np.zeros(len(per_unit))
        self.asked: Moves = {}
        self.refused: dict[int, DeviceError] = {}
        self.interrupted = False

    @property
    def bound(self) -> NDArray[np.bool_]:
        """Which axes have a target."""
        found: NDArray[np.bool_] = np.isfinite(self._targets)
        return found

    def forget(self) -> None:
        """Forget everything: all axes have been stopped."""
        self._targets[:] = np.nan
        self.asked.clear()
        self.refused.clear()
        self.interrupted = False

    def drop(self, axis: int) -> None:
        """Forget the target of an axis that was stopped or told something else."""
        self._targets[axis] = np.nan

    def arrived(self, here: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Tell which axes stand on their targets."""
        found: NDArray[np.bool_] = np.abs(here * self._per_unit - self._targets) <= AT_MM
        return found

    def is_on_its_way(self, axis: int, here: float) -> bool:
        """Tell whether an axis has a target and is not there."""
        return bool(abs(here * self._per_unit[axis] - self._targets[axis]) > AT_MM)

    def left(self, here: NDArray[np.float64]) -> Moves:
        """Return the moves that a stop of another axis has cut short."""
        if not self.interrupted:
            return {}
        short = self.bound & ~self.arrived(here)
        return {
            a: (float(self._targets[a] / self._per_unit[a]), float(self._speeds[a]))
            for a in np.flatnonzero(short).tolist()
        }

    def take(self, here: NDArray[np.float64]) -> Moves:
        """Return what goes out with the next line: what was asked for, and what was cut short."""
        together, self.asked = self.left(here) | self.asked, {}
        self.interrupted = False
        return together

    def begin(self, together: Moves) -> Moves:
        """Note that a line with these moves goes out; return them in the controller's units."""
        sent = {}
        for axis, (position, speed) in together.items():
            per_unit = float(self._per_unit[axis])
            self._targets[axis], self._speeds[axis] = position * per_unit, speed
            sent[axis] = (position * per_unit, speed * per_unit)
        return sent

    def refuse(self, axes: Iterable[int], refusal: DeviceError) -> None:
        """Note that the controller has refused the line of these axes."""
        for axis in axes:
            self._targets[axis], self.refused[axis] = np.nan, refusal
