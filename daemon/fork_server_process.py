"""The fork server's process, which a daemon starts first of all: it imports its libraries while the daemon imports its
own.
"""

from __future__ import annotations

import os
import socket
import sys
from typing import NamedTuple

from sioms.safe_path import safe_environment

_SIGINT = 2
"""Of Linux; importing ``signal`` would delay the fork server by the import of ``enum``."""


class ForkServerProcess(NamedTuple):
    """A running fork server.

    Args:
        sock: non-blocking socket to it; the fork server ends when this closes.
        pid: its process.
    """

    sock: socket.socket
    pid: int


def start_fork_server() -> ForkServerProcess:
    """Start a fork server.

    Raises:
        OSError: no process or no descriptor is left.
    """
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    ours.setblocking(False)  # a fork server that is stuck in a driver's import must not hold up the daemon
    with theirs:
        theirs.set_inheritable(True)
        environment = dict(
            safe_environment(os.environ),
            OPENBLAS_NUM_THREADS="1",
            OMP_NUM_THREADS="1",
            PYTHONFAULTHANDLER="1",
        )
        arguments = [sys.executable, "-P", "-m", "sioms.sdk.fork_server", str(theirs.fileno())]
        # A terminal's Ctrl-C is for the daemon, whose end ends the fork server.
        pid = os.posix_spawn(sys.executable, arguments, environment, setsigmask=[_SIGINT])
        return ForkServerProcess(ours, pid)
