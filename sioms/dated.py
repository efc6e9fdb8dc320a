"""When a packet was sent: sockets of handles date what comes, so that nothing sent before a reset is taken after it.

A client may send and another one stop and reset before the driver has had a processor. What it reads then is of before
the stop, or of after the reset; only the kernel, which stamps each packet when it is sent, knows.

Concurrency: as the socket.
"""

from __future__ import annotations

import os
import socket
import time
from struct import unpack_from

_SO_TIMESTAMPNS, _FIONREAD = 35, 0x541B
_TIMESPEC = 16
_STEP_NS, _SLEW = 1_000_000, 1000
"""Where the wall clock, by which packets are dated, has moved against the monotonic one by so much, and one part in so
many of the time since the last look, it has been set.
"""
_looked_ns = time.clock_gettime_ns(time.CLOCK_MONOTONIC)
_offset_ns = time.time_ns() - _looked_ns


def date_what_comes(sock: socket.socket) -> None:
    """Have the kernel stamp all that is sent to a socket from now on."""
    sock.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)


def unread(sock: socket.socket) -> int:
    """Return how many bytes of how many packets ever lie in a socket; 0 for one that is closed."""
    from fcntl import ioctl

    try:
        return int.from_bytes(ioctl(sock.fileno(), _FIONREAD, bytes(4)), "little")
    except OSError:
        return 0


def received(sock: socket.socket, most: int) -> tuple[bytes, int]:
    """Receive a packet, and when it was sent [ns, CLOCK_MONOTONIC]; now, where the kernel does not say; 0, ever so long
    ago, where the clock may have been set since.

    Raises:
        OSError: as ``socket.recvmsg``.
    """
    packet, ancillary, _, _ = sock.recvmsg(most, socket.CMSG_SPACE(_TIMESPEC))
    now_ns = time.monotonic_ns()
    wall_ns = time.time_ns()  # if the process has to wait in between, what was sent looks older, never newer
    sent_ns, was_set = now_ns, _was_set()
    for level, kind, data in ancillary:
        if level == socket.SOL_SOCKET and kind == _SO_TIMESTAMPNS and len(data) >= _TIMESPEC:
            seconds, rest_ns = unpack_from("qq", data)
            sent_ns = 0 if was_set else now_ns - (wall_ns - seconds * 1_000_000_000 - rest_ns)
        elif level == socket.SOL_SOCKET and kind == socket.SCM_RIGHTS:  # there is no room for them beside the stamp
            for fd in unpack_from(f"{len(data) // 4}i", data):
                os.close(fd)
    return packet, sent_ns


def _was_set() -> bool:
    """Return whether the wall clock may have been set since the last look."""
    global _looked_ns, _offset_ns
    now_ns = time.clock_gettime_ns(time.CLOCK_MONOTONIC)
    offset_ns, since_ns = time.time_ns() - now_ns, now_ns - _looked_ns
    moved_ns, _offset_ns, _looked_ns = abs(offset_ns - _offset_ns), offset_ns, now_ns
    return moved_ns > _STEP_NS + since_ns // _SLEW
