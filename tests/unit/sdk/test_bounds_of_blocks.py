"""What a driver describes is bounded before memory is given to it."""

from __future__ import annotations

import re
from typing import Any

import pytest

from sioms.sdk.finding import describe, find_driver, read_settings

AXIS: dict[str, Any] = {
    "position_min": -1.0,
    "position_max": 1.0,
    "velocity_max": 1.0,
    "acceleration_max": 10.0,
    "jerk_max": 2000.0,
    "force_max": 9.0,
    "following_error_max": 0.05,
    "motor": {"mass": 1.0, "viscous": 2.0, "coulomb": 0.5, "stiction": 0.6, "encoder_step": 1e-6},
}


@pytest.mark.parametrize(
    ("driver", "table", "words"),
    [
        ("sim-io", {"outputs": 8, "history": 10**18}, "history = 1000000000000000000; want a power of two"),
        ("sim-io", {"outputs": 8, "history": 100}, "history = 100; want a power of two"),
        ("sim-io", {"outputs": 8, "history": 0}, "history = 0; want a power of two"),
        (
            "sim-axes",
            {"axis": [{"name": "x", **AXIS}], "capacity": 10**12},
            "capacity = 1000000000000; want 1 to",
        ),
        ("sim-axes", {"axis": [{"name": "x\x1b[2J", **AXIS}]}, r"named 'x.+x1b.2J'; want"),
    ],
)
def test_what_takes_no_end_of_memory_is_an_error(driver: str, table: dict[str, object], words: str) -> None:
    found = find_driver(driver, "/")
    settings, errors = read_settings(found, table, "/")
    if settings is not None:
        errors += describe(found, "dev", settings)[1]
    assert any(re.search(words, error) for error in errors), errors
