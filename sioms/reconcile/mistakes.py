"""Factors by which numbers are wrong that are in another unit than is said."""

from __future__ import annotations

import numpy as np

#: Mistakes of units by their factor, which is met within a tenth.
MISTAKES = {
    1000.0: "m against mm, N against mN, A against mA",
    180.0 / np.pi: "degrees against radians",
    2.0 * np.pi: "turns against radians",
    25.4: "inches against millimetres",
    39.37: "inches against metres",
    9.80665: "kgf against N, or ten",
    4.44822: "lbf against N",
    2.20462: "kg against lb",
}


def in_another_unit(factor: float) -> str:
    """Say what a factor between two numbers that should be alike looks like."""
    size = max(abs(factor), 1.0 / abs(factor))
    known = next((f" ({said})" for f, said in MISTAKES.items() if 0.9 < size / f < 1.1), "")
    shown = f"{10.0 ** round(np.log10(size)):g}" if size > 100.0 else f"{size:.3g}"
    return f"is one of them in another unit, by a factor of {shown}{known}?"
