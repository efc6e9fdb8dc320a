"""Every number of the cell of etc/hand.toml, also those that it does not name: what measures nothing is refused."""

from __future__ import annotations

import json
import math
import re
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest
from settings_rig import OF_THE_DAEMON, changed, said

from sioms.hand.slow import slowed
from sioms.sdk.finding import find_driver, read_settings

ETC = Path(__file__).resolve().parents[3] / "etc"
DEVICES = ("world", "hand", "left", "touch1", "wrist1")
UNBOUNDED = {
    "hand": {"link_stiffness"},
    "left": {"bandwidth_hz", "limit_minus", "limit_plus", "home", "supply_v", "stop_minus", "stop_plus", "index_pitch"},
    "touch1": {"indenter_radius_m", "load_scale", "load_deviation"},  # the latter are read with a load_node
    "wrist1": {"limit"},
}
"""Keys that may be infinite, in which there is no bound, no spring, or a flat."""
LIMITS = {
    "position_min", "position_max", "velocity_max", "acceleration_max", "force_max", "velocity_filter_s", "tolerance",
    "deadband", "following_error_max",
}  # fmt: skip
"""The same of all axes."""


def numbers(value: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Yield the path of each number."""
    if isinstance(value, dict | list):
        for key, each in value.items() if isinstance(value, dict) else enumerate(value):
            yield from numbers(each, (*path, key))
    elif isinstance(value, float):
        yield path


@pytest.mark.parametrize("name", DEVICES)
def test_no_number_of_a_hands_cell_is_none_or_without_bound(name: str) -> None:
    written = tomllib.loads((ETC / "hand.toml").read_text(encoding="utf-8"))["device"][name]
    driver = find_driver(written["driver"], str(ETC))
    table = {key: value for key, value in written.items() if key not in OF_THE_DAEMON}
    settings, errors = read_settings(driver, table, str(ETC))
    assert not errors
    whole = json.loads(json.dumps(msgspec.to_builtins(settings)))
    assert not said(driver, whole, ETC)
    paths = [path for path in numbers(whole) if not (path[0] == "axis" and path[1] == 1)]
    assert len(paths) > 5
    passed = {
        ".".join(map(str, path))
        for path in paths
        for number in (math.nan, math.inf, -math.inf)
        if not said(driver, changed(whole, path, number), ETC)
        and (math.isnan(number) or not {*path} & (LIMITS | UNBOUNDED.get(name, set())))
    }
    assert not passed, "these numbers may be none, or without bound"


@pytest.mark.parametrize("pace", [1.0, 0.1, 0.01])
def test_a_cell_in_slow_motion_is_within_all_bounds(pace: float) -> None:
    tables = tomllib.loads((ETC / "hand.toml").read_text(encoding="utf-8"))
    for device in slowed(tables, pace, ETC)["device"].values():
        table = {key: value for key, value in device.items() if key not in OF_THE_DAEMON}
        assert not said(find_driver(device["driver"], str(ETC)), table, ETC)


@pytest.mark.parametrize(("driver", "table", "words"), [
    ("sim-force", {"noise": [-0.1, 0, 0, 0, 0, 0]}, "noise .*; want 0 or more"),
    ("sim-force", {"limit": [0.0, 1, 1, 1, 1, 1]}, "limit .*; want more than 0"),
    ("sim-tactile", {"noise": -0.1}, "noise -0.1; want 0 or more"),
    ("sim-tactile", {"resolution": -0.1}, "resolution -0.1; want 0 or more"),
    ("sim-axes", {"late_max_s": 0.0, "axis": []}, "late_max_s 0; want at least a tick|axis: none given"),
])  # fmt: skip
def test_numbers_below_what_they_can_be_are_refused(driver: str, table: Any, words: str) -> None:
    (error,) = said(find_driver(driver, "/"), table, ETC)
    assert re.search(words, error), error
