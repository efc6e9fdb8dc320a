"""A process that hears of deaths as a driver does, and does nothing else: what the machine itself takes for that."""

from __future__ import annotations

import contextlib
import errno
import json
import os
import select
import time
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

from sioms.check.daemon import Daemon

TICK_S = 0.001


class Seen(NamedTuple):
    """What an observer has seen.

    Attributes:
        ended_ns: when it heard of the end of each process [CLOCK_MONOTONIC].
        late_ns: how late it woke at most of waits for TICK_S, since it began to watch.
        unlike: why it was not in the scheduling class that it was to have; '': it was.
    """

    ended_ns: Mapping[int, int]
    late_ns: int
    unlike: str = ""


class Observer:
    """An observer; it ends with the daemon.

    Args:
        daemon: whose bench it belongs to.
    """

    def __init__(self, daemon: Daemon) -> None:
        asks, self._ask = os.pipe()
        self._answer, answers = os.pipe()
        daemon.fork(lambda: _observe(asks, answers))
        os.close(asks)
        os.close(answers)

    def close(self) -> None:
        """Let go of it."""
        os.close(self._ask)
        os.close(self._answer)

    def watch(self, pids: Iterable[int], like: int) -> None:
        """Watch processes from now on, in the scheduling class of another one."""
        self._told([list(pids), like])

    def seen(self) -> Seen:
        """Return what it has seen, and watch no more."""
        ended, late_ns, unlike = self._told(None)
        return Seen({int(pid): ns for pid, ns in ended.items()}, late_ns, unlike)

    def _told(self, what: object) -> Any:
        os.write(self._ask, json.dumps(what).encode() + b"\n")
        text = b""
        while not text.endswith(b"\n"):
            more = os.read(self._answer, 1 << 16)
            if not more:
                raise OSError(errno.EPIPE, "watch deaths: the observer has ended")
            text += more
        return json.loads(text)


def _observe(asks: int, answers: int) -> None:
    while asked := _line(asks):
        pids, like = json.loads(asked)
        unlike = _be_like(like)
        ended, late_ns = _watch(pids, asks, answers)
        _line(asks)
        os.write(answers, json.dumps([ended, late_ns, unlike]).encode() + b"\n")


def _line(fd: int) -> bytes:
    text = b""
    while not text.endswith(b"\n"):
        more = os.read(fd, 1 << 16)
        if not more:
            return b""
        text += more
    return text


def _be_like(pid: int) -> str:
    """Take the scheduling class of a process; return why that failed, '' when it did not."""
    try:
        policy = os.sched_getscheduler(pid) & ~os.SCHED_RESET_ON_FORK
        os.sched_setscheduler(0, policy, os.sched_getparam(pid))
        os.setpriority(os.PRIO_PROCESS, 0, os.getpriority(os.PRIO_PROCESS, pid))
    except OSError as error:  # it has ended, or we may not
        return f"take the scheduling class of process {pid}: {(error.strerror or str(error)).lower()}"
    return ""


def _watch(pids: list[int], asks: int, answers: int) -> tuple[dict[int, int], int]:
    poller = select.epoll()
    poller.register(asks, select.EPOLLIN)
    of: dict[int, int] = {}
    for pid in pids:
        with contextlib.suppress(ProcessLookupError):  # it has ended by itself
            of[os.pidfd_open(pid)] = pid
    for fd in of:
        poller.register(fd, select.EPOLLIN)
    ended: dict[int, int] = {}
    late_ns = 0
    os.write(answers, b"[]\n")
    due_ns = time.monotonic_ns()
    while True:
        due_ns += int(TICK_S * 1e9)
        found = [fd for fd, _ in poller.poll(TICK_S)]
        now_ns = time.monotonic_ns()
        if not found:
            late_ns = max(late_ns, now_ns - due_ns)
        for fd in found:
            if fd != asks:
                ended[of[fd]] = now_ns
                poller.unregister(fd)
        due_ns = now_ns
        if asks in found:
            break
    for fd in of:
        os.close(fd)
    poller.close()
    return ended, late_ns
