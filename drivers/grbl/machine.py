"""What a Grbl controller tells of its machine, without I/O: positions out of any form of report, and its limits."""

from __future__ import annotations

import errno
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from sioms.sdk.exchange import DeviceError

from .codec import Report

SPEED, ACCELERATION, INCHES = 110, 120, 13
"""Settings: greatest speed [/min] and acceleration [/s^2] of the first axis, reports in inches."""


class MachinePosition:
    """Machine positions of some axes, whether reports tell them, or work positions and now and then an offset.

    Args:
        index: of our axes among the controller's.
        name: for messages.

    Attributes:
        in_report: mm in a unit of the report.
    """

    def __init__(self, index: Sequence[int], name: str) -> None:
        self._index, self._name = list(index), name
        self._offset: tuple[float, ...] = ()
        self.in_report = 1.0

    def note(self, report: Report) -> bool:
        """Keep what not every report tells; return whether positions can be told now."""
        self._offset = report.offset or self._offset
        return report.machine is not None or bool(self._offset)

    def of(self, report: Report) -> NDArray[np.float64]:
        """Return the positions, shape (n,) [mm or degrees].

        Raises:
            DeviceError: the report tells none, or fewer axes than are used.
        """
        values = report.machine
        if values is None and report.work is not None and len(self._offset) == len(report.work):
            values = tuple(w + o for w, o in zip(report.work, self._offset, strict=True))
        if values is None or max(self._index) >= len(values):
            known = len(values) if values is not None else 0
            text = f"read {self._name}: the report tells {known} machine positions; {max(self._index) + 1} are needed"
            raise DeviceError(errno.ENODEV, f"{text}, set $10=1 or check the letters of the axes")
        return np.array([values[index] for index in self._index]) * self.in_report


def compare_limits(
    found: Mapping[int, float], index: int, per_unit: float, velocity_max: float, acceleration_max: float
) -> bool:
    """Compare the controller's limits of an axis with the configured ones; return whether it tells them.

    Args:
        found: the controller's settings.
        index: of the axis in the controller.
        per_unit: its mm or degrees in a unit of the axis.
        velocity_max, acceleration_max: configured, in units of the axis.

    Raises:
        DeviceError: it would run slower than configured, or accelerate otherwise.
    """
    speed, rate = found.get(SPEED + index), found.get(ACCELERATION + index)
    if speed is None or rate is None:
        return False
    speed, rate = speed / 60 / per_unit, rate / per_unit
    if velocity_max > speed * 1.001:
        text = f"velocity_max = {velocity_max:g}, but ${SPEED + index} of the controller is {speed:g}"
        raise DeviceError(errno.ERANGE, f"{text}; want at most that")
    if not 0.95 < acceleration_max / rate < 1.05:
        text = f"acceleration_max = {acceleration_max:g}, but ${ACCELERATION + index} of the controller"
        raise DeviceError(errno.ERANGE, f"{text} is {rate:g}; want that")
    return True
