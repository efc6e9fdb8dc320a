"""``python -m sioms.bench.counted_gateway FILE serve ...``: the gateway, which counts the frames that it takes apart.

The count, a u64, is in a file that is mapped: it is that of calls of ``link.unpack``, through which every frame of a
peer goes first, whatever port it came by.
"""

from __future__ import annotations

import mmap
import struct
import sys

from sioms.protocol import link
from sioms.tools.front import main

_COUNT = struct.Struct("<Q")


def _count(path: str) -> None:
    with open(path, "r+b") as file:
        memory = mmap.mmap(file.fileno(), mmap.PAGESIZE)
    unpack = link.unpack

    def counted(frame: bytes, most: int) -> tuple[int, int, int, int, bytes]:
        _COUNT.pack_into(memory, 0, _COUNT.unpack_from(memory)[0] + 1)
        return unpack(frame, most)

    link.unpack = counted


if __name__ == "__main__":
    _count(sys.argv[1])
    sys.exit(main(sys.argv[2:]))
