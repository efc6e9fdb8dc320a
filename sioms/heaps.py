"""The heaps from which threads of a process take memory.

glibc gives threads that allocate at once heaps of their own, up to eight for each processor, and none gives back what
lies in it between pieces that are in use. So what a process with some threads of a library holds depends on which of
them has had which piece, and creeps upwards for hours although no more is in use.
"""

from __future__ import annotations

import ctypes

_ARENA_MAX = -8  # malloc.h


def one_heap() -> None:
    """Have all threads of this process share a heap, from now on: for one that does little at once. Other C libraries
    than glibc have no such setting, and are left as they are.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(_ARENA_MAX, 1)
