"""A gantry: a carriage on a bridge that two parallel axes move; coordinates x, y and skew.

A device made of devices, see drivers/compound/README.md. The held axes may be of any device; here they are simulated.

    [device.bridge]
    driver = "gantry"
    axes = ["portal.x", "portal.y1", "portal.y2"]   # carriage, and the two ends of the bridge
    span_m = 1.0
    [[device.bridge.axis]]
    name = "x"
    velocity_max = 0.1
    acceleration_max = 1.0
    [[device.bridge.axis]]
    name = "y"
    velocity_max = 0.1
    acceleration_max = 1.0
    [[device.bridge.axis]]
    name = "skew"
    velocity_max = 0.05
    acceleration_max = 0.5
    [device.portal]
    driver = "sim-axes"
    [[device.portal.axis]]
    name = "x"
    position_min = -0.5
    position_max = 0.5
    velocity_max = 0.2
    acceleration_max = 2.0
    force_max = 20.0
    motor = { mass = 1.0, viscous = 4.0 }
    [[device.portal.axis]]
    name = "y1"
    position_min = -0.5
    position_max = 0.5
    velocity_max = 0.2
    acceleration_max = 2.0
    force_max = 20.0
    motor = { mass = 1.0, viscous = 4.0 }
    [[device.portal.axis]]
    name = "y2"
    position_min = -0.5
    position_max = 0.5
    velocity_max = 0.2
    acceleration_max = 2.0
    force_max = 20.0
    motor = { mass = 1.0, viscous = 4.0 }
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
