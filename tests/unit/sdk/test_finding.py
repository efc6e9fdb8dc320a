"""Drivers found by the path of a file."""

from __future__ import annotations

import math
import os
from pathlib import Path

import pytest

from sioms.sdk import fork_server
from sioms.sdk.finding import DriverNotFound, contents, describe, find_driver, missing_files, read_settings

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


def test_a_file_that_is_named_and_cannot_be_read_is_an_error_whatever_the_driver_says(tmp_path: Path) -> None:
    (tmp_path / "there.toml").write_text("")
    os.mkfifo(tmp_path / "pipe")
    table = {
        "flaws_file": "there.toml", "map": "mapped", "axis": [{"model_file": "gone.toml"}, {"model_file": ""}],
        "inner": {"map": "gone/too.toml", "a_file": "pipe", "b_file": "."},
    }  # fmt: skip
    told = missing_files(table, str(tmp_path))
    assert [line.split(" = ")[0] for line in told] == [": model_file", ": map", ": a_file", ": b_file"]
    assert all("want a file that can be read" in line and str(tmp_path) in line for line in told)


def test_a_reload_hears_of_a_deleted_file_before_the_device_that_runs_ends(tmp_path: Path) -> None:
    table = {"flaws_file": "flaws.toml", "contact": [], "limit": [1.0] * 6}
    (tmp_path / "flaws.toml").write_text("")
    assert fork_server._describe("f", "sim-force", table, str(tmp_path))[0] == []
    for text in ("nonsense = 1", None):
        if text is None:
            (tmp_path / "flaws.toml").unlink()
        else:
            (tmp_path / "flaws.toml").write_text(text)
        (error,) = fork_server._describe("f", "sim-force", table, str(tmp_path))[0]
        assert "flaws_file" in error
    (tmp_path / "own.py").write_text(FILE.replace("    line:", "    table_file: str\n    line:"))
    table = {"table_file": "gone.csv", "line": {"tcp": "localhost:1"}}
    assert "table_file = " in fork_server._describe("d", "own.py", table, str(tmp_path))[0][0]


@pytest.mark.parametrize(("value", "words"), [
    (math.nan, ".noise: nan; want a number"), (-1e16, ".noise: -1e+16; want a number of at most 1e+15"),
    (0.1, ""), (1e15, ""),
])  # fmt: skip
def test_numbers_that_measure_nothing_are_refused_for_every_driver(value: float, words: str) -> None:
    settings, errors = read_settings(find_driver("sim-tactile", "/"), {"noise": value}, "/")
    assert errors == ([words] if words else []) and (settings is None) == bool(words)
    table = {"contact": [{"node": "a.b", "direction": [1.0, value, 0.0]}]}
    settings, errors = read_settings(find_driver("sim-force", "/"), table, "/")
    assert errors == ([words.replace(".noise", ".contact[0].direction[1]")] if words else [])


@pytest.mark.parametrize("name", ["sim-world", "sim-axes", "sim-tactile", "hand"])
@pytest.mark.parametrize("rate", [0.0, -5.0, math.inf, 1e9])
def test_a_rate_that_is_none_is_refused_before_anything_is_divided_by_it(name: str, rate: float) -> None:
    driver = find_driver(name, "/")
    thing = {"object": {"shape": "disk", "radius_m": 0.02}, "finger": []} if name == "sim-world" else {}
    axes = {"axes": [], "axis": []} if name == "hand" else {"axis": []} if name == "sim-axes" else {}
    settings, errors = read_settings(driver, {**thing, **axes, "tick_hz": rate}, "/")
    assert not errors
    facts, errors = describe(driver, "it", settings)
    assert facts is None and errors == [f": rate {rate:g} Hz; want 0.1 to 20000"]
