"""The processes that use files of the mount: who they are, whether they can act, and acting with their rights.

The kernel tells user, group and thread of each call. What a process has beside that, its groups and whether it is
stopped, is in /proc, where its number and the time of its start together name it for good.
"""

from __future__ import annotations

import ctypes
import errno
import os
import platform
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

from sioms.protocol.text import printable

_SYSCALLS = {"x86_64": (117, 119, 116), "aarch64": (147, 149, 159), "riscv64": (147, 149, 159)}
"""Numbers of setresuid, setresgid and setgroups: those of libc change all threads of a process, these one."""
_STOPS = sum(1 << (n - 1) for n in (signal.SIGSTOP, signal.SIGTSTP, signal.SIGTTIN, signal.SIGTTOU))
_STOPPED, _GONE = b"Tt", b"ZX"
_libc = ctypes.CDLL(None, use_errno=True)


@dataclass(frozen=True, slots=True)
class Process:
    """A process.

    Attributes:
        pid: its number; 0: it is in another process namespace.
        started: when, in ticks of the kernel: numbers are used again.
    """

    pid: int
    started: int

    @property
    def state(self) -> str:
        """How it is: "runs", "stopped" or "gone"."""
        found = _stat(self.pid)
        if found is None or found[1] != self.started or found[0] in _GONE:
            return "gone"
        return "stopped" if found[0] in _STOPPED else "runs"


@dataclass(frozen=True, slots=True)
class Caller:
    """Who calls.

    Attributes:
        uid, gid: of the calling thread, as the kernel vouches for them.
        groups: further groups of its process.
        process: that.
        name: of the process, for messages.
    """

    uid: int
    gid: int
    groups: tuple[int, ...]
    process: Process
    name: str = field(compare=False)

    def __str__(self) -> str:
        return f"{self.name}[{self.process.pid}]"


def caller(uid: int, gid: int, tid: int) -> Caller:
    """Return who a thread is that calls.

    Raises:
        OSError: EPERM, it cannot be looked at, or is another's by now.
    """
    told = _status(tid)
    pid = int(told.get("Tgid", "0"))
    found = _stat(pid)
    uids = told.get("Uid", "").split()
    if found is None or str(uid) not in uids:
        raise OSError(errno.EPERM, f"process {tid} cannot be looked at; the mount must see the processes that use it")
    groups = tuple(sorted(int(word) for word in told.get("Groups", "").split()))
    return Caller(uid, gid, groups, Process(pid, found[1]), printable(told.get("Name", "?"), 32))


def is_being_stopped(tid: int) -> bool:
    """Tell whether a thread is stopped, or is about to be as soon as its call returns."""
    told = _status(tid)
    pending = int(told.get("SigPnd", "0"), 16) | int(told.get("ShdPnd", "0"), 16)
    return bool(pending & _STOPS) or told.get("State", " ")[0].encode() in _STOPPED


@contextmanager
def acting_as(who: Caller) -> Iterator[None]:
    """Have the calling thread, and it alone, act with somebody's rights: what it opens or connects to is his.

    Raises:
        OSError: EPERM, this process is not root, and he is another user.
    """
    if who.uid == os.geteuid():
        yield
        return
    if os.geteuid() != 0 or platform.machine() not in _SYSCALLS:
        raise OSError(
            errno.EPERM,
            f"act for user {who.uid}: the mount runs as user {os.geteuid()}; mount as root for several users",
        )
    mine = os.getgroups()
    try:
        _become(who.uid, who.gid, who.groups)
        yield
    finally:
        try:
            _become(0, os.getgid(), mine)
        except OSError:
            os._exit(70)  # a thread that has another's rights for good serves nobody


def _become(uid: int, gid: int, groups: tuple[int, ...] | list[int]) -> None:
    set_uid, set_gid, set_groups = _SYSCALLS[platform.machine()]
    if uid == 0:
        _call(set_uid, -1, 0, -1)
    listed = (ctypes.c_uint32 * len(groups))(*groups)
    _call(set_groups, len(groups), listed)
    _call(set_gid, -1, gid, -1)
    if uid:
        _call(set_uid, -1, uid, -1)


def _call(number: int, *arguments: object) -> None:
    words = [ctypes.c_long(each) if isinstance(each, int) else each for each in arguments]
    if _libc.syscall(ctypes.c_long(number), *words):
        code = ctypes.get_errno()
        raise OSError(code, f"take over rights: {os.strerror(code).lower()}")


def _stat(pid: int) -> tuple[bytes, int] | None:
    """Return state and start of a process."""
    try:
        with open(f"/proc/{pid}/stat", "rb") as file:
            words = file.read(1024).rpartition(b") ")[2].split()
        return words[0], int(words[19])
    except (OSError, IndexError, ValueError):
        return None


def _status(tid: int) -> dict[str, str]:
    try:
        with open(f"/proc/{tid}/status", encoding="utf-8", errors="replace") as file:
            return {name: value.strip() for name, _, value in (line.partition(":") for line in file)}
    except OSError:
        return {}
