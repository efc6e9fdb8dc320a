"""A pair of slits: two blades that leave a gap; coordinates centre and gap.

A device made of devices, see drivers/compound/README.md. slits.toml is an example whose
held axes are simulated; they may be of any device.
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
