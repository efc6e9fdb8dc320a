"""The pages every driver process maps: emergency-stop latch, stop requests, marker table."""

from __future__ import annotations

import fcntl
import mmap
import os

from sioms.protocol.latch import LATCH_SIZE, REQUEST_SIZE, Latch, StopRequest
from sioms.protocol.markers import TABLE_SIZE, MarkerTable

_SEALS = fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_GROW | fcntl.F_SEAL_SEAL
"""Clients hold the stop-request page too: a page that shrinks kills everybody who has mapped it (SIGBUS)."""


class Shared:
    """The three memory files and the daemon's views of them.

    Attributes:
        fds: descriptors of latch, request page and marker table, in the order a driver gets them.
    """

    def __init__(self) -> None:
        sizes = (
            ("sioms-latch", LATCH_SIZE),
            ("sioms-stop-request", REQUEST_SIZE),
            ("sioms-markers", TABLE_SIZE),
        )
        self.fds = []
        views = []
        for name, size in sizes:
            fd = os.memfd_create(name, os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
            os.ftruncate(fd, size)
            fcntl.fcntl(fd, fcntl.F_ADD_SEALS, _SEALS)
            self.fds.append(fd)
            views.append(memoryview(mmap.mmap(fd, size)))
        self.latch = Latch(views[0])
        self.request = StopRequest(views[1])
        self.markers = MarkerTable(views[2])

    @property
    def request_fd(self) -> int:
        """Descriptor of the stop-request page, the only one that clients get."""
        return self.fds[1]
