"""Configuration tables made from dataclasses, so that a key has one home and an unknown key is an error.

The motion core and the physics describe axes and motors as plain dataclasses; msgspec would accept
and ignore unknown keys for those. ``table_type`` makes the strict struct that the configuration is
read into, ``from_table`` turns what was read back into the dataclass.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Mapping
from functools import cache
from typing import Any, TypeVar, cast, get_args, get_type_hints

import msgspec

T = TypeVar("T")


def table_type(
    kind: type, without: Collection[str] = (), extra: Mapping[str, tuple[Any, Any]] | None = None
) -> type[msgspec.Struct]:
    """Return a frozen struct with the fields and defaults of a dataclass that forbids other keys.

    Args:
        kind: the dataclass; fields that are dataclasses, or optional ones, become tables too.
        without: fields that the configuration does not give.
        extra: further keys: name to (type, default).

    Example:
        >>> import dataclasses
        >>> Point = dataclasses.make_dataclass("Point", [("x", float), ("y", float, 0.0)])
        >>> msgspec.convert({"x": 1, "z": 2}, table_type(Point))
        Traceback (most recent call last):
        msgspec.ValidationError: Object contains unknown field `z`
    """
    hints = get_type_hints(kind)
    fields: list[Any] = []
    for field in dataclasses.fields(kind):
        if field.name in without:
            continue
        hint = _strict(hints[field.name])
        required = field.default is dataclasses.MISSING
        fields.append((field.name, hint) if required else (field.name, hint, field.default))
    fields += [(name, hint, default) for name, (hint, default) in (extra or {}).items()]
    return msgspec.defstruct(kind.__name__, fields, frozen=True, forbid_unknown_fields=True, kw_only=True)


def from_table(kind: type[T], table: msgspec.Struct, given: Mapping[str, Any] | None = None) -> T:
    """Return the dataclass from what was read; ``given`` are the fields that the configuration does not give."""
    values = dict(given or {})
    for name, inner in _dataclass_fields(cast("type", kind)):
        if name in values or not hasattr(table, name):
            continue
        value = getattr(table, name)
        values[name] = from_table(inner, value) if isinstance(value, msgspec.Struct) and inner else value
    return kind(**values)


@cache
def _dataclass_fields(kind: type) -> list[tuple[str, type | None]]:
    """Return the fields of a dataclass, each with the dataclass that it may be."""
    hints = get_type_hints(kind)
    found = [(field.name, (hints[field.name], *get_args(hints[field.name]))) for field in dataclasses.fields(kind)]
    return [(name, next((each for each in kinds if _is_dataclass(each)), None)) for name, kinds in found]


def _is_dataclass(hint: object) -> bool:
    return isinstance(hint, type) and dataclasses.is_dataclass(hint)


def _strict(hint: Any) -> Any:
    """Replace a dataclass, also an optional one, by its table."""
    if _is_dataclass(hint):
        return table_type(hint)
    inner = [part for part in get_args(hint) if _is_dataclass(part)]
    return table_type(inner[0]) | None if inner else hint
