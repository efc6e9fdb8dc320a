"""The stop-request file and the one beside it: made by the daemon, writable for who may stop.

Who may stop is decided by grants, which name users and groups; so the file has an access list. Where the file system
keeps none, only the daemon's owner and root can stop without the daemon, and the log says so.
"""

from __future__ import annotations

import os
import stat
from collections.abc import Iterable
from contextlib import suppress
from struct import Struct

from sioms.protocol.stopfile import REQUEST, TAKEN, StopRequest

from .rights import Entitled

_ENTRY = Struct("<HHI")
_USER_OBJ, _USER, _GROUP_OBJ, _GROUP, _MASK, _OTHER = 0x01, 0x02, 0x04, 0x08, 0x10, 0x20
_WRITE, _READ_WRITE, _NOBODY = 2, 6, 0xFFFFFFFF
_ACL = "system.posix_acl_access"
_NEW = ".new"
"""End of the name of a file that is to take the place of another."""


class StopFiles:
    """The two files of a daemon, which nobody finds before ``show``.

    Args:
        path: of the daemon's socket.

    Raises:
        OSError: they cannot be made.

    Attributes:
        fd: of the request file, for the daemon and the drivers.
        taken_fd: of the file that says which request has been taken, for the same.
        client_fds: the two for clients that may stop: to write the one, to read the other.
    """

    def __init__(self, path: str) -> None:
        self._path = path
        self.fd = self._make(REQUEST, 0o600)
        self.taken_fd = self._make(TAKEN, 0o644)
        self.client_fds = [
            os.open(path + REQUEST + _NEW, os.O_WRONLY | os.O_CLOEXEC),
            os.open(path + TAKEN + _NEW, os.O_RDONLY | os.O_CLOEXEC),
        ]

    def show(self) -> None:
        """Have them take the place of those of the daemon before."""
        for end in (TAKEN, REQUEST):  # who finds the second finds both
            os.rename(self._path + end + _NEW, self._path + end)

    def _make(self, end: str, mode: int) -> int:
        path = self._path + end + _NEW
        with suppress(FileNotFoundError):
            os.unlink(path)
        fd = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600)
        os.fchmod(fd, mode)
        os.pwrite(fd, bytes(256), 0)
        return fd

    def entitle(self, who: Entitled) -> str:
        """Let those write who may stop; return why some of them cannot, '' when all can.

        Everybody means who can connect: the file then has the group and the mode of the socket. It does not
        change the time of the last write, which would be a stop.
        """
        with suppress(OSError):
            os.removexattr(self.fd, _ACL)
        if who.everybody:
            socket = os.stat(self._path)
            os.fchmod(self.fd, 0o600 | stat.S_IMODE(socket.st_mode) & 0o022)
            if socket.st_gid != os.fstat(self.fd).st_gid:
                os.fchown(self.fd, -1, socket.st_gid)
            return ""
        os.fchmod(self.fd, 0o600)
        if not who.uids and not who.gids:
            return ""
        try:
            os.setxattr(self.fd, _ACL, access_list(who.uids, who.gids))
        except OSError as error:
            return (
                f"give {self._path}{REQUEST} an access list: {error.strerror}; only root and the daemon's owner can "
                "stop while it hangs"
            )
        return ""

    def remove(self) -> None:
        """Take the files away; what is open stays."""
        for end in (REQUEST, TAKEN):
            with suppress(FileNotFoundError):
                os.unlink(self._path + end)


def left(path: str) -> StopRequest | None:
    """Return the stop-request file that another daemon has left; None: there is none."""
    try:
        fd = os.open(path + REQUEST, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    except FileNotFoundError:
        return None
    request, about = StopRequest(fd, -1), os.fstat(fd)
    return request if stat.S_ISREG(about.st_mode) and about.st_uid == os.getuid() else None


def access_list(uids: Iterable[int], gids: Iterable[int]) -> bytes:
    """Return an access list as acl(5) keeps it: the owner reads and writes, these users and groups write."""
    entries = [
        (_USER_OBJ, _READ_WRITE, _NOBODY),
        *[(_USER, _WRITE, uid) for uid in sorted(uids)],
        (_GROUP_OBJ, 0, _NOBODY),
        *[(_GROUP, _WRITE, gid) for gid in sorted(gids)],
        (_MASK, _WRITE, _NOBODY),
        (_OTHER, 0, _NOBODY),
    ]
    return b"".join([(2).to_bytes(4, "little"), *[_ENTRY.pack(*entry) for entry in entries]])
