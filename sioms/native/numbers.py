"""Functions of numbers that steps may call. Each is here in Python and, in ``C``, in C."""

from __future__ import annotations

import math
import struct

from .language import Bytes

C = """
static inline int64_t lesser_int(int64_t a, int64_t b) { return b < a ? b : a; }
static inline int64_t greater_int(int64_t a, int64_t b) { return b > a ? b : a; }
static inline double lesser(double a, double b) { return b < a ? b : a; }
static inline double greater(double a, double b) { return b > a ? b : a; }
static inline double sioms_whole(double x) { return floor(x); }
static inline double sioms_nearest(double x) { return rint(x); }
static inline int64_t sioms_is_finite(double x) { return isfinite(x) != 0; }

static inline double sioms_real_at(uint8_t *bytes, int64_t at)
{
    double value;
    memcpy(&value, bytes + at, sizeof value);
    return value;
}

static inline int64_t sioms_word_at(uint8_t *bytes, int64_t at)
{
    uint32_t value;
    memcpy(&value, bytes + at, sizeof value);
    return value;
}
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


def real_at(data: Bytes, at: int) -> float:
    """Return the double that begins at a byte, in the order of this machine."""
    value: float = struct.unpack_from("=d", data, at)[0]  # type: ignore[arg-type]
    return value


def word_at(data: Bytes, at: int) -> int:
    """Return the unsigned word of 32 bits that begins at a byte, in the order of this machine."""
    value: int = struct.unpack_from("=I", data, at)[0]  # type: ignore[arg-type]
    return value
