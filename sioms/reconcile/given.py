"""What a person wrote into a TOML file, read so that whatever is wrong with it becomes a sentence.

Pure: text and tables in. ``where`` begins every message: "read model nominal.toml, [axis]".
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any

from sioms.documents import toml_of
from sioms.reconcile.errors import BadInputError

COLUMN_KEYS = ("name", "unit", "scale", "offset")


def parsed(text: bytes, where: str) -> dict[str, Any]:
    """Parse a TOML file.

    Raises:
        BadInputError: it is none.
    """
    try:
        return toml_of(text)
    except ValueError as e:
        raise BadInputError(f"{where}: {e}") from e


def only(table: Mapping[str, Any], allowed: Iterable[str], where: str) -> None:
    """Refuse keys that nobody reads.

    Raises:
        BadInputError: names them, and those that are known.
    """
    odd = sorted(set(table) - set(allowed))
    if odd:
        raise BadInputError(f"{where}: nobody reads {', '.join(odd)}; known are {', '.join(allowed)}")


def table_in(table: Mapping[str, Any], key: str, where: str, *, needed: bool = True) -> dict[str, Any]:
    """Return a table of a table, an empty one where it is missing and not needed.

    Raises:
        BadInputError: it is missing, or no table.
    """
    if key not in table and not needed:
        return {}
    if not isinstance(table.get(key), Mapping):
        wrong = f"there is no table [{key}]" if key not in table else f"{key} is {table[key]!r}; needs a table"
        raise BadInputError(f"{where}: {wrong}")
    return dict(table[key])


def number(
    table: Mapping[str, Any],
    key: str,
    where: str,
    instead: float | None = None,
    *,
    about: str = "",
    endless: bool = False,
) -> float:
    """Return a number.

    Args:
        instead: what a missing one is; None demands it.
        about: what it is, for messages.
        endless: it may be infinite.

    Raises:
        BadInputError: it is missing, no number, or not finite.
    """
    value = table.get(key, instead)
    if value is None:
        raise BadInputError(f"{where} has no {key}" + (f" ({about})" if about else ""))
    real = isinstance(value, int | float) and not isinstance(value, bool)
    if not real or not (math.isfinite(value) or (endless and value == math.inf)):
        raise BadInputError(f"{where}: {key} is {value!r}; needs a finite number" + (f", {about}" if about else ""))
    return float(value)


def truth(table: Mapping[str, Any], key: str, where: str, instead: bool) -> bool:
    """Return true or false.

    Raises:
        BadInputError: it is neither.
    """
    value = table.get(key, instead)
    if not isinstance(value, bool):
        raise BadInputError(f"{where}: {key} is {value!r}; true or false")
    return value


def words(table: Mapping[str, Any], key: str, where: str, about: str) -> tuple[str, ...] | None:
    """Return a list of words, None where it is missing.

    Raises:
        BadInputError: it is none.
    """
    value = table.get(key)
    if value is not None and not (isinstance(value, list) and all(isinstance(w, str) for w in value)):
        raise BadInputError(f"{where}: {key} is {value!r}; needs a list of {about}")
    return None if value is None else tuple(value)


def columns_in(
    table: Mapping[str, Any],
    key: str,
    allowed: Iterable[str],
    where: str,
    *,
    keys: tuple[str, ...] = COLUMN_KEYS,
    named: bool = True,
) -> dict[str, dict[str, Any]]:
    """Return a table of columns, each with at most a name, a unit, a scale and an offset.

    Args:
        allowed: quantities that are known.
        keys: of these, those that are read.
        named: each must have a name.

    Raises:
        BadInputError: one is of the wrong kind.
    """
    found = table_in(table, key, where, needed=False)
    only(found, allowed, f"{where}, [{key}]")
    for quantity, spec in found.items():
        if not isinstance(spec, Mapping) or not isinstance(spec.get("name", None if named else ""), str):
            raise BadInputError(f'{where}: {quantity} is {spec!r}; needs {{ name = "COLUMN", unit = "UNIT" }}')
        column = f"{where}, column {quantity}"
        only(spec, keys, column)
        if not isinstance(spec.get("unit", ""), str):
            raise BadInputError(f"{column}: unit is {spec['unit']!r}; needs a word")
        for factor in ("scale", "offset"):
            number(spec, factor, column, 0.0)
    return found
