"""Sensor models as TOML text: a table of the nominal sensor, and one switchable table for each effect."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from sioms.reconcile.errors import BadInputError
from sioms.reconcile.given import table_in, truth
from sioms.reconcile.sensors.effect import SensorModel


def effects_to_toml(model: SensorModel) -> str:
    """Write the effects of a model, every one switchable by ``on``."""
    lines: list[str] = []
    for name, values in model.effects.items():
        effect = model.library[name]
        lines += ["", f"# {effect.title}: {effect.equation}", f"[effects.{name}]", "on = true"]
        for q in effect.parameters:
            lines.append(f"{q.symbol} = {number_or_list(values[q.symbol])}  # {q.unit}, {q.text}")
    return "\n".join(lines) + ("\n" if lines else "")


def effects_from(model: SensorModel, table: Mapping[str, Any], where: str) -> SensorModel:
    """Switch on the effects of a parsed model file ([effects.NAME]); those with ``on = false`` are left out.

    Raises:
        BadInputError: an effect or a parameter is unknown or missing.
    """
    effects = table_in(table, "effects", f"read model {where}", needed=False)
    for name in effects:
        if name not in model.library:
            raise BadInputError(
                f"read model {where}: effect {name!r} is not known; known are {', '.join(sorted(model.library))}"
            )
        given, of_effect = table_in(effects, name, f"read model {where}"), f"{where}, [effects.{name}]"
        if not truth(given, "on", f"read model {of_effect}", True):
            continue
        values = {k: numbers(given, k, of_effect) for k in given if k != "on"}
        try:
            model = model.with_effect(name, values)
        except ValueError as e:
            raise BadInputError(f"read model {where}: {e}") from e
    return model


def number_or_list(values: np.ndarray[Any, np.dtype[np.float64]]) -> str:
    """Write one number plainly, several as a list; exact."""
    return repr(float(values[0])) if len(values) == 1 else "[" + ", ".join(repr(float(v)) for v in values) + "]"


def numbers(
    table: Mapping[str, Any], key: str, where: str, count: int | None = None
) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Read a number or a list of numbers.

    Raises:
        BadInputError: the key is missing, no number, not finite, or a list of another length.
    """
    if key not in table:
        raise BadInputError(f"read model {where}: {key} is missing")
    try:
        out = np.atleast_1d(np.asarray(table[key], dtype=np.float64))
    except (TypeError, ValueError) as e:
        raise BadInputError(f"read model {where}: {key} is {table[key]!r}; needs a number or a list of numbers") from e
    if count is not None and out.size == 1:
        out = np.full(count, out[0])
    if (count is not None and out.shape != (count,)) or not np.isfinite(out).all():
        raise BadInputError(
            f"read model {where}: {key} has {out.size} numbers or some that are not finite; needs {count or 1}"
        )
    return out
