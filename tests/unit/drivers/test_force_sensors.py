"""What the force/torque drivers have in common."""

from __future__ import annotations

import msgspec

from sioms.drivers.ati_rdt.driver import AtiRdt
from sioms.drivers.ft300.driver import Ft300
from sioms.drivers.schunk_ft.driver import SchunkFt

UDP = {"udp": "192.168.1.1:49152"}


def test_channels_have_units_and_ranges() -> None:
    for driver, table in (
        (Ft300, {"line": {"serial": "/x", "baud": 19200}}),
        (AtiRdt, {"line": UDP, "full_scale": (300, 300, 300, 30, 30, 30)}),
        (SchunkFt, {"line": {"tcp": "h:82"}, "full_scale": (300, 300, 300, 30, 30, 30)}),
    ):
        (block,) = driver.describe("f0", msgspec.convert(table, driver.Settings)).blocks
        assert [(c.name, c.unit, c.minimum, c.maximum) for c in block.channels] == [
            *((name, "N", -300, 300) for name in ("fx", "fy", "fz")),
            *((name, "N*m", -30, 30) for name in ("tx", "ty", "tz")),
        ]
    open_ended = msgspec.convert({"line": UDP}, AtiRdt.Settings)
    assert AtiRdt.describe("f0", open_ended).blocks[0].channels[0].maximum is None
