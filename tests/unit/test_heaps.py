"""Threads of a process that wants one heap share it."""

from __future__ import annotations

import subprocess
import sys

PROGRAM = """
import ctypes, sys, threading
from sioms.heaps import one_heap
if sys.argv[1] == "one":
    one_heap()
libc = ctypes.CDLL(None)
libc.malloc.restype, libc.malloc.argtypes = ctypes.c_void_p, [ctypes.c_size_t]
libc.fdopen.restype, libc.malloc_info.argtypes = ctypes.c_void_p, [ctypes.c_int, ctypes.c_void_p]
libc.fflush.argtypes = [ctypes.c_void_p]
together, taken = threading.Barrier(4), threading.Barrier(5)

def take():
    together.wait()
    for _ in range(2000):
        libc.malloc(3000)
    taken.wait()

for _ in range(4):
    threading.Thread(target=take).start()
taken.wait()
out = libc.fdopen(1, b"w")
libc.malloc_info(0, out)
libc.fflush(out)
"""


def heaps(how: str) -> int:
    done = subprocess.run([sys.executable, "-P", "-c", PROGRAM, how], capture_output=True, text=True, check=True)
    return done.stdout.count("<heap nr=")


def test_threads_share_the_heap() -> None:
    assert heaps("each") > 1, "this C library gives threads no heaps of their own: the test shows nothing"
    assert heaps("one") == 1
