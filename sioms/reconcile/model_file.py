"""Model files: the text that the workflow writes, the simulated axes load and people edit.

Pure: text in, ``AxisModel`` out and back. The tables are [axis], [controller] and [effects.NAME], each effect
switchable by ``on``.
"""

from __future__ import annotations

import json
from collections.abc import Container, Mapping
from typing import Any

from sioms.reconcile.effects import known
from sioms.reconcile.errors import BadInputError
from sioms.reconcile.given import number, only, parsed, table_in, truth, words
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
AXIS_KEYS = ("name", "kind", *AXIS_NUMBERS, "refine", "driven", "imposed")
CONTROLLER_NUMBERS = ("k", "kz", "kp", "kb", "offset", "limit", "velocity_filter_hz")
CONTROLLER_KEYS = (*CONTROLLER_NUMBERS, "velocity_mean")


def parse_model(text: str, source: str) -> AxisModel:
    """Read a model from its text.

    Args:
        source: name of the file, for messages.

    Raises:
        BadInputError: no TOML, or a key is missing, unknown or no number.
    """
    where = f"read model {source}"
    return model_from(parsed(text.encode(), where), where)


def model_from(table: Mapping[str, Any], where: str = "read model") -> AxisModel:
    """Build a model from the tables [axis], [controller] and [effects.*]; effects with ``on = false`` are left out.

    Raises:
        BadInputError: a key is missing, unknown, no number, or out of its range.
    """
    only(table, ("axis", "controller", "effects", "symbolic"), where)
    a, of_axis = table_in(table, "axis", where), f"{where}, [axis]"
    only(a, AXIS_KEYS, of_axis)
    if a.get("kind") not in ("rotary", "linear"):
        raise BadInputError(f"{of_axis}: kind is {a.get('kind')!r}; rotary or linear")
    imposed = truth(a, "imposed", of_axis, False)
    stands_in = {"inertia": 0.0} if imposed else {}
    numbers: dict[str, Any] = {
        key: number(a, key, of_axis, stands_in.get(key, instead), about=about)
        for key, (about, instead) in AXIS_NUMBERS.items()
    }
    model = AxisModel(
        rotary=a["kind"] == "rotary",
        controller=_controller(table_in(table, "controller", where), where) if "controller" in table else None,
        refine=words(a, "refine", of_axis, ", ".join(REFINED)) or (),
        name=str(a.get("name", "axis")),
        driven=truth(a, "driven", of_axis, True),
        imposed=imposed,
        **numbers,
    )
    effects = table_in(table, "effects", where, needed=False)
    for name in effects:
        if name not in known():
            raise BadInputError(f"{where}: effect {name!r} is not known; known are {', '.join(sorted(known()))}")
        given, of_effect = table_in(effects, name, where), f"{where}, [effects.{name}]"
        if truth(given, "on", of_effect, True):
            symbols = [p.symbol for p in known()[name].parameters]
            only(given, ("on", *symbols), of_effect)
            model = model.with_effect(name, {s: number(given, s, of_effect) for s in symbols})
    check_model(model, where)
    return model


def check_model(model: AxisModel, where: str) -> None:
    """Check the numbers of an axis.

    Raises:
        BadInputError: one is out of its range; the text names it and the range.
    """
    for key in ABOVE_ZERO + NOT_BELOW_ZERO:
        value = getattr(model, key)
        if value < 0.0 or (value == 0.0 and key in ABOVE_ZERO and not (key == "inertia" and model.imposed)):
            wants = "above zero" if key in ABOVE_ZERO else "zero or more"
            raise BadInputError(f"{where}, [axis]: {key} is {value:g}; needs {wants} ({AXIS_NUMBERS[key][0]})")
    if not set(model.refine) <= set(REFINED):
        raise BadInputError(f"{where}, [axis]: refine is {list(model.refine)}; needs a list of {', '.join(REFINED)}")
    if model.controller is not None and not model.driven:
        raise BadInputError(f"{where}: [controller] beside driven = false; an axis without a drive has no controller")
    if model.imposed and (odd := _beside_imposed(model)):
        raise BadInputError(
            f"{where}: {odd} beside imposed = true; where another machine imposes the motion there is no drive, and no "
            "inertia to refine"
        )
    if model.controller is not None and not model.controller.limit > 0.0:
        raise BadInputError(
            f"{where}, [controller]: limit is {model.controller.limit:g}; needs the largest force, above zero"
        )
    for name, values in model.effects.items():
        for p in known()[name].parameters:
            if p.lower >= 0.0 and values[p.symbol] < 0.0:
                raise BadInputError(
                    f"{where}, [effects.{name}]: {p.symbol} is {values[p.symbol]:g}; needs zero or more, {p.text}"
                )


def _beside_imposed(model: AxisModel) -> str:
    """Say what cannot stand in a model whose motion is imposed; empty where nothing is."""
    effects = [f"[effects.{name}]" for name in model.effects if not model.applicable(known()[name])]
    others = {"[controller]": model.controller is not None, "driven = false": not model.driven}
    refined = ['refine = ["inertia"]'] if "inertia" in model.refine else []
    return ", ".join([*(name for name, there in others.items() if there), *refined, *effects])


def _controller(table: Mapping[str, Any], where: str) -> Controller:
    of_controller = f"{where}, [controller]"
    only(table, CONTROLLER_KEYS, of_controller)
    numbers = {key: number(table, key, of_controller, endless=key == "limit") for key in CONTROLLER_NUMBERS}
    return Controller(**numbers, velocity_mean=truth(table, "velocity_mean", of_controller, False))


def write_model(model: AxisModel, off: Container[str] = ()) -> str:
    """Write a model as TOML, every effect switchable by ``on``.

    Args:
        off: effects that are written switched off.
    """
    lines = ["[axis]", f'name = "{model.name}"', f'kind = "{"rotary" if model.rotary else "linear"}"']
    for key in AXIS_NUMBERS:
        lines.append(f"{key} = {getattr(model, key)!r}")
    lines.append(f"refine = {json.dumps(list(model.refine))}")
    if not model.driven:
        lines.append("driven = false")
    if model.imposed:
        lines.append("imposed = true")
    if model.controller is not None:
        lines += ["", "[controller]"]
        lines += [f"{key} = {_toml(getattr(model.controller, key))}" for key in CONTROLLER_KEYS]
    for name, values in model.effects.items():
        effect = known()[name]
        lines += ["", f"# {effect.title}: {effect.equation}"]
        lines += [f"[effects.{name}]", f"on = {_toml(name not in off)}"]
        units = {p.symbol: f"{model.unit(p)}, {p.text}" for p in effect.parameters}
        lines += [f"{k} = {float(v)!r}  # {units[k]}" for k, v in values.items()]
    return "\n".join(lines) + "\n"


def _toml(value: object) -> str:
    return str(value).lower() if isinstance(value, bool) else repr(value)
