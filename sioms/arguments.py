"""Numbers on a command line for argparse: what makes no sense is an error of use, before anything is read or moved.
Pure.
"""

from __future__ import annotations

import argparse
import errno
import math
from collections.abc import Callable

MOST, LARGEST = 2**31 - 1, 1e15
"""What is larger, a count or a number, is a slip."""


def whole(least: int = 0, most: int = MOST) -> Callable[[str], int]:
    """Return what reads a whole number within bounds."""

    def read(text: str) -> int:
        try:
            value = int(text)
        except ValueError:
            value = least - 1
        if not least <= value <= most:
            to = f" and <= {most}" if value > most else ""
            raise argparse.ArgumentTypeError(f"{text!r}: must be an integer >= {least}{to}")
        return value

    return read


def positive(text: str) -> float:
    """Read a number above 0, of any sensible size."""
    value = _number(text)
    if not 0.0 < value <= LARGEST:
        to = f" and <= {LARGEST:g}" if value > LARGEST else ""
        raise argparse.ArgumentTypeError(f"{text!r}: must be a number > 0{to}")
    return value


def not_negative(text: str) -> float:
    """Read a number from 0 on, of any sensible size."""
    value = _number(text)
    if not 0.0 <= value <= LARGEST:
        raise argparse.ArgumentTypeError(f"{text!r}: must be a number from 0 to {LARGEST:g}")
    return value


def radius(text: str) -> float:
    """Read a radius: 0 is an edge, inf a flat."""
    value = _number(text)
    if not (0.0 <= value <= LARGEST or value == math.inf):
        raise argparse.ArgumentTypeError(f"{text!r}: must be a number >= 0, or inf")
    return value


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan


LONGEST_S = 1e9
"""What is further away than so many seconds, 31 years, is a slip."""


def seconds(text: str) -> float:
    """Read a time of either sign [s]."""
    value = _number(text)
    if not abs(value) <= LONGEST_S:
        raise argparse.ArgumentTypeError(f"{text!r}: must be a time in seconds, at most {LONGEST_S:g}")
    return value


def place(text: str, example: str) -> tuple[str, int]:
    """Take a place to listen at, ``HOST:PORT``, apart; an address of IPv6 stands in brackets.

    Raises:
        OSError: EINVAL, none.
    """
    host, colon, port = text.rpartition(":")
    host = host.removeprefix("[").removesuffix("]")
    if not colon or not host or not port.isdecimal() or not 0 < int(port) < 65535:
        other = example.rpartition(":")[2]
        raise OSError(errno.EINVAL, f"listen on {text}: want HOST:PORT, as {example} or *:{other}")
    return host, int(port)
