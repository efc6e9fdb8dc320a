"""TOML and JSON files that anybody may have written: whatever the bytes are, tables or one sentence.

A file is read up to a size, and what it holds is bounded in depth before anybody walks through it. Dates, which none of
our files hold, and integers beyond 64 bits, which nothing that they are handed to takes, are refused here.

Without input or output but for ``read_bytes``.
"""

from __future__ import annotations

import json
import math
import re
import tomllib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping
    from pathlib import Path

MOST_BYTES = 1 << 22
"""Bytes of a document: ten thousand devices, or as many touches."""
DEEPEST = 10
"""Arrays and tables within each other at most."""
_LONGEST = 200
MOST_DOTS = 200
"""In what may be a key; a sentence has fewer."""
_NO_KEY = re.compile(r"[=\[\]{},#\n]")
_HEADS = 2
"""Levels on which a table has a head of its own."""
_BARE_KEY = re.compile(r"[A-Za-z0-9_-]+")


def read_bytes(path: Path, most: int = MOST_BYTES) -> bytes:
    """Read a file of at most so many bytes.

    Raises:
        OSError: it cannot be read.
        ValueError: it is larger, or no file that ends.
    """
    with path.open("rb") as file:
        data = file.read(most + 1)
    if len(data) > most:
        raise ValueError(f"it is larger than {most / 2**20:g} MiB")
    return data


def read_text(path: Path, most: int = MOST_BYTES) -> str:
    """Read a text in UTF-8; see ``read_bytes``."""
    return _text(read_bytes(path, most))


def toml_of(text: str | bytes) -> dict[str, Any]:
    """Parse TOML.

    Raises:
        ValueError: it is none, or holds what no file of ours does; the message says what, and where.
    """
    plain = _text(text)
    # a dotted key takes the time of its square: 12 s of one of 40 KB, in a driver that a client has sent it to
    if max(part.count(".") for part in _NO_KEY.split(plain.replace(" ", "").replace("\t", ""))) > MOST_DOTS:
        raise ValueError(f"arrays or tables nested too deep; want at most {DEEPEST} levels")
    try:
        table = tomllib.loads(plain)
    except tomllib.TOMLDecodeError as error:
        from .toml_errors import explained  # slow to import, and seldom needed

        raise ValueError(explained(plain, error)) from None
    except RecursionError:
        raise ValueError(f"arrays or tables nested too deep; want at most {DEEPEST} levels") from None
    _check(table, "", 0)
    return table


def json_of(text: str | bytes) -> Any:
    """Parse JSON; see ``toml_of``."""
    plain = _text(text)
    try:
        value = json.loads(plain)
    except RecursionError:
        raise ValueError(f"arrays or objects nested too deep; want at most {DEEPEST} deep") from None
    _check(value, "", 0)
    return value


def toml_text(tables: Mapping[str, Any]) -> str:
    """Return tables as TOML that ``toml_of`` reads back exactly.

    Tables have heads of their own down to the second level, arrays of tables on every level; what is below them is in
    line.

    Raises:
        TypeError: a value that ``toml_of`` does not return.
    """
    return "\n".join(_lines(tables, ())).lstrip() + "\n"


def _lines(table: Mapping[str, Any], above: tuple[str, ...]) -> Iterator[str]:
    below = {key: value for key, value in table.items() if _has_head(value, len(above))}
    for key, value in table.items():
        if key not in below:
            yield f"{toml_key(key)} = {toml_value(value)}"
    for key, value in below.items():
        names = (*above, toml_key(key))
        head = ".".join(names)
        for one in value if isinstance(value, list) else [value]:
            if isinstance(value, list):
                yield f"\n[[{head}]]"
            elif not one or not all(_has_head(inner, len(names)) for inner in one.values()):
                yield f"\n[{head}]"
            yield from _lines(one, names)


def _has_head(value: object, depth: int) -> bool:
    if isinstance(value, list):
        return bool(value) and all(isinstance(one, dict) for one in value)
    return isinstance(value, dict) and depth < _HEADS


def toml_key(name: str) -> str:
    """Return a key as TOML, quoted where it must be."""
    return name if _BARE_KEY.fullmatch(name) else toml_value(name)


def toml_value(value: Any) -> str:
    """Return a value as TOML that ``toml_of`` reads back exactly; lists of lists have a line for each.

    Raises:
        TypeError: a value that ``toml_of`` does not return.
    """
    match value:
        case bool():
            return "true" if value else "false"
        case str():
            return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
        case int() | float():
            return repr(value)
        case dict():
            return "{ " + ", ".join(f"{toml_key(key)} = {toml_value(one)}" for key, one in value.items()) + " }"
        case list() | tuple() if value and isinstance(value[0], list | tuple):
            return "[\n" + "".join(f"  {toml_value(row)},\n" for row in value) + "]"
        case list() | tuple():
            return "[" + ", ".join(toml_value(one) for one in value) + "]"
    raise TypeError(f"write TOML: a {type(value).__name__}; want a number, a text, a truth, a list or a table")


def json_text(value: object) -> str:
    """Return a value as JSON for people and programs; what is not a number becomes null."""

    def plain(value: Any) -> Any:
        if isinstance(value, dict):
            return {str(key): plain(inner) for key, inner in value.items()}
        if isinstance(value, list | tuple):
            return [plain(inner) for inner in value]
        return None if isinstance(value, float) and not math.isfinite(value) else value

    return json.dumps(plain(value), indent=1)


def _text(text: str | bytes) -> str:
    if isinstance(text, str):
        plain = text
    else:
        try:
            plain = text.decode("utf-8")
        except UnicodeDecodeError as error:
            raise ValueError(f"it is not text in UTF-8 (byte {error.start} is {text[error.start]:#04x})") from None
    if len(plain) > 4 * MOST_BYTES:
        raise ValueError(f"it is larger than {4 * MOST_BYTES / 2**20:g} MiB")
    return plain


def _check(value: object, where: str, depth: int) -> None:
    if isinstance(value, dict | list):
        if depth > DEEPEST:
            raise ValueError(f"{where[:_LONGEST]}: nested deeper than {DEEPEST}")
        for key, each in value.items() if isinstance(value, dict) else enumerate(value):
            _check(
                each,
                f"{where}.{key}".lstrip(".") if isinstance(value, dict) else f"{where}[{key}]",
                depth + 1,
            )
    elif isinstance(value, int):
        if not -(2**63) <= value < 2**63:
            raise ValueError(f"{where[:_LONGEST]}: an integer of more than 64 bits")
    elif not isinstance(value, str | float | None):
        raise ValueError(
            f"{where[:_LONGEST]} = {value}: a {type(value).__name__}; want text, a number, an array or a table"
        )
