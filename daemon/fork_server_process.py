"""The fork server's process, which a daemon starts first of all: it imports its libraries while the daemon imports its
own.
"""

from __future__ import annotations

import os
import sys

# Not ``socket``, ``typing`` and ``signal``, with ``enum``: the fork server would wait for them as long as an
# interpreter takes to start, and a daemon for the fork server.
from _socket import AF_UNIX, SOCK_SEQPACKET, socketpair

from sioms.safe_path import safe_environment

_SIGINT = 2
"""Of Linux."""


class ForkServerProcess:
    """A running fork server.

    Args:
        fd: of a non-blocking socket to it; the fork server ends when this closes.
        pid: its process.
    """

    __slots__ = ("fd", "pid")

    def __init__(self, fd: int, pid: int) -> None:
        self.fd, self.pid = fd, pid


def start_fork_server() -> ForkServerProcess:
    """Start a fork server.

    Raises:
        OSError: no process or no descriptor is left.
    """
    ours, theirs = socketpair(AF_UNIX, SOCK_SEQPACKET)
    ours.setblocking(False)  # a fork server that is stuck in a driver's import must not hold up the daemon
    environment = dict(
        safe_environment(os.environ),
        OPENBLAS_NUM_THREADS="1",
        OMP_NUM_THREADS="1",
        PYTHONFAULTHANDLER="1",
    )
    # Not by ``-m``, which imports a third as long as an interpreter takes to start.
    run = f"from sioms.sdk.fork_server import main; main({theirs.fileno()})"
    try:
        os.set_inheritable(theirs.fileno(), True)
        # A terminal's Ctrl-C is for the daemon, whose end ends the fork server.
        pid = os.posix_spawn(sys.executable, [sys.executable, "-P", "-c", run], environment, setsigmask=[_SIGINT])
    finally:
        theirs.close()
    return ForkServerProcess(ours.detach(), pid)
