"""The journals of the daemon and of the driver processes: their memory, and what clients get of it."""

from __future__ import annotations

import fcntl
import mmap
import os

from sioms.protocol.journal import HEADER, JOURNAL_SIZE, JournalWriter

_SEALS = fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_GROW | fcntl.F_SEAL_SEAL


def journal_file(name: str) -> int:
    """Make the memory of a journal, which outlives the processes that write it; return its descriptor."""
    fd = os.memfd_create(name, os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
    os.fchmod(fd, 0o600)
    os.ftruncate(fd, HEADER + JOURNAL_SIZE)
    fcntl.fcntl(fd, fcntl.F_ADD_SEALS, _SEALS)
    with mmap.mmap(fd, HEADER + JOURNAL_SIZE) as mapping:  # a reader may come before the writer
        JournalWriter(memoryview(mapping)).release()
    return fd


def for_reading(fd: int) -> int:
    """Open a journal for a client, who cannot write in it."""
    return os.open(f"/proc/self/fd/{fd}", os.O_RDONLY | os.O_CLOEXEC)


class Leash:
    """Tells a client at once that its right to journals has ended: a pipe whose writing end is closed then.

    Attributes:
        read_fd: what clients get of it.
    """

    def __init__(self) -> None:
        self.read_fd, self._write_fd = os.pipe2(os.O_CLOEXEC | os.O_NONBLOCK)

    def cut(self) -> None:
        """Tell it."""
        os.close(self._write_fd)
        os.close(self.read_fd)


class OwnJournal:
    """The journal of the daemon itself."""

    def __init__(self) -> None:
        self.fd = journal_file("sioms:journal")
        self.note = JournalWriter(memoryview(mmap.mmap(self.fd, HEADER + JOURNAL_SIZE))).note
