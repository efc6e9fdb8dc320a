"""This machine's wall clock, and how good its kernel knows it to be."""

from __future__ import annotations

import ctypes
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from sioms.protocol.clock import UNKNOWN_NS, Source, Wall

_STA_UNSYNC = 0x40
_PTP = ("/run/ptp4l", "/run/ptp4lro", "/run/timemaster", "/var/run/ptp4l")
"""Where the PTP daemon of linuxptp listens while it runs."""


class _Timex(ctypes.Structure):
    """``struct timex`` of adjtimex(2), as far as it is read."""

    _fields_ = (
        ("modes", ctypes.c_uint),
        ("offset", ctypes.c_long),
        ("freq", ctypes.c_long),
        ("maxerror", ctypes.c_long),
        ("esterror", ctypes.c_long),
        ("status", ctypes.c_int),
        ("rest", ctypes.c_long * 32),
    )


LOOKS, QUICK_NS = 8, 10_000
"""Most looks at both clocks, and how long one takes that nothing has come between [ns]."""


def _looks() -> Iterator[tuple[int, int]]:
    """Return how long looks at both clocks took, and UTC minus CLOCK_MONOTONIC by each [ns], up to a quick one.

    Where this process had to wait for a processor in the midst of a look, that is off by half of the wait.
    """
    for _ in range(LOOKS):
        before = time.monotonic_ns()
        utc_ns = time.time_ns()
        after = time.monotonic_ns()
        yield after - before, utc_ns - (before + after) // 2
        if after - before < QUICK_NS:
            return


def wall() -> Wall:
    """Read both clocks.

    The error is the kernel's ``maxerror``: set by the service that disciplines the clock, and growing in between.
    """
    took_ns, ahead_ns = min(_looks())
    timex = _Timex()
    with suppress(OSError, AttributeError):
        if ctypes.CDLL(None).adjtimex(ctypes.byref(timex)) >= 0 and not timex.status & _STA_UNSYNC:
            source = Source.PTP if any(Path(path).exists() for path in _PTP) else Source.NTP
            return Wall(ahead_ns, timex.maxerror * 1000 + took_ns, source)
    return Wall(ahead_ns, UNKNOWN_NS, Source.NONE)
