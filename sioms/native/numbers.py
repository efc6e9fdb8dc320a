"""Functions of numbers that steps may call. Each is here in Python and, in ``C``, in C."""

from __future__ import annotations

import math

C = """
static inline int64_t lesser_int(int64_t a, int64_t b) { return b < a ? b : a; }
static inline int64_t greater_int(int64_t a, int64_t b) { return b > a ? b : a; }
static inline double lesser(double a, double b) { return b < a ? b : a; }
static inline double greater(double a, double b) { return b > a ? b : a; }
static inline double sioms_whole(double x) { return floor(x); }
static inline double sioms_nearest(double x) { return rint(x); }
static inline int64_t sioms_is_finite(double x) { return isfinite(x) != 0; }
"""


def whole(x: float) -> float:
    """Return the greatest whole number that is not above x."""
    return float(math.floor(x)) if math.isfinite(x) else x


def nearest(x: float) -> float:
    """Return the whole number nearest to x, the even one of two."""
    return float(round(x)) if math.isfinite(x) else x


def is_finite(x: float) -> int:
    """Return 1 for a finite number."""
    return int(math.isfinite(x))
