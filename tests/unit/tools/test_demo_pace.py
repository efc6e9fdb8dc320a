"""The demo's ticks fit the machine: whatever the rate, the configuration stays a good one."""

from __future__ import annotations

import tomllib
from importlib.resources import files

import msgspec
import pytest

from sioms.drivers.sim.axes import SimAxes
from sioms.tools.demo.pace import RATES, paced, rate_for

CONFIG = files("sioms.tools.demo").joinpath("demo.toml").read_text()


@pytest.mark.parametrize("rate_hz", [rate for _, rate in RATES])
def test_every_rate_makes_a_configuration_that_the_driver_takes(rate_hz: float) -> None:
    devices = tomllib.loads(paced(CONFIG, rate_hz))["device"]
    before = tomllib.loads(CONFIG)["device"]
    for name, table in devices.items():
        if table["driver"] != "sim-axes":
            continue
        settings = {key: value for key, value in table.items() if key not in ("driver", "lease_s", "description")}
        described = SimAxes.describe(name, msgspec.convert(settings, SimAxes.Settings))
        assert described.tick_hz == rate_hz
        assert [axis["name"] for axis in table["axis"]] == [axis["name"] for axis in before[name]["axis"]]


def test_less_of_a_processor_means_slower_ticks() -> None:
    rates = [rate_for(share / 100) for share in range(101)]
    assert rates == sorted(rates) and rates[0] == 200.0 and rates[-1] == 1000.0
