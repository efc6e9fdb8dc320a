"""Wording of errors that several packages share: "did you mean", and msgspec's errors as sentences."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from difflib import get_close_matches
from types import UnionType
from typing import Literal, Union, get_origin

import msgspec


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """Return the end of an error: '; did you mean x?' or, of a short list, what there is.

    Example:
        >>> did_you_mean("mod", ["mod0", "tactile0"])
        '; did you mean mod0?'
    """
    known = list(known)
    close = get_close_matches(word, known, 1, 0.7)
    if close:
        return f"; did you mean {close[0]}?"
    return f"; there are: {', '.join(known)}" if 0 < len(known) <= 12 else ""


def explain(
    where: str,
    error: msgspec.ValidationError,
    known: Iterable[str],
    words: Mapping[str, Sequence[object]] | None = None,
) -> str:
    """Turn a validation error into a sentence that names the table and the key that was meant.

    Args:
        where: the table, e.g. ``[device.mod0]``.
        error: what msgspec found.
        known: keys that the table may have.
        words: key to the words that it may be, of keys that take certain words alone.
    """
    text, _, path = str(error).partition(" - at `$")
    path = path.rstrip("`")
    where += path
    if "unknown field" in text:
        key = text.split("`")[1]
        return f"{where}: unknown key {key}{did_you_mean(key, known)}"
    if "missing required field" in text:
        return f"{where}: key {text.split('`')[1]} is missing"
    if "enum value" in text and (may := (words or {}).get(path.rpartition(".")[2].partition("[")[0])):
        return f"{where} = {text.split()[-1]}: want one of {', '.join(map(repr, may))}"
    return f"{where}: {plain_words(text)}"


_KINDS = {
    "float": "a number", "int": "an integer", "str": "a text in quotes", "bool": "true or false",
    "array": "a list [...]", "object": "a table {...}",
}  # fmt: skip


def plain_words(text: str) -> str:
    """Say in the words of TOML what msgspec says in those of its types.

    Example:
        >>> plain_words("Expected `float | null`, got `str`")
        'want a number, got a text in quotes'
        >>> plain_words("Expected `int` <= 5")
        'want an integer <= 5'
    """

    def kinds(found: re.Match[str]) -> str:
        names = [name for name in found[1].split(" | ") if name != "null"]
        return " or ".join(_KINDS.get(name, f"`{name}`") for name in names)

    text = re.sub(r"`([^`]+)`", kinds, text)
    return f"want {text.removeprefix('Expected ')}" if text.startswith("Expected ") else text[0].lower() + text[1:]


def every_error(where: str, value: object, annotation: object) -> list[str]:
    """Return all that is wrong with a table, where the validator names the first alone; for when it has named one.

    Args:
        where: the table, e.g. ``[device.mod0]``.
        value: what was read.
        annotation: what it should be: a Struct, a list of them, or anything that the validator knows.
    """
    errors: list[str] = []
    annotation = _of_kind(value, annotation)
    inner: Sequence[object] = getattr(annotation, "__args__", ())
    if isinstance(annotation, type) and issubclass(annotation, msgspec.Struct) and isinstance(value, dict):
        fields = {field.encode_name: field for field in msgspec.structs.fields(annotation)}
        if annotation.__struct_config__.forbid_unknown_fields:
            errors += [f"{where}: unknown key {k}{did_you_mean(k, fields)}" for k in value if k not in fields]
        for key, field in fields.items():
            if key in value:
                errors += every_error(f"{where}.{key}", value[key], field.type)
            elif field.required:
                errors.append(f"{where}: key {key} is missing")
    elif get_origin(annotation) is list and isinstance(value, list):
        for index, each in enumerate(value):
            errors += every_error(f"{where}[{index}]", each, inner[0])
    if errors:
        return errors
    try:
        msgspec.convert(value, annotation)
    except msgspec.ValidationError as error:
        if (words := _literals(annotation)) and "enum value" in str(error):
            return [f"{where} = {value!r}: want one of {', '.join(map(repr, words))}"]
        return [explain(where, error, ())]
    return []


def _of_kind(value: object, annotation: object) -> object:
    """Return which one of several types a table or a list is meant to be, where one of them alone can be it."""
    if get_origin(annotation) not in (Union, UnionType):
        return annotation
    kinds: Sequence[object] = getattr(annotation, "__args__", ())
    fits = [
        kind
        for kind in kinds
        if (isinstance(value, dict) and isinstance(kind, type) and issubclass(kind, msgspec.Struct))
        or (isinstance(value, list) and get_origin(kind) is list)
    ]
    return fits[0] if len(fits) == 1 else annotation


def choices(kind: type[msgspec.Struct]) -> dict[str, tuple[object, ...]]:
    """Return the keys of a table, and of the tables in it, that take certain words alone, with these words."""
    return {field.encode_name: words for field in _fields(kind) if (words := _literals(field.type))}


def _literals(annotation: object) -> tuple[object, ...]:
    inner = getattr(annotation, "__args__", ())
    if get_origin(annotation) is Literal:
        return tuple(inner)
    return tuple(word for each in inner for word in _literals(each))


def field_names(kind: type[msgspec.Struct]) -> list[str]:
    """Return the keys of a table, those of the tables in it too."""
    return [field.encode_name for field in _fields(kind)]


def _fields(kind: type[msgspec.Struct]) -> Iterator[msgspec.structs.FieldInfo]:
    pending: list[object] = [kind]
    seen: set[object] = set()
    while pending:
        each = pending.pop()
        if each in seen:
            continue
        seen.add(each)
        if isinstance(each, type) and issubclass(each, msgspec.Struct):
            for field in msgspec.structs.fields(each):
                yield field
                pending.append(field.type)
        else:
            pending.extend(getattr(each, "__args__", ()))
