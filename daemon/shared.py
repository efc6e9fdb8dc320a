"""What every driver process shares: the emergency-stop latch, the stop-request file, the marker table."""

from __future__ import annotations

import fcntl
import mmap
import os
from contextlib import suppress

from sioms.protocol.latch import LATCH_SIZE, Latch
from sioms.protocol.markers import TABLE_SIZE, MarkerTable
from sioms.protocol.stopfile import StopRequest
from sioms.protocol.stopjournal import workcell_entry

from .journals import OwnJournal
from .stop_files import StopFiles, left
from .stop_record import StopRecord

_SEALS = fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_GROW | fcntl.F_SEAL_SEAL


class Shared:
    """Memory files, the stop files, the record of stops, and the daemon's views of them.

    Args:
        path: of the daemon's socket, beside which the stop files lie.
        record: what is stopped.

    Attributes:
        journal: what the daemon tells recorders.
        left_word: of the last request to the file of the daemon before, which drivers of that may note still; 0: none.
        fds: descriptors of latch, stop-request file, file of the requests taken, marker table and journal of stops, as
            a driver gets them.
    """

    def __init__(self, path: str, record: StopRecord) -> None:
        self.record = record
        self.journal = OwnJournal()
        self.left_word, source = left(path)
        if source and self.left_word != record.state.request:  # who is late says that he has obeyed the one before
            with suppress(OSError):  # it holds for our life then
                record.note(workcell_entry(source, stop=True, named=True, resets=record.state.resets))
        self.files = StopFiles(path)
        latch_fd, latch = _memory("sioms-latch", LATCH_SIZE)
        markers_fd, markers = _memory("sioms-markers", TABLE_SIZE)
        self.fds = [latch_fd, self.files.fd, self.files.taken_fd, markers_fd, record.drivers_fd]
        self.latch = Latch(latch)
        self.request = StopRequest(self.files.fd, self.files.taken_fd)
        self.latch.begin(record.state.resets, (0, self.request.mark[1]))  # somebody may have written by now
        self.markers = MarkerTable(markers)


def _memory(name: str, size: int) -> tuple[int, memoryview]:
    fd = os.memfd_create(name, os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
    os.ftruncate(fd, size)
    fcntl.fcntl(fd, fcntl.F_ADD_SEALS, _SEALS)
    return fd, memoryview(mmap.mmap(fd, size))
