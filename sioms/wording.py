"""Wording of errors that several packages share: "did you mean", and msgspec's errors as sentences."""

from __future__ import annotations

from collections.abc import Iterable
from difflib import get_close_matches

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


def explain(where: str, error: msgspec.ValidationError, known: Iterable[str]) -> str:
    """Turn a validation error into a sentence that names the table and the key that was meant.

    Args:
        where: the table, e.g. ``[device.mod0]``.
        error: what msgspec found.
        known: keys that the table may have.
    """
    text, _, path = str(error).partition(" - at `$")
    path = path.rstrip("`")
    where += path
    if "unknown field" in text:
        key = text.split("`")[1]
        return f"{where}: unknown key {key}{did_you_mean(key, known)}"
    if "missing required field" in text:
        return f"{where}: key {text.split('`')[1]} is missing"
    return f"{where}: {text[0].lower() + text[1:]}"


def field_names(kind: type[msgspec.Struct]) -> list[str]:
    """Return the keys of a table, those of the tables in it too."""
    names: list[str] = []
    pending: list[object] = [kind]
    seen: set[object] = set()
    while pending:
        each = pending.pop()
        if each in seen:
            continue
        seen.add(each)
        if isinstance(each, type) and issubclass(each, msgspec.Struct):
            for field in msgspec.structs.fields(each):
                names.append(field.encode_name)
                pending.append(field.type)
        else:
            pending.extend(getattr(each, "__args__", ()))
    return names
