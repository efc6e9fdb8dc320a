"""A driver that trusts its module: it never looks whether what it set still holds, and its axis may turn by itself."""

from __future__ import annotations

from typing import Any, ClassVar

from sioms.drivers.tmcl.driver import Tmcl, TmclUnit
from sioms.sdk.driver import Kit
from sioms.sdk.exchange import Steps


class TrustingUnit(TmclUnit):
    def _prove(self) -> Steps:
        yield from ()


class Trusting(Tmcl):
    rig: ClassVar = {
        "simulator": ["sioms.drivers.tmcl.simulator"],
        "tables": (
            '[device.trusting]\ndriver = "{driver}"\nmodule = 1140\npoll_hz = 50.0\n'
            'line = { serial = "{port}", baud = 115200 }\n[[device.trusting.axis]]\nname = "x"\nmotor = 0\n'
            "travel_per_turn = 0.01\nvelocity_max = 0.1\nacceleration_max = 2.0\nposition_min = -1.0\nposition_max = "
            "1.0\n"
            "watch = { uncommanded = false }\n"
        ),
    }

    def __init__(self, name: str, settings: Any, kit: Kit) -> None:
        super().__init__(name, settings, kit)
        self._units = (TrustingUnit(name, settings, self.describe(name, settings).blocks[0], kit),)


DRIVER = Trusting
