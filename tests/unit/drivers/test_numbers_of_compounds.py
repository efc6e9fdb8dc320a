"""Every setting of every compound, also those that its example does not name: what measures no machine is refused."""

from __future__ import annotations

import json
import math
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest
from settings_rig import OF_THE_DAEMON, changed, said

from sioms.sdk.finding import find_driver, read_settings

ROOM = Path(__file__).resolve().parents[3] / "drivers" / "compound"
WRONG = (math.nan, math.inf, -math.inf, -1.0, 0.0, 1e-300, 1e12, -1e12, "x", True, [], {})
ANY_SIGN = {"position_min", "position_max", "facing_rad", "pivot_m", "table_m"}
FITTING: dict[str, tuple[Any, ...]] = {
    "velocity_filter_s": (0.0, 1e-300), "deadband": (0.0, 1e-300), "damper": (0.0,), "force_scale": (-1.0,),
    "least_m": (0.0, 1e-300), "tool_m": (0.0, 1e-300), "link_stiffness": (math.inf, 1e12), "uncommanded": (True,),
    "filter_s": (0.0, 1e-300), "contact_n": (0.0, 1e-300), "damping": (0.0, 1e-300),
}  # fmt: skip
"""What of these a key may be: none, no spring that gives, or of either sign."""
TEXTS = {"name", "description", "force_node", "model_file"}


def cells() -> Iterator[tuple[str, Any]]:
    """Yield the examples of all compounds, and the hand that squeezes, each as kind and table of its device."""
    for path in [*sorted(ROOM.glob("*.toml")), ROOM.parents[1] / "etc" / "hand.toml"]:
        devices = tomllib.loads(path.read_text(encoding="utf-8"))["device"].values()
        kinds = {each.stem for each in ROOM.glob("*.toml")}
        yield from ((one["driver"], one) for one in devices if one["driver"] in kinds)


def leaves(value: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Yield the path of each setting that is no table."""
    if isinstance(value, dict | list) and value:
        for key, each in value.items() if isinstance(value, dict) else enumerate(value):
            yield from leaves(each, (*path, key))
    else:
        yield path


def fits(path: tuple[Any, ...], value: Any) -> bool:
    """Return whether a value is one that its key may have."""
    key = next(part for part in reversed(path) if isinstance(part, str))
    if key in TEXTS or key in ("axes", "fingers", "wrists"):
        return isinstance(value, str)
    if isinstance(value, str | list | dict):
        return False
    if isinstance(value, bool):
        return key == "uncommanded"
    if key in ANY_SIGN and abs(value) <= 1.0:
        return True
    return any(value is one or value == one for one in FITTING.get(key, ()))


@pytest.mark.parametrize(
    ("kind", "device"), [pytest.param(*each, id=f"{i}-{each[0]}") for i, each in enumerate(cells())]
)
def test_no_setting_of_a_compound_measures_nothing(kind: str, device: Any) -> None:
    driver = find_driver(kind, str(ROOM))
    settings, errors = read_settings(driver, {k: v for k, v in device.items() if k not in OF_THE_DAEMON}, str(ROOM))
    assert not errors
    whole = json.loads(json.dumps(msgspec.to_builtins(settings)))
    assert not said(driver, whole, ROOM)
    paths = [path for path in leaves(whole) if path[:1] != ("axis",) or path[1] in (0, len(whole["axis"]) - 1)]
    assert len(paths) > 20
    passed, silent = [], []
    for path in paths:
        for value in WRONG:
            sentences = said(driver, changed(whole, path, value), ROOM)
            if not sentences and not fits(path, value):
                passed.append((".".join(map(str, path)), value))
            if sentences and not all(len(one.split()) > 3 for one in sentences):
                silent.append((path, value, sentences))
    assert not passed, "these measure nothing, and are taken"
    assert not silent


def test_what_an_unbounded_velocity_was_taken_for_is_told() -> None:
    device = tomllib.loads((ROOM / "gantry.toml").read_text(encoding="utf-8"))["device"]["bridge"]
    table = {key: value for key, value in device.items() if key not in OF_THE_DAEMON}
    table["axis"][1]["velocity_max"] = math.inf
    (sentence,) = said(find_driver("gantry", str(ROOM)), table, ROOM)
    assert "axis y: velocity_max inf; want 1e-09 to 10000" in sentence
