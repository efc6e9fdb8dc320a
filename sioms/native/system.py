"""What steps may call besides each other: numbers, time and memory. Each has its C beside it."""

from __future__ import annotations

import math
import time

C = """
static inline int64_t lesser_int(int64_t a, int64_t b) { return b < a ? b : a; }
static inline int64_t greater_int(int64_t a, int64_t b) { return b > a ? b : a; }
static inline double lesser(double a, double b) { return b < a ? b : a; }
static inline double greater(double a, double b) { return b > a ? b : a; }
static inline double whole(double x) { return floor(x); }
static inline int64_t is_finite(double x) { return isfinite(x) != 0; }
static inline int64_t clock_ns(void)
{
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (int64_t)now.tv_sec * 1000000000 + now.tv_nsec;
}
"""


def whole(x: float) -> float:
    """Return the greatest whole number that is not above x."""
    return float(math.floor(x)) if math.isfinite(x) else x


def is_finite(x: float) -> int:
    """Return 1 for a finite number."""
    return int(math.isfinite(x))


def clock_ns() -> int:
    """Return the time [ns, CLOCK_MONOTONIC]."""
    return time.monotonic_ns()
