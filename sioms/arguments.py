"""Numbers on a command line for argparse: what makes no sense is an error of use, before anything is read or moved.
Pure.
"""

from __future__ import annotations

import argparse
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
