"""What every driver process shares: the emergency-stop latch, the stop-request file, the marker table."""

from __future__ import annotations

import fcntl
import mmap
import os
from contextlib import suppress
from typing import TYPE_CHECKING, Any

from sioms.protocol.latch import LATCH_SIZE, Latch
from sioms.protocol.markers import TABLE_SIZE, MarkerTable
from sioms.protocol.stopfile import StopRequest
from sioms.protocol.stopjournal import file_entry, workcell_entry

from .journals import OwnJournal
from .stop_files import StopFiles, left
from .stop_record import StopRecord

if TYPE_CHECKING:
    from sioms.protocol.stopfile import Mark

UNKNOWN = (
    "the daemon before was killed, and the journal of stops, as one of an earlier version, does not say whether its "
    "requests to stop had been reset; look, then reset"
)
"""Why a workcell is stopped from its start, where a file is left that no entry tells of."""
_SEALS = fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_GROW | fcntl.F_SEAL_SEAL


class Shared:
    """Memory files, the stop files, the record of stops, and the daemon's views of them.

    Args:
        path: of the daemon's socket, beside which the stop files lie.
        record: what is stopped.

    Attributes:
        journal: what the daemon tells recorders.
        left: marks of the stop-request file of the daemon before, which drivers of that may note still.
        fds: descriptors of latch, stop-request file, file of the requests taken, marker table and journal of stops, as
            a driver gets them.
    """

    def __init__(self, path: str, record: StopRecord) -> None:
        self.record = record
        self.journal = OwnJournal()
        self.left: list[Mark] = []
        before = left(path)
        self._settle(before)
        self.files = StopFiles(path)
        latch_fd, latch = _memory("sioms-latch", LATCH_SIZE)
        markers_fd, markers = _memory("sioms-markers", TABLE_SIZE)
        self.fds = [latch_fd, self.files.fd, self.files.taken_fd, markers_fd, record.drivers_fd]
        self.latch = Latch(latch)
        self.request = StopRequest(self.files.fd, self.files.taken_fd)
        record.inode = self.request.inode
        self.latch.begin(record.state.resets, self.request.mark)
        self.markers = MarkerTable(markers)
        self._note(file_entry(self.request.mark))
        self.files.show()
        if before is not None and before.mark not in self.left:  # somebody has found the old one meanwhile
            self._settle(before)

    def _settle(self, before: StopRequest | None) -> None:
        """Note what has been asked for by the file that the daemon before has left, and no reset has answered; where it
        is lost, as by a boot, what drivers have noted of it.
        """
        state = self.record.state
        if before is None:
            source = state.requested_by if state.requested else ""
        else:
            self.left.append(mark := before.mark)
            source = before.source if mark not in state.answered else ""
            if source and not any(changed_ns for _, changed_ns in state.answered):
                source = f"{UNKNOWN}; its last writer: {source if mark[0] else 'nobody'}"
        if source and not state.workcell:
            self._note(workcell_entry(source, stop=True, named=True))

    def _note(self, entry: dict[str, Any]) -> None:
        with suppress(OSError):  # it holds for our life then
            self.record.note(entry)


def _memory(name: str, size: int) -> tuple[int, memoryview]:
    fd = os.memfd_create(name, os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
    os.ftruncate(fd, size)
    fcntl.fcntl(fd, fcntl.F_ADD_SEALS, _SEALS)
    return fd, memoryview(mmap.mmap(fd, size))
