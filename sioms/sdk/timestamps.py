"""When a packet was sent, by the kernel's timestamp, so that nothing sent before a reset is carried out after it.

A client may send, and another one stop and reset, before the driver has run. What the driver reads then may be of
before the stop or of after the reset. See docs/decisions/0950-what-was-sent-before-a-reset-is-not-taken-after-it.md.

Concurrency: one thread.
"""

from __future__ import annotations

import socket
import sys
import time
from struct import unpack_from

from sioms.descriptors import SO_TIMESTAMPNS

from .rt import ClockChanges

_TIMESPEC = 16
_ROOM = socket.CMSG_SPACE(_TIMESPEC)
_DOUBT_NS = 10_000_000_000
"""Timestamps are of no use for so long after the clock was set: they may be from before [ns]."""
_AT_ONCE_NS = 20_000
"""Within so long two clocks are looked at, unless the process has to wait in between [ns]."""
_TRIES = 10


def pending_bytes(sock: socket.socket) -> int:
    """Return how many bytes lie in a socket, of all packets together; 0 for one that is closed."""
    from fcntl import ioctl  # few drivers ever need them
    from termios import FIONREAD

    try:
        return int.from_bytes(ioctl(sock.fileno(), FIONREAD, bytes(4)), sys.byteorder)
    except OSError:
        return 0


def receive(sock: socket.socket, most_bytes: int) -> tuple[bytes, int]:
    """Receive a packet from a socket with timestamps.

    Returns:
        The packet, and its timestamp [ns, CLOCK_REALTIME]; 0: it has none.

    Raises:
        OSError: as ``socket.recvmsg``.
    """
    # The timestamp comes first and fills the buffer: descriptors that a client may send along are not received.
    packet, ancillary, _, _ = sock.recvmsg(most_bytes, _ROOM)
    for level, kind, data in ancillary:
        if (level, kind) == (socket.SOL_SOCKET, SO_TIMESTAMPNS) and len(data) >= _TIMESPEC:
            seconds, rest_ns = unpack_from("qq", data)
            return packet, seconds * 1_000_000_000 + rest_ns
    return packet, 0


class Timestamps:
    """What timestamps mean on the monotonic clock.

    Attributes:
        fd: readable when CLOCK_REALTIME has been set.
    """

    def __init__(self) -> None:
        self._changes = ClockChanges()
        self._changed_ns = -_DOUBT_NS
        self.fd = self._changes.fd

    def look_at_clock(self) -> None:
        """Note when the clock has been set."""
        if self._changes.found():
            self._changed_ns = time.monotonic_ns()

    def monotonic_ns(self, timestamp_ns: int) -> int:
        """Return when something with a timestamp was sent [ns, CLOCK_MONOTONIC].

        If the process has to wait between its looks at both clocks, it comes out too early, never too late; as early
        as can be where there is no timestamp, or the clock may have been set since.
        """
        self.look_at_clock()
        now_ns = time.monotonic_ns()
        if not timestamp_ns or now_ns - self._changed_ns < _DOUBT_NS:
            return 0
        for _ in range(_TRIES):
            wall_ns = time.time_ns()
            again_ns = time.monotonic_ns()
            if again_ns - now_ns <= _AT_ONCE_NS:
                break
            now_ns = again_ns
        return min(now_ns, now_ns - wall_ns + timestamp_ns)

    def close(self) -> None:
        """Release the descriptor."""
        self._changes.close()
