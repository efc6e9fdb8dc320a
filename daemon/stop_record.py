"""What is stopped, as the daemon keeps it over its own end, that of drivers, and a restart of the machine.

Why so: docs/decisions/0140-a-stop-outlives-everything.md.

Concurrency: the daemon's loop; a thread of its own waits for the disk, so that nobody else does.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import stat
import threading
import time
from collections.abc import Callable, Mapping
from typing import Any

from sioms.part_times import PartTimes
from sioms.protocol.stopjournal import CHECKPOINT, INODE, PID, StopJournal, Stopped, asked_ns, entries_from, replay
from sioms.protocol.text import printable

from .realtime import end_promptly

TYPE_CHECKING = False
if TYPE_CHECKING:
    from sioms.protocol.stopjournal import Part

MOST_BYTES = 1 << 18
"""From so many bytes after the last checkpoint on, there is a new one, and what lies before it is freed."""
LARGEST = 1 << 26
"""Bytes of the file that are read at the start: a longer one was not written by us, and counts as damaged."""
_KEEP_SIZE, _PUNCH_HOLE, _BLOCK = 0x01, 0x02 | 0x01, 4096


class StopRecord:
    """The journal of stops of a workcell.

    Args:
        path: of the file; its folder is made.

    Raises:
        OSError: it cannot be kept there, or another daemon does.

    Attributes:
        state: what is stopped, after the last ``look``.
        drivers_fd: descriptor for drivers, to append to.
        inode: of the stop-request file of this daemon, 0 before it is made.
        by_drivers: entries of drivers that have been read, the oldest first; who has seen to them takes them out.
        elsewhere: who has asked, by the file of a daemon before, for a stop that a driver of that has obeyed since this
            daemon began; as these.
        asked: when stops have been asked for since this daemon began; of one by an alarm, when it could be known.
    """

    def __init__(self, path: str) -> None:
        self.path = path
        os.makedirs(os.path.dirname(path) or ".", mode=0o750, exist_ok=True)
        flags = os.O_RDWR | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW
        self._fd = os.open(path, flags | os.O_NONBLOCK, 0o600)
        if not stat.S_ISREG(os.fstat(self._fd).st_mode):
            os.close(self._fd)
            raise OSError(errno.EINVAL, "it is not a regular file")
        try:
            fcntl.flock(self._fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(self._fd)
            raise OSError(errno.EBUSY, "another daemon keeps its stops there") from None
        self.drivers_fd = os.open(path, flags, 0o600)  # without the lock: drivers may outlive the daemon
        self._journal = StopJournal(self._fd)
        size = os.fstat(self._fd).st_size
        start = max(_first_byte(self._fd, size), size - LARGEST)
        self.state: Stopped = replay(_read(self._fd, start, size), start, time.time())
        self.inode = 0
        self.by_drivers: list[Mapping[str, Any]] = []
        self.elsewhere: list[str] = []
        self.asked = PartTimes()
        self._unshown: list[tuple[Part, int]] = []
        self._at = size
        self._checked_at = start
        self._flusher = _Flusher(self._fd)
        try:
            self._check()  # whatever was damaged is not read again, and told by the state
        except OSError:
            os.close(self.drivers_fd)
            os.close(self._fd)
            raise

    def look(self) -> None:
        """Take into account what drivers have noted."""
        if self._take() and self._at - self._checked_at > MOST_BYTES:
            with contextlib.suppress(OSError):  # the next entry tells
                self._check()

    def _take(self) -> bool:
        """Read what has been appended; return whether there was anything."""
        size = os.fstat(self._fd).st_size
        if size == self._at:
            return False
        if size < self._at:
            self.state.take(None, "it has been truncated", time.time())
            self._at = size
        entries, read = entries_from(_read(self._fd, self._at, size))
        self._at += read
        for entry in entries:
            requested = self.state.requested
            self.state.take(entry, now_s=time.time())
            if entry and entry.get(INODE, self.inode) != self.inode and self.state.requested is not requested:
                self.elsewhere.append(printable(str(entry["by"]), 400))
            if entry and PID in entry:
                self.by_drivers.append(entry)
                at_ns, now_ns = asked_ns(entry), time.monotonic_ns()
                for part in self.state.still(entry):
                    if at_ns > now_ns:
                        self._unshown.append((part, at_ns))
                    else:
                        self.asked.note(part[:2], [part[2:]], at_ns)
        if read:
            self._flusher.flush()
        return True

    def shown(self, at_ns: int, device: str = "") -> None:
        """Take into account since when the stops of a device ('': of any) that have been noted can be known of."""
        self.look()
        self._settle(lambda part, latest_ns: min(at_ns, latest_ns) if device in ("", part[0]) else 0)

    def unshown(self) -> list[Part]:
        """Return what is stopped by alarms since so short a time that nobody can know of it."""
        now_ns = time.monotonic_ns()
        self._settle(lambda _, latest_ns: latest_ns if latest_ns <= now_ns else 0)
        return [part for part, _ in self._unshown]

    def _settle(self, since_ns: Callable[[Part, int], int]) -> None:
        """Note for parts that can be known of by now since when, which is told of each; 0: not yet."""
        unshown, self._unshown = self._unshown, []
        for part, latest_ns in unshown:
            if at_ns := since_ns(part, latest_ns):
                self.asked.note(part[:2], [part[2:]], at_ns)
            else:
                self._unshown.append((part, latest_ns))

    def note(self, entry: Mapping[str, Any]) -> None:
        """Note a stop or a reset.

        Raises:
            OSError: it cannot be written, and holds for the daemon's life only; after it the workcell is stopped.
        """
        now_s = time.time()
        self.look()
        try:
            self._journal.append(entry, now_s)
        except OSError:
            self._at = os.fstat(self._fd).st_size
            self.state.take({"at": now_s, **entry}, now_s=now_s)
            raise
        self.look()

    def close(self) -> None:
        """Close the file, and take it away when nothing is stopped."""
        self.look()  # drivers may have noted something at their end
        self._flusher.end()
        if not (self.state.workcell or self.state.requested or self.state.parts):
            os.unlink(self.path)
        os.close(self.drivers_fd)
        self._journal.close()

    def _check(self) -> None:
        """Append a checkpoint, and free what is not needed any more."""
        at = self._at
        self._journal.append({CHECKPOINT: self.state.entries(), "from": at}, time.time())
        self._flusher.flush(at)
        self._take()
        self._checked_at = self._at  # behind the checkpoint, however long that is


class _Flusher:
    """Sees that the file reaches the disk, has room for what comes next, and frees its beginning; all of it may take
    long.
    """

    def __init__(self, fd: int) -> None:
        self._fd = fd
        self._wanted = threading.Event()
        self._free_to = 0
        self._ends = False
        self._thread: threading.Thread | None = None

    def flush(self, free_to: int = 0) -> None:
        """Have what has been written reach the disk, and then free the file up to a place."""
        self._free_to = max(self._free_to, free_to)
        if self._thread is None:
            thread = threading.Thread(target=self._run, daemon=True, name="stops")
            try:
                thread.start()
            except RuntimeError:  # no memory, or no more threads: the next entry tries again
                return
            self._thread = thread
        self._wanted.set()

    def end(self) -> None:
        """Finish what is wanted, and end."""
        self._ends = True
        if self._thread is not None:
            self._wanted.set()
            self._thread.join()

    def _run(self) -> None:
        end_promptly()
        freed, kept = 0, 0
        while not self._ends or self._wanted.is_set():
            self._wanted.wait()
            self._wanted.clear()
            free_to = self._free_to // _BLOCK * _BLOCK
            try:
                if free_to > freed or not kept:
                    kept = os.fstat(self._fd).st_size
                    _fallocate(self._fd, _KEEP_SIZE, kept, 2 * MOST_BYTES)
                os.fdatasync(self._fd)
                if free_to > freed:
                    _fallocate(self._fd, _PUNCH_HOLE, 0, free_to)
                    freed = free_to
            except OSError:
                continue  # a file system that cannot: the file is in memory all the same, and grows


def _fallocate(fd: int, mode: int, start: int, size: int) -> None:
    import ctypes

    ctypes.CDLL(None).fallocate(fd, mode, ctypes.c_int64(start), ctypes.c_int64(size))


def _first_byte(fd: int, size: int) -> int:
    """Return where the file begins that has not been freed."""
    try:
        return os.lseek(fd, 0, os.SEEK_DATA) if size else 0
    except OSError:
        return 0


def _read(fd: int, start: int, end: int) -> bytes:
    pieces = []
    while start < end and (piece := os.pread(fd, end - start, start)):
        pieces.append(piece)
        start += len(piece)
    return b"".join(pieces)
