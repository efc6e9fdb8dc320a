"""Model files: the text that the workflow writes, the simulated axes load and people edit.

Pure: text in, ``AxisModel`` out and back. The tables are [axis], [controller] and [effects.NAME], each effect
switchable by ``on``.
"""

from __future__ import annotations

import json
import tomllib
from collections.abc import Mapping
from typing import Any

from sioms.reconcile.effects import known
from sioms.reconcile.errors import BadInputError
from sioms.reconcile.model import AxisModel, Controller

AXIS_KEYS = (
    "name",
    "kind",
    "sample_time_s",
    "inertia",
    "viscous",
    "resolution",
    "pitch",
    "rated_force",
    "max_speed",
    "start_position",
    "refine",
)
CONTROLLER_KEYS = ("k", "kz", "kp", "kb", "offset", "limit", "velocity_filter_hz", "velocity_mean")


def parse_model(text: str, source: str) -> AxisModel:
    """Read a model from its text.

    Args:
        source: name of the file, for messages.

    Raises:
        BadInputError: no TOML, or a key is missing, unknown or no number.
    """
    try:
        return model_from(tomllib.loads(text))
    except (KeyError, TypeError) as e:
        raise BadInputError(f"read model {source}: missing or wrong key {e}") from e
    except (tomllib.TOMLDecodeError, ValueError) as e:
        raise BadInputError(f"read model {source}: {e}") from e


def model_from(table: Mapping[str, Any]) -> AxisModel:
    """Build a model from the tables [axis], [controller] and [effects.*]; effects with ``on = false`` are left out."""
    only(table, ("axis", "controller", "effects", "symbolic"), "model")
    a = dict(table["axis"])
    only(a, AXIS_KEYS, "model, [axis]")
    kind = a.pop("kind")
    if kind not in ("rotary", "linear"):
        raise ValueError(f"kind is {kind!r}; rotary or linear")
    a["refine"] = tuple(a.get("refine", ()))
    controller = None
    if "controller" in table:
        only(table["controller"], CONTROLLER_KEYS, "model, [controller]")
        controller = Controller(**table["controller"])
    model = AxisModel(rotary=kind == "rotary", controller=controller, **a)
    for name, given in table.get("effects", {}).items():
        if name not in known():
            raise ValueError(f"effect {name!r} is not known; known are {', '.join(sorted(known()))}")
        if given.get("on", True):
            model = model.with_effect(name, {k: float(v) for k, v in given.items() if k != "on"})
    return model


def write_model(model: AxisModel, comments: Mapping[str, str] | None = None) -> str:
    """Write a model as TOML, every effect switchable by ``on``."""
    lines = ["[axis]", f'name = "{model.name}"', f'kind = "{"rotary" if model.rotary else "linear"}"']
    for key in AXIS_KEYS[2:-1]:
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
