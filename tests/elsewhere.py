"""The clock of another machine: processes whose CLOCK_MONOTONIC is that of a machine started at another time.

Linux has time namespaces for that (5.6 and later, with the right to make them: root, or a user namespace).
"""

from __future__ import annotations

import functools
import subprocess
import sys
from collections.abc import Sequence

AHEAD_S = 100_000
"""What CLOCK_MONOTONIC shows more there [s]."""
_ENTER = f"""
import ctypes, os, subprocess, sys
libc = ctypes.CDLL(None, use_errno=True)
NEWTIME, NEWUSER = 0x80, 0x10000000
if libc.unshare(NEWTIME) and libc.unshare(NEWUSER | NEWTIME):
    sys.exit("no time namespace: " + os.strerror(ctypes.get_errno()))
with open("/proc/self/timens_offsets", "w") as file:
    file.write("monotonic {AHEAD_S} 0\\nboottime {AHEAD_S} 0\\n")
libc.prctl(1, 9)
child = os.fork()
if not child:
    libc.prctl(1, 9)
    os.execv(sys.argv[1], sys.argv[1:])
sys.exit(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) & 255)
"""


def elsewhere(command: Sequence[str]) -> list[str]:
    """Return a command that runs another one there; it ends with whoever started it."""
    return [sys.executable, "-c", _ENTER, *command]


@functools.cache
def why_not() -> str:
    """Return why there is no such place on this machine; '' where there is."""
    there = [sys.executable, "-c", "import time; print(time.monotonic())"]
    done = subprocess.run(elsewhere(there), capture_output=True, text=True, timeout=60)
    here = subprocess.run(there, capture_output=True, text=True, timeout=60)
    if done.returncode or float(done.stdout) < float(here.stdout) + AHEAD_S / 2:
        return done.stderr.strip() or "time namespaces have no effect here"
    return ""
