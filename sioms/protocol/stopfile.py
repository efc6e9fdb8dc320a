"""The stop-request file: how a stop reaches the drivers when the daemon does not answer.

Two files beside the daemon's socket:

* ``SOCKET.stop`` may be written by everybody who may stop, and by drivers, and by nobody else (its owner, group, mode
  and access list say who). Every write to it is a request to stop the workcell, until a reset answers it; nothing that
  is written there clears anything.
* ``SOCKET.stopped`` is written by drivers and daemon: which request they have taken.

Drivers look at the first in every tick. Its word and the time of its last change count together, as its mark: who
writes the old word again cannot take a request back. The file is read and not mapped, because a mapped file that
shrinks ends everybody who has mapped it.
"""

from __future__ import annotations

import os
from stat import S_ISREG
from struct import Struct

from .socketpath import may_serve
from .text import printable

TYPE_CHECKING = False
if TYPE_CHECKING:
    from typing import TypeAlias

    Mark: TypeAlias = tuple[int, int]

REQUEST, TAKEN = ".stop", ".stopped"
_REQUEST = Struct("<QQ240s")
_MARK = Struct("<QQ")
SOMEBODY = "somebody, through the stop-request page"
"""The source of a request that cannot be told yet; whoever asked will tell the daemon, too."""
_LOOKS = 20
"""At a request that is just being written, whose time of change is there before its text."""


class StopRequest:
    """A descriptor of the stop-request file.

    Args:
        fd: of ``SOCKET.stop``; who requests may write it, who obeys may read it.
        taken_fd: of ``SOCKET.stopped``.

    Concurrency: each call is one system call or two; any number of processes.
    """

    def __init__(self, fd: int, taken_fd: int) -> None:
        self._fd = fd
        self._taken_fd = taken_fd
        self._mark: Mark = (0, 0)
        self._word_before = 0

    @property
    def mark(self) -> Mark:
        """The present word and the time of the last change [ns, wall clock]; a change of either is a request."""
        mark = int.from_bytes(os.pread(self._fd, 8, 0), "little"), os.fstat(self._fd).st_mtime_ns
        if mark != self._mark:
            self._word_before, self._mark = self._mark[0], mark
        return mark

    @property
    def inode(self) -> int:
        """The number of the file, which no other has as long as this one is open."""
        return os.fstat(self._fd).st_ino

    @property
    def source(self) -> str:
        """Who requested last and why, as far as it said.

        The name of the one before is never told for it: where the word is still that of before the change that ``mark``
        has seen, it is not known who wrote.
        """
        for _ in range(_LOOKS):
            data = os.pread(self._fd, _REQUEST.size, 0).ljust(_REQUEST.size, b"\0")
            word, pid, why = _REQUEST.unpack(data)
            if word != self._word_before:
                text = printable(why.split(b"\0")[0].decode("utf-8", "replace"))
                if not pid and text:
                    return text  # a driver's
                return f"pid {pid}{': ' + text if text else ''}, through the stop-request page"
            os.sched_yield()
        return SOMEBODY

    @property
    def pid(self) -> int:
        """The process that requested last, as far as it said."""
        return int.from_bytes(os.pread(self._fd, 8, 8), "little")

    def request(self, now_ns: int, pid: int, why: str = "") -> Mark:
        """Request a stop of the workcell; return its mark, or its word with the time of a later one. Of pid 0 ``why``
        says all there is.
        """
        os.pwrite(self._fd, _REQUEST.pack(now_ns, pid, why.encode()[:239]), 0)
        return now_ns, os.fstat(self._fd).st_mtime_ns

    def take(self, mark: Mark) -> None:
        """Say that a request has been obeyed."""
        os.pwrite(self._taken_fd, _MARK.pack(*mark), 0)

    @property
    def obeyed(self) -> Mark:
        """Mark of the request of which somebody has said last that he has obeyed it."""
        word, changed_ns = _MARK.unpack(os.pread(self._taken_fd, _MARK.size, 0).ljust(_MARK.size, b"\0"))
        return word, changed_ns

    def taken(self, mark: Mark) -> bool:
        """Tell whether a request, or one that was written later, has been obeyed. Anybody can write any word: a later
        one alone says nothing.
        """
        word, changed_ns = self.obeyed
        return word >= mark[0] and changed_ns >= mark[1]

    def close(self) -> None:
        """Close both descriptors."""
        fds, self._fd, self._taken_fd = (self._fd, self._taken_fd), -1, -1
        for fd in fds:
            if fd >= 0:
                os.close(fd)

    def __del__(self) -> None:
        self.close()


def open_stop_request(path: str) -> StopRequest | None:
    """Open the files beside a daemon's socket for requesting; None where there are none of a daemon or one has no right
    to.
    """
    try:
        fd = _open(path + REQUEST, os.O_WRONLY, path)
    except OSError:
        return None
    try:
        return StopRequest(fd, _open(path + TAKEN, os.O_RDONLY, path))
    except OSError:
        os.close(fd)
        return None


def _open(name: str, how: int, path: str) -> int:
    # Not to wait for whom a pipe of that name is for.
    fd = os.open(name, how | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK)
    about = os.fstat(fd)
    if not S_ISREG(about.st_mode) or not may_serve(about.st_uid, path):
        os.close(fd)
        raise PermissionError(name)
    return fd
