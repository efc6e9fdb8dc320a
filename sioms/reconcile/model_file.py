"""Model files: the text that the workflow writes, the simulated axes load and people edit.

Pure: text in, ``AxisModel`` out and back. The tables are [axis], [controller] and [effects.NAME], each effect
switchable by ``on``.
"""

from __future__ import annotations

import json
import math
import tomllib
from collections.abc import Mapping
from typing import Any

from sioms.reconcile.effects import known
from sioms.reconcile.errors import BadInputError
from sioms.reconcile.model import AxisModel, Controller

#: The numbers of [axis]: what they are, and the one that stands in for a missing one.
AXIS_NUMBERS: Mapping[str, tuple[str, float | None]] = {
    "sample_time_s": ("period of the controller, s", None),
    "inertia": ("kg or kg m^2", None),
    "viscous": ("N s/m or N m s/rad", None),
    "resolution": ("position per count", 0.0),
    "pitch": ("period of what is periodic, and of index marks, m or rad", None),
    "rated_force": ("the natural size of a force, N or N m", None),
    "max_speed": ("m/s or rad/s", None),
    "start_position": ("m or rad", 0.0),
}
ABOVE_ZERO = ("sample_time_s", "inertia", "pitch", "rated_force", "max_speed")
NOT_BELOW_ZERO = ("viscous", "resolution")
REFINED = ("inertia", "viscous")
AXIS_KEYS = ("name", "kind", *AXIS_NUMBERS, "refine")
CONTROLLER_NUMBERS = ("k", "kz", "kp", "kb", "offset", "limit", "velocity_filter_hz")
CONTROLLER_KEYS = (*CONTROLLER_NUMBERS, "velocity_mean")


def parse_model(text: str, source: str) -> AxisModel:
    """Read a model from its text.

    Args:
        source: name of the file, for messages.

    Raises:
        BadInputError: no TOML, or a key is missing, unknown or no number.
    """
    try:
        return model_from(tomllib.loads(text))
    except ValueError as e:  # a TOMLDecodeError is one
        raise BadInputError(f"read model {source}: {e}") from e


def model_from(table: Mapping[str, Any]) -> AxisModel:
    """Build a model from the tables [axis], [controller] and [effects.*]; effects with ``on = false`` are left out.

    Raises:
        ValueError: a key is missing, unknown, no number, or out of its range.
    """
    only(table, ("axis", "controller", "effects", "symbolic"), "model")
    a = _table(table, "axis")
    only(a, AXIS_KEYS, "model, [axis]")
    if a.get("kind") not in ("rotary", "linear"):
        raise ValueError(f"[axis] kind is {a.get('kind')!r}; rotary or linear")
    numbers: dict[str, Any] = {key: _number(a, "[axis]", key, *about) for key, about in AXIS_NUMBERS.items()}
    model = AxisModel(
        rotary=a["kind"] == "rotary",
        controller=_controller(_table(table, "controller")) if "controller" in table else None,
        refine=_refined(a.get("refine", [])),
        name=str(a.get("name", "axis")),
        **numbers,
    )
    effects = _table(table, "effects") if "effects" in table else {}
    for name in effects:
        if name not in known():
            raise ValueError(f"effect {name!r} is not known; known are {', '.join(sorted(known()))}")
        given, where = _table(effects, name), f"[effects.{name}]"
        if not isinstance(given.get("on", True), bool):
            raise ValueError(f"{where} on is {given['on']!r}; true or false")
        if given.get("on", True):
            model = model.with_effect(name, {k: _number(given, where, k) for k in given if k != "on"})
    check_model(model)
    return model


def check_model(model: AxisModel) -> None:
    """Check the numbers of an axis.

    Raises:
        ValueError: one is out of its range; the text names it and the range.
    """
    for key in ABOVE_ZERO + NOT_BELOW_ZERO:
        value = getattr(model, key)
        if value < 0.0 or (value == 0.0 and key in ABOVE_ZERO):
            wants = "above zero" if key in ABOVE_ZERO else "zero or more"
            raise ValueError(f"[axis] {key} is {value:g}; needs {wants} ({AXIS_NUMBERS[key][0]})")
    for name, values in model.effects.items():
        for p in known()[name].parameters:
            if p.lower >= 0.0 and values[p.symbol] < 0.0:
                raise ValueError(
                    f"[effects.{name}] {p.symbol} is {values[p.symbol]:g}; needs zero or more, {p.text}"
                )
    if model.controller is not None and not model.controller.limit > 0.0:
        raise ValueError(
            f"[controller] limit is {model.controller.limit:g}; needs the largest force, above zero"
        )


def _refined(given: object) -> tuple[str, ...]:
    if not isinstance(given, list) or not all(name in REFINED for name in given):
        raise ValueError(f"[axis] refine is {given!r}; a list of {', '.join(REFINED)}")
    return tuple(given)


def _controller(table: Mapping[str, Any]) -> Controller:
    only(table, CONTROLLER_KEYS, "model, [controller]")
    mean = bool(table.get("velocity_mean", False))
    numbers = {key: _number(table, "[controller]", key) for key in CONTROLLER_NUMBERS}
    return Controller(**numbers, velocity_mean=mean)


def _table(table: Mapping[str, Any], key: str) -> Mapping[str, Any]:
    if not isinstance(table.get(key), Mapping):
        raise ValueError(
            f"there is no table [{key}]" if key not in table else f"{key} is {table[key]!r}; needs a table"
        )
    return dict(table[key])


def _number(
    table: Mapping[str, Any], where: str, key: str, about: str = "", instead: float | None = None
) -> float:
    value = table.get(key, instead)
    if value is None:
        raise ValueError(f"{where} has no {key}" + (f" ({about})" if about else ""))
    endless = key == "limit" and value == math.inf
    if isinstance(value, bool) or not isinstance(value, int | float) or not (math.isfinite(value) or endless):
        raise ValueError(
            f"{where} {key} is {value!r}; needs a finite number" + (f", {about}" if about else "")
        )
    return float(value)


def write_model(model: AxisModel, comments: Mapping[str, str] | None = None) -> str:
    """Write a model as TOML, every effect switchable by ``on``."""
    lines = ["[axis]", f'name = "{model.name}"', f'kind = "{"rotary" if model.rotary else "linear"}"']
    for key in AXIS_NUMBERS:
        lines.append(f"{key} = {getattr(model, key)!r}")
    lines.append(f"refine = {json.dumps(list(model.refine))}")
    if model.controller is not None:
        lines += ["", "[controller]"]
        lines += [f"{key} = {_toml(getattr(model.controller, key))}" for key in CONTROLLER_KEYS]
    for name, values in model.effects.items():
        effect = known()[name]
        lines += ["", f"# {effect.title}: {effect.equation}"]
        lines += [f"# {comments[name]}"] if comments and name in comments else []
        lines += [f"[effects.{name}]", "on = true"]
        units = {p.symbol: f"{model.unit(p)}, {p.text}" for p in effect.parameters}
        lines += [f"{k} = {float(v)!r}  # {units[k]}" for k, v in values.items()]
    return "\n".join(lines) + "\n"


def _toml(value: object) -> str:
    return str(value).lower() if isinstance(value, bool) else repr(value)


def only(table: Mapping[str, Any], allowed: tuple[str, ...], where: str) -> None:
    """Refuse keys that nobody reads.

    Raises:
        BadInputError: names them, and those that are known.
    """
    odd = sorted(set(table) - set(allowed))
    if odd:
        raise BadInputError(f"read {where}: nobody reads {', '.join(odd)}; known are {', '.join(allowed)}")
