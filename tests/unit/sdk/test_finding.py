"""Drivers found by the path of a file."""

from __future__ import annotations

from pathlib import Path

import pytest

from sioms.sdk.finding import DriverNotFound, contents, find_driver, read_settings

FILE = """
from __future__ import annotations

import msgspec

from sioms.sdk.blocks import Description
from sioms.sdk.driver import TickDriver
from sioms.sdk.settings import LineSettings


class Settings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    line: LineSettings


class Own(TickDriver):
    Settings = Settings

    @classmethod
    def describe(cls, name, settings):
        return Description((), 10.0)

    blocks = ()

    def tick(self, now_ns):
        pass


DRIVER = Own
"""


def test_annotations_that_are_text_are_understood(tmp_path: Path) -> None:
    (tmp_path / "own.py").write_text(FILE)
    driver = find_driver("./own.py", str(tmp_path))
    settings, errors = read_settings(driver, {"line": {"serial": "/dev/ttyUSB0"}}, str(tmp_path))
    assert not errors and settings.line.serial == "/dev/ttyUSB0"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (None, "no such file"),
        ("1 / 0", "import failed: ZeroDivisionError"),
        ("x = 1", "it defines no DRIVER"),
    ],
)
def test_files_that_are_no_driver(tmp_path: Path, text: str | None, words: str) -> None:
    if text is not None:
        (tmp_path / "own.py").write_text(text)
    with pytest.raises(DriverNotFound, match=words):
        find_driver("./own.py", str(tmp_path))


def test_a_word_that_is_none_of_the_right_ones_and_a_map_beside_the_configuration() -> None:
    driver = find_driver("modbus-axis", "/")
    axis = {"name": "x", "velocity_by": "job"}
    line = {"serial": "/dev/ttyUSB0"}
    settings, errors = read_settings(driver, {"map": "mine.toml", "line": line, "axis": [axis]}, "/etc/sioms")
    assert settings is None and errors == [".axis[0].velocity_by = 'job': want one of 'jog', 'path'"]
    table = {"map": "mine.toml", "line": line, "axis": [{"name": "x"}]}
    assert read_settings(driver, table, "/etc/sioms")[0].map == "/etc/sioms/mine.toml"
    assert read_settings(driver, {**table, "map": "leadshine"}, "/etc/sioms")[0].map == "leadshine"


def test_the_contents_of_a_device_are_the_files_that_it_names(tmp_path: Path) -> None:
    driver = find_driver("sim-io", "/")
    (tmp_path / "a.toml").write_text("x = 1")

    def of(table: dict[str, object]) -> str:
        return contents(driver, table, str(tmp_path))

    before = of({"map": "a.toml", "axis": [{"model_file": "a.toml"}]})
    assert before == of({"map": "a.toml", "axis": [{"model_file": "a.toml"}]}) != of({"map": "shipped"})
    (tmp_path / "a.toml").write_text("x = 2")
    assert of({"map": "a.toml", "axis": [{"model_file": "a.toml"}]}) != before
    assert of({"map": "shipped"}) == of({"map": "gone.toml", "description": "a.toml"})
