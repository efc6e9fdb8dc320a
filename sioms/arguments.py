"""Numbers on a command line for argparse: what makes no sense is an error of use, before anything is read or moved.
Pure.
"""

from __future__ import annotations

import argparse
import errno
import math
from collections.abc import Callable


def whole(least: int = 0) -> Callable[[str], int]:
    """Return what reads a whole number of so much at least."""

    def read(text: str) -> int:
        try:
            value = int(text)
        except ValueError:
            value = least - 1
        if value < least:
            raise argparse.ArgumentTypeError(f"{text!r} is no whole number from {least} on")
        return value

    return read


def positive(text: str) -> float:
    """Read a finite number above 0."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0.0 < value < math.inf:
        raise argparse.ArgumentTypeError(f"{text!r} is no number above 0")
    return value


LONGEST_S = 1e9
"""What is further away than so many seconds, 31 years, is a slip."""


def seconds(text: str) -> float:
    """Read a time of either sign [s]."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not abs(value) <= LONGEST_S:
        raise argparse.ArgumentTypeError(f"{text!r} is no time in seconds, of {LONGEST_S:g} s at most")
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
