"""A mill of five axes with a tilting and turning table; coordinates are those of the tool in the workpiece.

A device made of devices, see drivers/compound/README.md. mill.toml is an example whose
held axes are simulated; they may be of any device.
"""

from __future__ import annotations

import math
from typing import ClassVar

from sioms.kinematics.mill import Mill

from .compound import Compound, CompoundSettings


class MillSettings(CompoundSettings, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Keys of a mill.

    Attributes:
        pivot_m: where the cradle's axis is in the machine's frame, x that of the table [m].
        table_m: from the cradle's axis to the origin of the workpiece's frame at no tilt, along y and z [m].
        tool_m: from where z counts down to the tool's tip [m].
        tilt_max: largest |tilt| [rad].
    """

    pivot_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    table_m: tuple[float, float] = (0.0, 0.0)
    tool_m: float = 0.0
    tilt_max: float = 0.5 * math.pi


class MillDriver(Compound):
    """Held axes: x, y and z of the spindle, the cradle that tilts about x, and the table that turns."""

    Settings = MillSettings
    COORDINATES: ClassVar = {"x": "m", "y": "m", "z": "m", "tilt": "rad", "turn": "rad"}

    @classmethod
    def transform(cls, settings: MillSettings) -> Mill:
        """Return the map."""
        return Mill(settings.pivot_m, settings.table_m, settings.tool_m, settings.tilt_max)


DRIVER = MillDriver
