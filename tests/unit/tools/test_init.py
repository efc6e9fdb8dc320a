"""``sioms init``: what is written is a configuration that the daemon accepts, for every driver and every port."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest

from sioms.tools import init
from sioms.tools.driver import drivers
from sioms.tools.front import main
from sioms.tools.ports import Port, candidates, found, stanza

DRIVERS = [entry.name for entry in drivers()]


@pytest.fixture(autouse=True)
def _folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(init, "found", list)


def test_the_examples_of_all_drivers_are_a_good_configuration() -> None:
    text = Path(init.__file__).with_name("starter_simulated.toml").read_text()
    for i, driver in enumerate(DRIVERS):
        assert f'driver = "{driver}"' in init.example(driver)
        lines = stanza(init.example(driver), None, f"d{i}").replace('"mod0.plant.', '"arm0.plant.')
        text += "\n" + re.sub(r"/dev/tty(USB|ACM)0", rf"/dev/tty\g<1>{i}", lines) + "\n"  # a port each
    Path("all.toml").write_text(text)
    assert init.check(Path("all.toml")) == 0


@pytest.mark.parametrize("driver", ["tmcl", "sim-force"])
def test_a_device_of_a_driver_comes_with_what_it_needs(driver: str) -> None:
    assert main(["init", "mine.toml", "--driver", driver]) == 0  # the status is that of the daemon's check
    devices = tomllib.loads(Path("mine.toml").read_text())["device"]
    assert devices["device0"]["driver"] == driver
    assert ("arm0" in devices) == driver.startswith("sim-")


def test_without_a_word_the_devices_are_simulated(tmp_path: Path) -> None:
    assert main(["init"]) == 0
    cell = tomllib.loads(Path("workcell.toml").read_text())
    assert cell["workcell"]["name"] == tmp_path.name
    assert {device["driver"] for device in cell["device"].values()} == {"sim-axes", "sim-io"}


def test_a_file_that_is_there_is_left_alone(capsys: pytest.CaptureFixture[str]) -> None:
    Path("workcell.toml").write_text("mine")
    assert main(["init"]) == 1
    assert "already exists; --force" in capsys.readouterr().err
    assert Path("workcell.toml").read_text() == "mine"
    assert main(["init", "--force"]) == 0


def test_what_is_plugged_in_is_a_device_when_it_is_recognised_and_a_comment_otherwise(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    ports = [
        Port("/dev/serial/by-id/odrive", "ODrive", ("odrive",), True),
        Port("/dev/serial/by-id/ftdi", "FT232R", candidates(0x0403, 0x6001)),
        Port("/dev/gpiochip0", "lines of a GPIO chip", ("gpio",)),
        Port("ads1115", "iio:device0 of Linux IIO", ("iio",)),
    ]
    monkeypatch.setattr(init, "found", lambda: ports)
    assert main(["init"]) == 0
    text = Path("workcell.toml").read_text()
    devices = tomllib.loads(text)["device"]
    assert devices["joint0"]["line"] == {"serial": "/dev/serial/by-id/odrive"}
    assert set(devices) == {"arm0", "io0", "joint0"}
    uncommented = [line.removeprefix("# ") for line in text.splitlines() if line.startswith("# ")]
    assert 'chip = "/dev/gpiochip0"' in uncommented and 'device = "ads1115"' in uncommented
    assert any('serial = "/dev/serial/by-id/ftdi"' in line for line in uncommented)


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["--driver", "tmc"], "no driver tmc; did you mean tmcl?"),
        (["--port", "/dev/x"], "--port needs --driver"),
    ],
)
def test_what_cannot_be_is_a_sentence(words: list[str], sentence: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["init", *words]) == 1
    assert sentence in capsys.readouterr().err
    assert not Path("workcell.toml").exists()


@pytest.mark.parametrize(
    ("port", "line"),
    [
        ("/dev/mine", 'line = { serial = "/dev/mine", baud = 9600 }'),
        ("10.0.0.3:4001", 'line = { tcp = "10.0.0.3:4001" }'),
    ],
)
def test_a_line_leads_to_the_port(port: str, line: str) -> None:
    example = '[device.a]\nline = { serial = "/dev/ttyUSB0", baud = 9600 }\n[[device.a.axis]]\nname = "x"'
    text = stanza(example, Port(port, "", ()), "b")
    assert text == f'[device.b]\n{line}\n[[device.b.axis]]\nname = "x"'


def test_chips_and_converters_of_the_kernel_are_found(tmp_path: Path) -> None:
    (tmp_path / "dev").mkdir()
    (tmp_path / "dev/gpiochip1").touch()
    device = tmp_path / "sys/bus/iio/devices/iio:device0"
    device.mkdir(parents=True)
    (device / "name").write_text("ads1115\n")
    assert [(port.path, port.drivers) for port in found(tmp_path)] == [
        ("/dev/gpiochip1", ("gpio",)), ("ads1115", ("iio",)),
    ]  # fmt: skip
