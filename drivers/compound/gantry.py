"""A gantry: a carriage on a bridge that two parallel axes move; coordinates x, y and skew.

A device made of devices, see drivers/compound/README.md. gantry.toml is an example whose
held axes are simulated; they may be of any device.
"""

from __future__ import annotations

from typing import ClassVar

from sioms.kinematics.gantry import Gantry

from .compound import Compound, CompoundSettings


class GantrySettings(CompoundSettings, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Keys of a gantry.

    Attributes:
        span_m: distance of the two parallel axes [m].
        skew_max: largest skew [rad].
    """

    span_m: float
    skew_max: float = 0.01


class GantryDriver(Compound):
    """Held axes: the carriage on the bridge, and the bridge's two ends."""

    Settings = GantrySettings
    COORDINATES: ClassVar = {"x": "m", "y": "m", "skew": "rad"}

    @classmethod
    def transform(cls, settings: GantrySettings) -> Gantry:
        """Return the map."""
        return Gantry(settings.span_m, settings.skew_max)


DRIVER = GantryDriver
