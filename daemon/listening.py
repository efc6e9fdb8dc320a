"""The listening socket of a daemon: one daemon each, in a folder where nobody else can put another, there only when it
answers.
"""

from __future__ import annotations

import errno
import fcntl
import grp
import os
import pwd
import socket
import stat
from contextlib import suppress
from pathlib import Path

from sioms.protocol.socketpath import own_path


class Listening:
    """A socket that clients can connect to, and the lock that keeps other daemons away from it.

    The lock is taken before anything else is done for the path, so of several daemons that start together one goes on;
    it is the kernel's, and ends with the process.

    Args:
        path: where clients connect.
        mode: permissions of the socket.
        group: whose it is, '' for the daemon's own.

    Raises:
        OSError: another daemon serves there, or the socket cannot be made, with a sentence; of a path that somebody has
            chosen the folder must be there.

    Attributes:
        sock: the socket, listening.
        path: as given.
    """

    def __init__(self, path: str, mode: int, group: str) -> None:
        self.path = path
        folder = os.path.dirname(path) or "."
        if path == own_path():
            os.makedirs(folder, mode=0o755, exist_ok=True)
        elif not os.path.isdir(folder):
            raise OSError(errno.ENOENT, f"{path}: the folder {folder} does not exist; create it or choose another path")
        _check_folder(folder)
        self._lock = _lock(path + ".lock", path)
        try:
            self.sock = self._bind(folder, mode, group)
        except BaseException:
            self._unlock()
            raise

    def _bind(self, folder: str, mode: int, group: str) -> socket.socket:
        with suppress(FileNotFoundError):
            if not stat.S_ISSOCK(os.lstat(self.path).st_mode):
                raise OSError(errno.EEXIST, f"{self.path} exists and is not a socket; remove it or choose another path")
        _refuse_answering(self.path)
        sock = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        # Under another name until it listens; by way of the folder's descriptor, as the path may be as long as fits.
        folder_fd = os.open(folder, os.O_PATH | os.O_DIRECTORY | os.O_CLOEXEC)
        made = f"/proc/self/fd/{folder_fd}/.sioms-{os.getpid()}"
        mask = os.umask(0o777 & ~mode)
        try:
            with suppress(FileNotFoundError):
                os.unlink(made)
            sock.bind(made)
            if group:
                _give(made, group)
            sock.listen(128)
            os.rename(made, self.path)
        except OSError as error:
            sock.close()
            with suppress(OSError):
                os.unlink(made)
            raise OSError(error.errno, f"{self.path}: {error.strerror}") from None
        finally:
            os.umask(mask)
            os.close(folder_fd)
        return sock

    def close(self) -> None:
        """Take the socket away, then give the lock back."""
        with suppress(FileNotFoundError):
            os.unlink(self.path)
        self.sock.close()
        self._unlock()

    def _unlock(self) -> None:
        with suppress(FileNotFoundError):
            os.unlink(self.path + ".lock")  # who has opened it finds another one when it has the lock, and tries again
        os.close(self._lock)


def _check_folder(folder: str) -> None:
    """Refuse a folder in which somebody else can replace the socket, or replace the folder itself."""
    place = Path(folder).resolve()
    for one in (place, *place.parents):
        about = os.stat(one)
        owner_is_trusted = about.st_uid in (0, os.getuid())
        if owner_is_trusted and not _others_may_write(about):
            continue
        why = "others may write to it" if owner_is_trusted else f"it belongs to user {about.st_uid}"
        raise OSError(
            errno.EPERM,
            f"{one}: {why}, who could replace the socket in {folder}; want a folder that the daemon alone may write",
        )


def _others_may_write(about: os.stat_result) -> bool:
    if about.st_mode & stat.S_ISVTX:  # as /tmp, where nobody removes what is another's
        return False
    by_group = about.st_mode & stat.S_IWGRP and about.st_gid != 0 and not _is_private(about.st_gid)
    return bool(about.st_mode & stat.S_IWOTH or by_group)


def _is_private(gid: int) -> bool:
    """Tell whether a group has this user alone, as where each user's files have a group of their own."""
    with suppress(KeyError):
        them = {entry.pw_uid for entry in pwd.getpwall() if entry.pw_gid == gid}
        them.update(pwd.getpwnam(name).pw_uid for name in grp.getgrgid(gid).gr_mem)
        return them <= {os.getuid()}
    return False


def _lock(path: str, served: str) -> int:
    """Return the descriptor of a lock file that this process holds."""
    while True:
        try:
            fd = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600)
        except OSError as error:
            raise OSError(error.errno, f"{path}: {error.strerror}") from None
        try:
            fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            holder = os.pread(fd, 20, 0).decode("ascii", "replace").strip() or "unknown"
            os.close(fd)
            raise OSError(
                errno.EADDRINUSE,
                f"another daemon (pid {holder}) serves {served}; stop it or choose another path",
            ) from None
        with suppress(FileNotFoundError):
            if os.path.samestat(os.fstat(fd), os.stat(path)):
                os.ftruncate(fd, 0)
                os.pwrite(fd, f"{os.getpid()}\n".encode(), 0)
                return fd
        os.close(fd)  # its holder has just ended and taken it away


def _refuse_answering(path: str) -> None:
    """Refuse a socket on which somebody answers who knows nothing of the lock."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as probe:
        if probe.connect_ex(path) == 0:
            raise OSError(errno.EADDRINUSE, f"another daemon answers at {path}; stop it or choose another path")


def _give(path: str, group: str) -> None:
    try:
        os.chown(path, -1, grp.getgrnam(group).gr_gid)
    except (KeyError, OSError) as error:
        raise OSError(errno.EPERM, f"give it to group {group}: {error}") from None
