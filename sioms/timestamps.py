"""When a packet was sent, by the kernel's timestamp, so that nothing sent before a reset is carried out after it.

A client may send, and another one stop and reset, before the driver has run. What the driver reads then may be of
before the stop or of after the reset. See docs/decisions/0950-what-was-sent-before-a-reset-is-not-taken-after-it.md.

Concurrency: one thread.
"""

from __future__ import annotations

import ctypes
import errno
import os
import socket
import sys
import time
from fcntl import ioctl
from struct import unpack_from
from termios import FIONREAD

from sioms.descriptors import SO_TIMESTAMPNS

_libc = ctypes.CDLL(None, use_errno=True)
TFD_CLOEXEC, TFD_NONBLOCK, TFD_TIMER_ABSTIME, _TFD_TIMER_CANCEL_ON_SET = 0o2000000, 0o4000, 1, 2
_TIMESPEC = 16
_ROOM = socket.CMSG_SPACE(_TIMESPEC)
_DOUBT_NS = 10_000_000_000
"""For so long after the clock was set a timestamp may be of the clock as it was before [ns]."""
_AT_ONCE_NS = 20_000
"""Within so long two clocks are looked at, unless the process has to wait in between [ns]."""
_TRIES = 10
_LEAST_NS = 1000
"""Clocks that are set by less are as they were [ns]."""


class _Timespec(ctypes.Structure):
    _fields_ = (("sec", ctypes.c_long), ("nsec", ctypes.c_long))


class Itimerspec(ctypes.Structure):
    """Period and first expiry of a timer (timerfd_create(2))."""

    _fields_ = (("interval", _Timespec), ("value", _Timespec))


def pending_bytes(sock: socket.socket) -> int:
    """Return how many bytes lie in a socket, of all packets together; 0 for one that is closed."""
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


class ClockChanges:
    """Tells whether CLOCK_REALTIME has been set: what makes it jump, not what makes it faster (timerfd_create(2)).

    Raises:
        OSError: there are no descriptors left.

    Concurrency: one thread.
    """

    def __init__(self) -> None:
        self.fd: int = _libc.timerfd_create(time.CLOCK_REALTIME, TFD_CLOEXEC | TFD_NONBLOCK)
        never = Itimerspec(value=_Timespec(sec=1 << 40))
        how = TFD_TIMER_ABSTIME | _TFD_TIMER_CANCEL_ON_SET
        if self.fd < 0 or _libc.timerfd_settime(self.fd, how, ctypes.byref(never), None):
            raise OSError(ctypes.get_errno(), "watch the clock: timerfd failed")

    def found(self) -> bool:
        """Return whether it has been set since the last call."""
        try:
            os.read(self.fd, 8)
        except BlockingIOError:
            return False
        except OSError as error:
            if error.errno != errno.ECANCELED:
                raise
        return True

    def close(self) -> None:
        """Release the descriptor."""
        os.close(self.fd)


class Timestamps:
    """What timestamps mean on the monotonic clock.

    Both clocks go equally fast, so the time between them changes when CLOCK_REALTIME is set, and at no other time.

    Attributes:
        fd: readable when CLOCK_REALTIME has been set.
    """

    def __init__(self) -> None:
        self._changes = ClockChanges()
        self.fd = self._changes.fd
        self._ahead_ns = _look()[1]
        self._before: list[tuple[int, int]] = []
        """How far CLOCK_REALTIME was ahead before it was set, and when that has been noticed."""

    def look_at_clock(self) -> None:
        """Note when the clock has been set."""
        if self._changes.found():
            self._compare(_LEAST_NS)

    def monotonic_ns(self, timestamp_ns: int) -> int:
        """Return when something with a timestamp was sent [ns, CLOCK_MONOTONIC].

        If the process has to wait between its looks at both clocks, it comes out too early, never too late; as early
        as can be where there is no timestamp. Of a clock that has been set within some seconds it is the earlier one of
        what the timestamp means by that clock as it is and as it was, if it can have been sent by then.
        """
        self.look_at_clock()
        now_ns = self._compare(_AT_ONCE_NS)
        if not timestamp_ns:
            return 0
        self._before = [each for each in self._before if now_ns - each[1] < _DOUBT_NS]
        meant = [
            timestamp_ns - ahead_ns for ahead_ns, noticed_ns in self._before if timestamp_ns - ahead_ns < noticed_ns
        ]
        return min(now_ns, timestamp_ns - self._ahead_ns, *meant)

    def _compare(self, least_ns: int) -> int:
        """Note how far the clocks are apart, and how far they were if that differs by more; return the time [ns]."""
        now_ns, ahead_ns = _look()
        if abs(ahead_ns - self._ahead_ns) > least_ns:
            self._before.append((self._ahead_ns, now_ns))
        self._ahead_ns = ahead_ns
        return now_ns

    def close(self) -> None:
        """Release the descriptor."""
        self._changes.close()


def _look() -> tuple[int, int]:
    """Return the time by CLOCK_MONOTONIC, and how far CLOCK_REALTIME is ahead of it, or a bit more [ns]."""
    now_ns = time.monotonic_ns()
    for _ in range(_TRIES):
        wall_ns = time.time_ns()
        again_ns = time.monotonic_ns()
        if again_ns - now_ns <= _AT_ONCE_NS:
            break
        now_ns = again_ns
    return now_ns, wall_ns - now_ns
