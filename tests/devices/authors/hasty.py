"""A driver that takes a late reply for the next one: it does not stay silent after a time-out."""

from __future__ import annotations

from typing import Any, ClassVar

from sioms.drivers.tmcl.driver import Tmcl, TmclUnit
from sioms.sdk.driver import Kit
from sioms.sdk.exchange import Steps

TABLES = """
[device.hasty]
driver = "{driver}"
module = 1140
poll_hz = 50.0
line = { serial = "{port}", baud = 115200 }
[[device.hasty.axis]]
name = "x"
motor = 0
travel_per_turn = 0.01
velocity_max = 0.1
acceleration_max = 2.0
position_min = -1.0
position_max = 1.0
"""


class HastyUnit(TmclUnit):
    def _prove(self) -> Steps:
        yield from ()

    def _into_step(self, *, search: bool) -> Steps:
        yield from ()


class Hasty(Tmcl):
    rig: ClassVar = {"simulator": ["sioms.drivers.tmcl.simulator"], "tables": TABLES}

    def __init__(self, name: str, settings: Any, kit: Kit) -> None:
        super().__init__(name, settings, kit)
        self._units = (HastyUnit(name, settings, self.describe(name, settings).blocks[0], kit),)
        self.recovery_s = 0.0


DRIVER = Hasty
