"""Which line of a configuration an error is about: the validator sees values and no lines. Pure; used with errors only."""

from __future__ import annotations

import re
from collections import Counter

_HEAD = re.compile(r"^\s*(\[\[?)\s*([^\[\]]+?)\s*\]\]?\s*(#.*)?$")
_KEY = re.compile(r"^\s*([A-Za-z0-9_-]+|\"[^\"]+\")\s*=")
_NAMED = ("device", "node")


def with_lines(text: str, errors: list[str]) -> None:
    """Put the line in front of each error whose place is found in the text."""
    places = _places(text)
    for index, error in enumerate(errors):
        if line := _line(places, error):
            errors[index] = type(error)(f"line {line}: {error}")


def _line(places: dict[str, int], error: str) -> int:
    where = re.split(r": | = ", error, maxsplit=1)[0]
    if unknown := re.search(r": unknown key ([^\s;]+)", error):
        where += f".{unknown[1]}"
    while where:
        if where in places:
            return places[where]
        where = (
            where[: max(where.rfind("."), where.rfind("["))]
            if not where.endswith("]") or where.count("[") > 1
            else ""
        )
    return 0


def _places(text: str) -> dict[str, int]:
    """Return the line of each table and of each key, by the words with which errors name them."""
    places: dict[str, int] = {}
    counts: Counter[str] = Counter()
    here = ""
    for number, line in enumerate(text.splitlines(), 1):
        if head := _HEAD.match(line):
            here = _words(head[2].split("."), head[1] == "[[", counts)
            places.setdefault(here, number)
        elif (key := _KEY.match(line)) and here:
            places.setdefault(f"{here}.{key[1].strip(chr(34))}", number)
    return places


def _words(parts: list[str], repeated: bool, counts: Counter[str]) -> str:
    """Return how errors name a table: ``[device.mod0].axis[1]``, ``[[grant]] number 2``."""
    path = ".".join(parts)
    counts[path] += repeated
    if len(parts) == 1:
        return f"[[{path}]] number {counts[path]}" if repeated else f"[{path}]"
    depth = 2 if parts[0] in _NAMED else 1
    here, so_far = f"[{'.'.join(parts[:depth])}]", ".".join(parts[:depth])
    for part in parts[depth:]:
        so_far += f".{part}"
        here += f".{part}" + (f"[{counts[so_far] - 1}]" if counts[so_far] else "")
    return here
