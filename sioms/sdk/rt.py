"""Real-time services of Linux that Python 3.11 does not wrap: timerfd, inotify, mlockall, timer slack.

Everything that needs a privilege is tried and, when refused, done without: SIOMS then runs with the
latencies of an ordinary process.
"""

from __future__ import annotations

import ctypes
import errno
import gc
import os
import resource
import signal
import time
from collections.abc import Callable
from contextlib import suppress

from sioms.timestamps import TFD_CLOEXEC, TFD_NONBLOCK, TFD_TIMER_ABSTIME, Itimerspec

_libc = ctypes.CDLL(None, use_errno=True)
_MCL_CURRENT, _MCL_FUTURE, _MCL_ONFAULT = 1, 2, 4
_IN_MODIFY, _IN_ATTRIB = 0x02, 0x04
_PR_SET_NAME, _PR_SET_TIMERSLACK = 15, 29


RESTLESS_S = 0.2
"""Longest that a real-time process may work without waiting for anything [s]; ticks take milliseconds."""


class TimerFd:
    """A timer as a descriptor (timerfd_create(2)), on CLOCK_MONOTONIC.

    Concurrency: one thread.
    """

    def __init__(self) -> None:
        self.fd: int = _libc.timerfd_create(time.CLOCK_MONOTONIC, TFD_CLOEXEC | TFD_NONBLOCK)
        if self.fd < 0:
            raise OSError(ctypes.get_errno(), "create timer: timerfd_create failed")
        self._spec = Itimerspec()
        self._pointer = ctypes.byref(self._spec)

    def set(self, first_ns: int, period_ns: int = 0) -> None:
        """Expire at a time [ns, CLOCK_MONOTONIC; 0 disarms], and then every period [ns]."""
        spec = self._spec
        spec.value.sec, spec.value.nsec = divmod(first_ns, 1_000_000_000)
        spec.interval.sec, spec.interval.nsec = divmod(period_ns, 1_000_000_000)
        if _libc.timerfd_settime(self.fd, TFD_TIMER_ABSTIME, self._pointer, None):
            raise OSError(ctypes.get_errno(), "set timer: timerfd_settime failed")

    def expirations(self) -> int:
        """Return how often it has expired since the last call."""
        try:
            return int.from_bytes(os.read(self.fd, 8), "little")
        except BlockingIOError:
            return 0

    def close(self) -> None:
        """Release the descriptor."""
        os.close(self.fd)


class ChangeWatch:
    """A descriptor that is readable when somebody has written to a file (inotify(7)).

    Args:
        fd: of the file.

    Raises:
        OSError: there are too many such watches already.

    Concurrency: one thread.
    """

    def __init__(self, fd: int) -> None:
        self.fd: int = _libc.inotify_init1(os.O_CLOEXEC | os.O_NONBLOCK)
        if self.fd < 0:
            raise OSError(ctypes.get_errno(), "watch a file: inotify_init1 failed")
        if _libc.inotify_add_watch(self.fd, f"/proc/self/fd/{fd}".encode(), _IN_MODIFY | _IN_ATTRIB) < 0:
            number = ctypes.get_errno()
            os.close(self.fd)
            raise OSError(number, "watch a file: inotify_add_watch failed")

    def drain(self) -> None:
        """Forget what has been written until now."""
        with suppress(BlockingIOError):
            while os.read(self.fd, 4096):
                pass


def name_process(name: str) -> None:
    """Set the name that ps and top show (15 bytes)."""
    _libc.prctl(_PR_SET_NAME, name.encode()[:15], 0, 0, 0)


def _limit_restlessness(log: Callable[[str, str], None]) -> None:
    """Become an ordinary process when the kernel says that we have not waited for anything for too long."""

    def take(_number: int, _frame: object) -> None:
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
        log(
            "warning",
            f"gave up real-time scheduling: its tick has run for {RESTLESS_S:g} s without a pause, and nothing else "
            "on that processor could; lower the rate, or give it fewer channels",
        )

    signal.signal(signal.SIGXCPU, take)
    _, most = resource.getrlimit(resource.RLIMIT_RTTIME)
    soft = int(RESTLESS_S * 1e6)
    if most == resource.RLIM_INFINITY or most > soft:  # else whoever started us has set a tighter one
        resource.setrlimit(resource.RLIMIT_RTTIME, (soft, most))


def become_realtime(priority: int, log: Callable[[str, str], None]) -> list[str]:
    """Ask for real-time scheduling and resident memory, and switch the cyclic collector off.

    Args:
        priority: SCHED_FIFO priority 1 to 99; 0 leaves the scheduling as it is.
        log: takes level and text, when the process has worked for RESTLESS_S [s] without waiting for anything, and was
            therefore made an ordinary one.

    Returns:
        What was refused, in words, for the log.
    """
    refused = []
    gc.collect()  # first: it may take longer than a real-time process may work without a pause
    with suppress(AttributeError):  # another libc
        _libc.malloc_trim(0)  # what only the start needed; memory that is locked cannot be given back
    gc.freeze()
    gc.disable()
    _libc.prctl(_PR_SET_TIMERSLACK, 1, 0, 0, 0)
    if priority:
        try:
            _limit_restlessness(log)
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
        except (PermissionError, OSError) as error:
            refused.append(f"SCHED_FIFO priority {priority} ({errno.errorcode.get(error.errno or 0, '?')})")
    # ONFAULT: the pages shared with the fork server stay shared until they are written.
    if _libc.mlockall(_MCL_CURRENT | _MCL_FUTURE | _MCL_ONFAULT):
        refused.append(f"mlockall ({errno.errorcode.get(ctypes.get_errno(), '?')})")
    return refused


def become_user(user: str) -> None:
    """Give up root for a user, with his groups."""
    import pwd

    entry = pwd.getpwnam(user)
    os.initgroups(user, entry.pw_gid)
    os.setgid(entry.pw_gid)
    os.setuid(entry.pw_uid)


def settle(priority: int, user: str, log: Callable[[str, str], None]) -> None:
    """Become who the process shall be: its user, its scheduling class."""
    if user and os.getuid() == 0:
        become_user(user)
    refused = become_realtime(priority, log)
    if refused:
        log("debug", "runs without " + ", ".join(refused))
