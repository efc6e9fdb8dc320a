"""Descriptors: received as ours and of no program that we start; waited for, whatever their number."""

from __future__ import annotations

import errno
import os
import resource
import select
import socket
import time
from array import array
from collections.abc import Iterable
from contextlib import suppress
from typing import Protocol, TypeVar


class HasDescriptor(Protocol):
    """A file, a socket, a node."""

    def fileno(self) -> int:
        """Return the descriptor."""
        ...


SO_TIMESTAMPNS = 35
"""Socket option, and kind of the message that comes with a packet: <asm-generic/socket.h>."""
Source = TypeVar("Source", bound=int | HasDescriptor)


def enable_timestamps(sock: socket.socket) -> None:
    """Have the kernel add to every packet that is sent to a Unix socket from now on when that was [CLOCK_REALTIME]."""
    sock.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)


def receive(sock: socket.socket, most_bytes: int, most_fds: int) -> tuple[bytes, list[int]]:
    """Receive a packet and its descriptors, which are closed on exec.

    ``socket.recv_fds`` leaves them open in every program that is started later, and has no way to be told otherwise.

    Raises:
        OSError: nothing could be received.
    """
    fds = array("i")
    space = socket.CMSG_LEN(most_fds * fds.itemsize)
    packet, ancillary, _, _ = sock.recvmsg(most_bytes, space, socket.MSG_CMSG_CLOEXEC)
    for level, kind, data in ancillary:
        if (level, kind) == (socket.SOL_SOCKET, socket.SCM_RIGHTS):
            fds.frombytes(data[: len(data) - len(data) % fds.itemsize])
    return packet, list(fds)


def has_ended(sock: socket.socket) -> bool:
    """Tell whether the other end of a socket has gone, and nothing that it has sent is left to take."""
    try:
        return not sock.recv(1, socket.MSG_PEEK | socket.MSG_DONTWAIT)
    except BlockingIOError:
        return False
    except OSError:
        return True


def process_of(pidfd: int) -> int:
    """Return the number of the process that a descriptor is for; 0: it is not known here, or has ended."""
    with suppress(OSError, ValueError), open(f"/proc/self/fdinfo/{pidfd}") as file:
        return max(0, next((int(line.split()[1]) for line in file if line.startswith("Pid:")), 0))
    return 0


def is_exiting(pid: int) -> bool:
    """Tell whether a process has begun to end, with all its threads: it does nothing any more, and is about to close
    what it has open, one after another. False where that is not to be seen.
    """
    try:
        for thread in os.listdir(f"/proc/{pid}/task"):
            with open(f"/proc/{pid}/task/{thread}/stat") as file:
                if not int(file.read().rpartition(")")[2].split()[_FLAGS]) & _EXITING:
                    return False
    except (OSError, ValueError, IndexError):
        return False
    return True


_FLAGS, _EXITING = 6, 0x4
"""Which word behind the name is the flags of a thread, proc_pid_stat(5), and PF_EXITING of <linux/sched.h>."""
MOST_FILES = 65536
"""What a process that serves many permits itself, where its hard limit does: a session or handle takes the daemon some
three, a device some thirty.
"""


def permit_files() -> None:
    """Raise this process's limit of open files to what it may have, at most ``MOST_FILES``."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (max(soft, min(hard, MOST_FILES)), hard))


def readable(sources: Iterable[Source], wait_s: float | None) -> list[Source]:
    """Wait until something can be read from one of these, or one has ended; return all of which that is true.

    ``select.select`` raises ValueError for a descriptor of 1024 or more, which every process of a large cell has.

    Args:
        wait_s: how long to wait [s]; 0: not at all, None: without end. While less than 1 ms is left nothing wakes.

    Raises:
        OSError: one of them is closed.
    """
    return _ready(list(sources), select.POLLIN, wait_s)


def is_readable(source: int | HasDescriptor, wait_s: float | None = 0) -> bool:
    """Tell whether something can be read from this, or it has ended; otherwise as ``readable``."""
    return bool(_ready([source], select.POLLIN, wait_s))


def is_writable(source: int | HasDescriptor, wait_s: float | None = 0) -> bool:
    """Tell whether this takes something, has connected, or has failed to; otherwise as ``readable``."""
    return bool(_ready([source], select.POLLOUT, wait_s))


def _ready(sources: list[Source], events: int, wait_s: float | None) -> list[Source]:
    poll = select.poll()
    for source in sources:
        poll.register(source, events)
    if wait_s is None:
        found = poll.poll()
    else:
        until_s = time.monotonic() + wait_s
        found = poll.poll(int(wait_s * 1e3))
        left_s = until_s - time.monotonic()
        if not found and left_s > 0:
            time.sleep(min(left_s, 1e-3))
            found = poll.poll(0)
    if any(event & select.POLLNVAL for _, event in found):
        raise OSError(errno.EBADF, os.strerror(errno.EBADF))
    ready = {fd for fd, _ in found}
    return [source for source in sources if (source if isinstance(source, int) else source.fileno()) in ready]
