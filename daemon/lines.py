"""Which line of a configuration an error is about: the validator sees values and no lines. Pure; used with errors only.

An error begins with the words for a table, or for a key of one: ``[device.mod0].axis[1].mass: ...``. Where only the
table is named, as by a driver that judges several keys together, the axis and the key that the sentence names come
first are looked for in it.
"""

from __future__ import annotations

import re
from collections import Counter

_WORD = r"""(?:[A-Za-z0-9_-]+|"[^"]*"|'[^']*')"""
_WORDS = rf"{_WORD}(?:\s*\.\s*{_WORD})*"
_HEAD = re.compile(rf"^\s*(\[\[?)\s*({_WORDS})\s*\]\]?\s*(#.*)?$")
_KEY = re.compile(rf"^\s*({_WORDS})\s*=")
_NAME = re.compile(r"""^\s*name\s*=\s*(["'])(.*?)\1""")
_LONG_STRING = re.compile(r'("""|\'\'\').*?\1', re.DOTALL)
_NAMED = ("device", "node")


def with_lines(text: str, errors: list[str]) -> None:
    """Put the line in front of each error whose place is found in the text."""
    places, axes = _places(text)
    for index, error in enumerate(errors):
        if line := _line(places, axes, error):
            errors[index] = type(error)(f"line {line}: {error}")


def _line(places: dict[str, int], axes: dict[str, str], error: str) -> int:
    where = re.split(r": | = ", error, maxsplit=1)[0]
    rest = error[len(where) :]
    if unknown := re.match(r": unknown key ([^\s;]+)", rest):
        where += f".{unknown[1]}"
    elif named := re.match(r": axis ([^\s:]+)", rest):
        where = axes.get(f"{where}.axis {named[1]}", where)
        rest = rest[named.end() :]
    if where in places:
        keys = (f"{where}.{word}" for word in re.findall(r"\w+", rest))
        return next((places[key] for key in keys if key in places), places[where])
    shorter = ""
    while where != shorter:
        for same in (
            where,
            f"{where}[0]",
            f"[{where}] number 1",
        ):  # one where many are right, and the other way round
            if same in places:
                return places[same]
        where, shorter = re.sub(r"(\.[^.\]]*|\[\d+\])$", "", where), where
    return 0


def _places(text: str) -> tuple[dict[str, int], dict[str, str]]:
    """Return the line of each table and key, by the words with which errors name them, and those words for axes by
    their names.
    """
    places: dict[str, int] = {}
    axes: dict[str, str] = {}
    counts: Counter[str] = Counter()
    here = ""
    text = _LONG_STRING.sub(lambda found: "\n" * found[0].count("\n"), text)
    for number, line in enumerate(text.splitlines(), 1):
        if head := _HEAD.match(line):
            here = _table(_split(head[2]), head[1] == "[[", counts)
            places.setdefault(here, number)
        elif key := _KEY.match(line):
            words = _split(key[1])
            for end in range(1, len(words) + 1):
                places.setdefault(".".join([here, *words[:end]]) if here else f"[{words[0]}]", number)
            if name := _NAME.match(line):
                axes.setdefault(f"{re.sub(r'.[0-9]+.$', '', here)} {name[2]}", here)
    return places, axes


def _split(words: str) -> list[str]:
    return [word.strip("\"'") for word in re.findall(_WORD, words)]


def _table(parts: list[str], repeated: bool, counts: Counter[str]) -> str:
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
