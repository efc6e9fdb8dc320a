"""A pair of slits: two blades that leave a gap; coordinates centre and gap.

A device made of devices, see drivers/compound/README.md. The held axes may be of any device; here they are simulated.

    [device.slits]
    driver = "slits"
    axes = ["blades.minus", "blades.plus"]
    least_m = 0.0
    [[device.slits.axis]]
    name = "centre"
    velocity_max = 0.05
    acceleration_max = 0.5
    [[device.slits.axis]]
    name = "gap"
    velocity_max = 0.05
    acceleration_max = 0.5
    [device.blades]
    driver = "sim-axes"
    [[device.blades.axis]]
    name = "minus"
    position_min = -0.5
    position_max = 0.5
    velocity_max = 0.2
    acceleration_max = 2.0
    force_max = 20.0
    motor = { mass = 1.0, viscous = 4.0 }
    [[device.blades.axis]]
    name = "plus"
    position_min = -0.5
    position_max = 0.5
    velocity_max = 0.2
    acceleration_max = 2.0
    force_max = 20.0
    motor = { mass = 1.0, viscous = 4.0 }
"""

from __future__ import annotations

from typing import ClassVar

from sioms.kinematics.slits import Slits

from .compound import Compound, CompoundSettings


class SlitsSettings(CompoundSettings, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Keys of a pair of slits.

    Attributes:
        least_m: the least gap that is commanded [m].
    """

    least_m: float = 0.0


class SlitsDriver(Compound):
    """Held axes: the blade on the minus side, and that on the plus side."""

    Settings = SlitsSettings
    COORDINATES: ClassVar = {"centre": "m", "gap": "m"}

    @classmethod
    def transform(cls, settings: SlitsSettings) -> Slits:
        """Return the map."""
        return Slits(settings.least_m)


DRIVER = SlitsDriver
