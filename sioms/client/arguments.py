"""Checks of what a program hands to the client library, before anything is sent.

A wrong kind of value costs the caller a TypeError, and one that no message holds a ValueError, with a sentence that
says what was attempted; the node goes on. What a good kind of value means is for the daemon or the driver to judge, and
to
refuse by an OSError: only they know ranges, limits and states.

Numbers of numpy are numbers; booleans and text are none.
"""

from __future__ import annotations

from _operator import index

from sioms.protocol.text import shown
from sioms.protocol.verbs import ANYTHING, FLAG, INTEGER, NUMBER, SECONDS

TYPE_CHECKING = False
if TYPE_CHECKING:
    from typing import Any, TypeVar

    from sioms.protocol.verbs import Message

    M = TypeVar("M", bound=Message)

_DEPTH = 8
_LONGEST_WHAT = 120
_SECONDS = SECONDS.words.replace("nil", "None")
_LEAST, _MOST = -(1 << 63), 1 << 64


def _wrong(what: str, value: object, want: str) -> TypeError:
    return TypeError(f"{what}: {shown(value)} is {type(value).__name__}; want {want}")


def _is_array(value: Any) -> bool:
    return getattr(value, "shape", ()) != ()


def number(what: str, value: Any, want: str = "a number") -> float:
    """Return a number as a float.

    Args:
        what: what was attempted, for the message.
        value: given by the caller.
        want: what would be right.

    Raises:
        TypeError: it is none.
    """
    if type(value) is float or type(value) is int:
        return _as_float(what, value)
    if isinstance(value, bool | str) or not hasattr(value, "__float__") or _is_array(value):
        raise _wrong(what, value, want)
    return _as_float(what, value)


def _as_float(what: str, value: Any) -> float:
    try:
        return float(value)
    except OverflowError:
        raise ValueError(f"{what}: {shown(value)} is out of the range of a floating-point number") from None


def numbers(what: str, values: Any, want: str = "numbers") -> list[float]:
    """Return an iterable of numbers as floats; raises TypeError when it is something else."""
    if isinstance(values, str | bytes | dict) or not hasattr(values, "__iter__"):
        raise _wrong(what, values, want)
    return [number(what, value, want) for value in values]


def integer(what: str, value: Any, want: str = "an integer", *, flags: bool = False) -> int:
    """Return an integer of at most 64 bits.

    Args:
        what: what was attempted, for the message.
        value: given by the caller: an integer, or what stands for one, as a marker does.
        want: what would be right.
        flags: whether True and False count as 1 and 0, and a floating-point number as the whole number that it is.

    Raises:
        TypeError: it is none.
        ValueError: it has more bits.
    """
    real = hasattr(value, "__float__") and not _is_array(value)
    if hasattr(value, "__index__") and (flags or not isinstance(value, bool)) and not _is_array(value):
        found = index(value)
    elif float(value).is_integer() if flags and real else hasattr(value, "__int__") and not hasattr(value, "__float__"):
        found = int(value)
    else:
        raise _wrong(what, value, want)
    if not _LEAST <= found < _MOST:
        raise ValueError(f"{what}: {shown(found)} does not fit in 64 bits; want {want}")
    return found


def seconds(what: str, value: Any) -> float | None:
    """Return a time-out [s], None = for ever; raises TypeError or ValueError when it is none."""
    if value is None:
        return None
    found = number(f"{what}: time-out", value, _SECONDS)
    if found != found:
        raise ValueError(f"{what}: time-out {found}; want {_SECONDS}")
    return found


def plain(what: str, value: Any, depth: int = _DEPTH) -> Any:
    """Return a value as messages hold it: arrays and tuples as lists, numbers of numpy as plain ones.

    Raises:
        TypeError: messages do not contain this type.
        ValueError: it is nested too deep, or an integer of more than 64 bits.
    """
    if value is None or type(value) in (bool, float, str, bytes):
        return value
    if hasattr(value, "tolist"):
        value = value.tolist()
    if depth == 0:
        raise ValueError(f"{what}: the argument is nested more than {_DEPTH} deep")
    if isinstance(value, list | tuple):
        return [plain(what, each, depth - 1) for each in value]
    if isinstance(value, dict):
        if not all(type(key) is str for key in value):
            raise _wrong(what, value, "names as keys")
        return {key: plain(what, each, depth - 1) for key, each in value.items()}
    if isinstance(value, bool | float | str | bytes):
        return value
    return integer(what, value, "numbers, text, lists or maps of them, or none")


def checked(what: str, message: M) -> M:
    """Return a message of what a program has handed over with its arguments as the verb takes them
    (``protocol.verbs``).

    Raises:
        TypeError: one is of another kind.
        ValueError: no message holds it.
    """
    taken: list[Any] = []
    verb = what if len(what) <= _LONGEST_WHAT else f"{what[:_LONGEST_WHAT]}..."
    for value, (name, kind) in zip(message, message.fields.items(), strict=True):
        what = f"{verb}: {name.removesuffix('_s').replace('_', ' ')}"
        if kind is INTEGER:
            value = value if type(value) is int and 0 <= value < _MOST else integer(what, value)
        elif kind is SECONDS:
            value = seconds(verb, value)
        elif kind is NUMBER:
            value = number(what, value)
        elif kind is ANYTHING:
            value = plain(what, value)
        elif kind is FLAG:
            value = bool(value)
        elif type(value) not in kind.types:
            raise _wrong(what, value, kind.words)
        if kind.most and len(value) > kind.most:
            raise ValueError(f"{what}: {len(value)} characters; want {kind.words} of at most {kind.most}")
        taken.append(value)
    return message.of(taken)
