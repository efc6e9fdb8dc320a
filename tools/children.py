"""Processes that end with the program that starts them, however that ends.

A program that is told to end (SIGTERM, SIGHUP, Ctrl-C) ends what it has started by itself; for one that is killed the kernel
does so: each child asks it for a SIGTERM on the death of its parent. A daemon that gets it stops its drivers.
"""

from __future__ import annotations

import ctypes
import os
import signal
from collections.abc import Callable

_PR_SET_PDEATHSIG = 1
_libc = ctypes.CDLL(None)


def ends_with_us() -> Callable[[], None]:
    """Return the ``preexec_fn`` of a child that gets SIGTERM when the thread that starts it ends, by prctl(2)."""
    parent = os.getpid()

    def tie() -> None:
        _libc.prctl(_PR_SET_PDEATHSIG, signal.SIGTERM, 0, 0, 0)
        if os.getppid() != parent:  # it has died meanwhile
            os._exit(128 + signal.SIGTERM)

    return tie
