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


class StopFiles:
    """The two files of a daemon.

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
        self.remove()
        self.fd = self._make(path + REQUEST, 0o600)
        self.taken_fd = self._make(path + TAKEN, 0o644)
        self.client_fds = [
            os.open(path + REQUEST, os.O_WRONLY | os.O_CLOEXEC),
            os.open(path + TAKEN, os.O_RDONLY | os.O_CLOEXEC),
        ]

    @staticmethod
    def _make(path: str, mode: int) -> int:
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


def left(path: str) -> tuple[int, str]:
    """Return the word of the last stop that was asked for by files which another daemon has left, 0: there is none; and
    who asked, if nobody has said that he has obeyed it, else ''.
    """
    fds: list[int] = []
    try:
        for end in (REQUEST, TAKEN):
            fds.append(os.open(path + end, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC))
            about = os.fstat(fds[-1])
            if not stat.S_ISREG(about.st_mode) or about.st_uid != os.getuid():
                return 0, ""
        request = StopRequest(fds[0], os.dup(fds[1]))
        fds.pop(0)
        word = request.mark[0]
        # Of a later word nobody has said so either: that may be of before a restart of the machine.
        return word, request.source if word not in (0, request.obeyed) else ""
    except FileNotFoundError:
        return 0, ""
    finally:
        for fd in fds:
            os.close(fd)


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
