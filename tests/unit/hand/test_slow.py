"""A cell in slow motion: the same curve in a multiple of the time."""

from __future__ import annotations

import argparse
import copy
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hand_cell_rig import HandCell, write

from sioms.documents import toml_text
from sioms.hand.command import slow as command
from sioms.hand.follow import D
from sioms.hand.slow import slowed
from sioms.motion.law import ControlLaw
from sioms.motion.settings import AxisSettings, Watch
from sioms.motion.watch import tolerance_of

ETC = Path(__file__).resolve().parents[3] / "etc"


def _tables() -> dict[str, Any]:
    return tomllib.loads((ETC / "hand.toml").read_text(encoding="utf-8"))


@pytest.mark.parametrize("pace", [0.005, 1.5, float("nan")])
def test_a_pace_that_is_none_is_refused(pace: float) -> None:
    with pytest.raises(ValueError, match=r"want 0\.01 to 1"):
        slowed(_tables(), pace, ETC)


def test_a_device_that_is_not_simulated_is_refused() -> None:
    with pytest.raises(ValueError, match="device real has the driver 'modbus-axis'"):
        slowed({"device": {"real": {"driver": "modbus-axis"}}}, 0.5, ETC)


def test_what_is_written_is_what_was_made() -> None:
    tables = slowed(_tables(), 0.25, ETC)
    assert tomllib.loads(toml_text(tables)) == tables
    assert Path(tables["device"]["touch1"]["shape"]["finger_file"]).is_absolute()
    assert tables["device"]["hand"]["pace"] == 0.25 and tables["device"]["left"]["world_age_max_s"] == 0.2


def test_the_hand_ticks_sooner_after_its_fingers_than_the_next_process_would() -> None:
    first, *others = slowed(_tables(), 0.25, ETC)["device"].items()
    assert first[0] == "hand" and {device["process"] for _, device in others} == {"simulation"}


def test_one_pace_goes_on_top_of_another() -> None:
    once, twice = slowed(_tables(), 0.125, ETC), slowed(slowed(_tables(), 0.5, ETC), 0.25, ETC)
    assert toml_text(once) == toml_text(twice)  # powers of two are exact


@pytest.mark.parametrize("pace", [0.3, 0.1])
def test_in_slow_motion_axes_may_be_behind_and_be_pushed_as_far_as_ever(pace: float) -> None:
    """A force bends a link as far at any pace: at 0.1 a roll with what is held came to 0.09 rad of 0.1."""

    def limits(pace: float) -> list[float]:
        found: list[float] = []
        for _, table in sorted((slowed(_tables(), pace, ETC) if pace < 1.0 else _tables())["device"].items()):
            for axis in table.get("axis", []):
                told = {key: axis[key] for key in ("velocity_max", "following_error_max") if key in axis}
                settings = AxisSettings(axis["name"], k=1.0, watch=Watch(**axis.get("watch", {})), **told)
                law = ControlLaw([settings], 1e-3)
                found += [float(law.arrays["error_max"][0]), tolerance_of(settings)]
        return found

    assert limits(pace) == pytest.approx(limits(1.0), rel=1e-9)


def _closing(pace: float) -> list[tuple[float, ...]]:
    """Close the open hand on the object, with the links soft and the object free; show what moves, in its own time."""

    def change(tables: dict[str, Any]) -> None:
        for name in ("touch1", "touch2", "wrist1", "wrist2"):  # what they feel is not looked at here
            tables[name]["tick_hz"] = 20.0
        tables |= slowed({"device": copy.deepcopy(tables)}, pace, ETC)["device"]

    cell = HandCell(change, compiled=False)
    seen = []
    for _ in range(6):
        write(cell.bank, [(D, False, -0.3 * pace)], cell.now_ns)
        cell.advance(0.08 / pace)
        left = cell.drivers["left"].bank.rows["position"]
        seen.append((*cell.coordinates, *map(float, left), *cell.world.pose))
    return seen


def test_slow_motion_is_the_same_motion() -> None:
    whole, half = np.array(_closing(1.0)), np.array(_closing(0.5))
    way = np.abs(whole - whole[0]).max()
    assert way > 0.1 and np.abs(whole[-1, -3:] - whole[0, -3:]).max() > 1e-3  # it was met, and moved
    assert np.abs(whole - half).max() < 0.02 * way


@pytest.mark.parametrize(
    ("tables", "says"),
    [
        ({"a": 1}, "slow cell: a = 1; want a table"),
        ({"device": 1}, "slow cell: device = 1; want a table"),
        ({"device": {"left": [1]}}, r"slow cell: device\.left = \[1\]; want a table"),
        ({"device": {"left": {"driver": "sim-axes", "axis": [{"velocity_max": "1"}]}}}, 'velocity_max = "1"; want a n'),
        ({"device": {"left": {"driver": "sim-axes", "axis": [{"motor": 1}]}}}, "motor = 1; want a table"),
        ({"device": {"left": {"driver": "sim-axes", "axis": [{"watch": 1}]}}}, "watch = 1; want a table"),
    ],
)
def test_what_is_no_configuration_is_refused(tables: dict[str, Any], says: str) -> None:
    with pytest.raises(ValueError, match=says):
        slowed(tables, 0.5, ETC)


def test_alarms_and_rights_stay() -> None:
    tables = _tables()
    tables["grant"] = [{"users": ["eva"], "nodes": ["*"], "rights": ["read"]}]
    tables["alarm"] = [{"node": "left", "high": 1.0}, {"node": "right", "high": 2.0}]
    assert tomllib.loads(toml_text(slowed(tables, 0.5, ETC)))["alarm"] == tables["alarm"]


def test_a_file_that_is_no_toml_is_named(tmp_path: Path) -> None:
    (tmp_path / "cell.toml").write_text("Debian 12\n")
    args = argparse.Namespace(config=tmp_path / "cell.toml", pace=0.5, output=None)
    with pytest.raises(ValueError, match=r"read .*cell\.toml: line 1: Debian 12: expected '='"):
        command.run(args)
