"""An arm of two links, a lift and a wrist (SCARA); coordinates x, y, z and angle of the tool.

A device made of devices, see drivers/compound/README.md. arm.toml is an example whose
held axes are simulated; they may be of any device.
"""

from __future__ import annotations

from typing import ClassVar, Literal

from sioms.kinematics.arm import Arm

from .compound import Compound, CompoundSettings


class ArmSettings(CompoundSettings, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Keys of an arm.

    Attributes:
        upper_m: from the shoulder's axis to the elbow's [m].
        fore_m: from the elbow's axis to the wrist's [m].
        elbow: the side to which it is bent, "left" where the elbow's angle is positive.
        bend_rad: least angle by which the elbow stays away from stretched and from folded [rad].
        facing_rad: the middle of the shoulder's travel, which is less than a turn [rad].
    """

    upper_m: float
    fore_m: float
    elbow: Literal["left", "right"] = "left"
    bend_rad: float = 0.1
    facing_rad: float = 0.0


class ArmDriver(Compound):
    """Held axes: shoulder, elbow, lift and wrist."""

    Settings = ArmSettings
    COORDINATES: ClassVar = {"x": "m", "y": "m", "z": "m", "angle": "rad"}

    @classmethod
    def transform(cls, settings: ArmSettings) -> Arm:
        """Return the map."""
        return Arm(settings.upper_m, settings.fore_m, settings.elbow == "left", settings.bend_rad, settings.facing_rad)


DRIVER = ArmDriver
