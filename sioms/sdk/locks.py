"""Locks on devices: each has one driver on this machine, whatever daemons there are.

A serial port is locked in the three ways that other programs heed: flock(2), as pyserial and picocom do; TIOCEXCL, by
which the kernel refuses further opens to all but root; and a lock file of UUCP style in /run/lock, as minicom makes and
looks for. A device in the network is locked by its name, with a socket in the kernel's abstract namespace: it ends with
its process, however that ends, and tells who holds it. Lines of GPIO chips and buffers of IIO devices the kernel itself
gives to one only.

All of these could be taken by anybody who has an account. A lock counts when its holder could use the device: for a
serial port by the port's mode, for the network when it is root, a system user or oneself. Another one is told, not
obeyed.
"""

from __future__ import annotations

import errno
import fcntl
import grp
import os
import pwd
import socket
import struct
import termios
from collections.abc import Callable, Iterable
from contextlib import suppress
from typing import Any

from .settings import LineSettings

FOLDER = "/run/lock"
"""Of the lock files of serial ports."""
FIRST_PERSON = 1000
"""User numbers below belong to the system."""
_PTY = "/dev/pts/"


def claims_of(settings: Any) -> list[str]:
    """Return what the line of a device is, in words that are equal when two devices want the same.

    Units with an address of their own may share a network address, as behind a Modbus gateway; never a serial port,
    which one device has, with several units if need be.
    """
    line = getattr(settings, "line", None)
    if not isinstance(line, LineSettings) or line.path is not None:
        return []
    if line.serial is not None:
        return [f"serial port {os.path.realpath(line.serial)}"]
    name = f"TCP {line.tcp.lower()}" if line.tcp is not None else f"UDP {(line.udp or '').lower()}"
    units = [settings, *getattr(settings, "axis", [])]
    addresses = [unit.address for unit in units if isinstance(getattr(unit, "address", None), int)]
    return [f"{name} unit {address}" for address in addresses] or [name]


class NameLocks:
    """The locks of one driver on devices in the network, kept until its process ends.

    Args:
        names: of the devices.
        warn: takes a sentence about a lock of somebody whose lock does not count.
    """

    def __init__(self, names: Iterable[str], warn: Callable[[str], None]) -> None:
        self._missing = [name for name in names if name.startswith(("TCP ", "UDP "))]
        self._held: list[socket.socket] = []
        self._warn = warn

    def take(self) -> None:
        """Take what is not held yet.

        Raises:
            OSError: EBUSY, somebody else has one of them.
        """
        while self._missing:
            name = self._missing[0]
            sock = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
            try:
                sock.bind(f"\0sioms/{name}")
                sock.listen(128)
            except OSError as error:
                sock.close()
                if error.errno != errno.EADDRINUSE:
                    raise
                pid, uid = _holder(name)
                who = f"pid {pid} ({_program(pid)}, uid {uid})"
                if uid in (0, os.geteuid()) or 0 <= uid < FIRST_PERSON:
                    raise OSError(
                        errno.EBUSY, f"open {name}: {who} has it; one driver a device: end the other one"
                    ) from None
                self._warn(
                    f"{name}: {who} says that it has it, and may be right; only root and system users are obeyed"
                )
            else:
                self._held.append(sock)
            self._missing.pop(0)

    def release(self) -> None:
        """Give all of them up."""
        for sock in self._held:
            sock.close()
        self._held = []


def _holder(name: str) -> tuple[int, int]:
    """Return process and user behind a lock, -1 when they are not told: then it is none of ours."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM | socket.SOCK_NONBLOCK) as probe:
        try:
            probe.connect(f"\0sioms/{name}")
            pid, uid, _ = struct.unpack("3i", probe.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, 12))
        except OSError:
            return -1, -1
        return pid, uid


class PortLock:
    """The lock file of a serial port, and TIOCEXCL on it; ptys, which are no ports, have neither.

    Args:
        path: of the port.
        folder: of lock files.

    Raises:
        OSError: EBUSY, somebody who may use the port has it.
    """

    def __init__(self, path: str, folder: str = FOLDER) -> None:
        real = os.path.realpath(path)
        self._file = ""
        self._fd = -1
        self._is_pty = real.startswith(_PTY)
        if os.path.dirname(real) != "/dev":
            return
        file = f"{folder}/LCK..{os.path.basename(real)}"
        holder = _reads(file)
        if holder and holder[0] != os.getpid() and _may_use(real, holder[1]):
            pid = holder[0]
            raise OSError(
                errno.EBUSY,
                f"open {path}: in use by pid {pid} ({_program(pid)}), as {file} says; end that first",
            )
        if holder is None or holder[0] == os.getpid():
            self._make(file)

    def _make(self, file: str) -> None:
        own = f"{os.path.dirname(file)}/LTMP..{os.getpid()}"
        with suppress(OSError):  # a folder that we may not write to: the other locks are left
            with suppress(FileNotFoundError):
                os.unlink(file)  # of a process that has ended
            fd = os.open(own, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC, 0o644)
            try:
                os.write(fd, b"%10d\n" % os.getpid())
                os.link(own, file)
                self._file = file
            finally:
                os.close(fd)
                os.unlink(own)

    def exclude(self, fd: int) -> None:
        """Have the kernel refuse further opens of the port."""
        if not self._is_pty:  # it would last as long as the other end
            with suppress(OSError):
                fcntl.ioctl(fd, termios.TIOCEXCL)
                self._fd = fd

    def release(self) -> None:
        """Give the port up; call before it is closed."""
        if self._fd >= 0:
            with suppress(OSError):
                fcntl.ioctl(self._fd, termios.TIOCNXCL)
            self._fd = -1
        if self._file:
            with suppress(OSError):
                os.unlink(self._file)
            self._file = ""


def _reads(file: str) -> tuple[int, int] | None:
    """Return the living process that a lock file names, and the file's owner; None when there is none."""
    try:
        fd = os.open(file, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
        with open(fd, "rb") as opened:
            owner, pid = os.fstat(fd).st_uid, int(opened.read(32).split()[0])
    except (OSError, ValueError, IndexError):
        return None
    return (pid, owner) if os.path.exists(f"/proc/{pid}") else None


def _may_use(port: str, uid: int) -> bool:
    """Tell whether a user may open a port, by its owner, group and mode."""
    try:
        about = os.stat(port)
        if uid in (0, os.geteuid(), about.st_uid) or about.st_mode & 0o006 == 0o006:
            return True
        user = pwd.getpwuid(uid)
        return user.pw_gid == about.st_gid or user.pw_name in grp.getgrgid(about.st_gid).gr_mem
    except (OSError, KeyError):
        return False


def _program(pid: int) -> str:
    try:
        with open(f"/proc/{pid}/comm", encoding="utf-8", errors="replace") as file:
            return file.read().strip()
    except OSError:
        return "?"
