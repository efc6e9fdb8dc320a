"""The demo fits the machine: whatever the rate, its configuration stays a good one, and it says what it waits for."""

from __future__ import annotations

import errno
import threading
import tomllib
from importlib.resources import files
from pathlib import Path

import msgspec
import pytest

from sioms.daemon.config import parse
from sioms.drivers.modbus.axis import ModbusAxis, ModbusAxisSettings
from sioms.drivers.modbus.io import ModbusIo, ModbusIoSettings
from sioms.drivers.sim.axes import SimAxes
from sioms.tools.demo import rig
from sioms.tools.demo.pace import RATES, paced, patient, rate_for

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


def test_simulated_boards_may_be_silent_for_long_on_a_busy_machine(tmp_path: Path) -> None:
    """A drive that had to wait for a processor was taken for lost, and the demo ended with an error."""
    text = patient(files("sioms.tools.demo").joinpath("bench-modbus.toml").read_text())
    config, errors = parse(text, str(tmp_path))
    assert config is not None and errors == []
    assert config.workcell.daemon_lease_s >= 10.0
    assert len(config.devices) == 3 and all(device.common.lease_s >= 10.0 for device in config.devices.values())
    slide = msgspec.convert(config.devices["slide0"].settings, ModbusAxisSettings)
    assert ModbusAxis.describe("slide0", slide) and slide.axis[0].override["turnaround_s"] >= 1.0
    block = msgspec.convert(config.devices["io0"].settings, ModbusIoSettings)
    assert ModbusIo.describe("io0", block) and block.override["turnaround_s"] >= 1.0


def test_a_wait_that_takes_long_or_fails_says_for_what(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """As an OSError, which the front door tells in one line."""
    with rig.waiting("something quick"):
        pass
    monkeypatch.setattr(rig, "SLOW_S", 0.0)
    said, tell = threading.Event(), rig._tell
    monkeypatch.setattr(rig, "_tell", lambda what: (tell(what), said.set()))
    for failure, number in (
        (OSError(errno.ETIMEDOUT, "it took too long"), errno.ETIMEDOUT),
        (RuntimeError("it ended"), errno.EIO),
    ):
        with (
            pytest.raises(OSError, match=f"wait for the marker: {failure.args[-1]}") as raised,
            rig.waiting("the marker"),
        ):
            assert said.wait(60.0)
            raise failure
        assert raised.value.errno == number
    with pytest.raises(BrokenPipeError), rig.waiting("the marker"):
        raise BrokenPipeError
    assert capsys.readouterr().out.startswith("  waiting for the marker ...\n")
