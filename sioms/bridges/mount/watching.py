"""The threads beside the calls: leases are renewed for who can still act, and who polls is woken."""

from __future__ import annotations

import ctypes
import select
import threading
import time
from collections.abc import Callable, Iterable
from contextlib import suppress
from typing import Any

from .opened import NodeFile

LOOK_S = 0.05
"""How often files are looked at whose driver may hang, so that it wakes nobody [s]."""


class Keeper:
    """Renews the leases of outputs whose users are there and not stopped.

    Args:
        files: that are open.
        lease_s: of outputs [s].
    """

    def __init__(self, files: Callable[[], Iterable[NodeFile]], lease_s: float) -> None:
        self._files, self._every_s = files, lease_s / 5
        threading.Thread(target=self._run, name="leases", daemon=True).start()

    def _run(self) -> None:
        while True:
            time.sleep(self._every_s)
            self.beat()

    def beat(self) -> None:
        """Renew all; a file for which that fails ends, and the others are renewed."""
        for file in self._files():
            if not file.is_output:
                continue
            try:
                file.beat()
            except Exception as error:  # a mistake of ours halts this one, not everybody's
                file.end(f"its lease could not be renewed: {error!r}")


class Notifier:
    """Wakes who polls a file, when something has been published; the kernel then asks again what holds.

    Args:
        fuse: the library.
    """

    def __init__(self, fuse: Any) -> None:
        self._fuse = fuse
        fuse.fuse_notify_poll.argtypes = fuse.fuse_pollhandle_destroy.argtypes = [ctypes.c_void_p]
        self._waiting: dict[int, tuple[NodeFile, int]] = {}
        self._lock = threading.Lock()
        self._epoll = select.epoll()
        threading.Thread(target=self._run, name="poll", daemon=True).start()

    def want(self, file: NodeFile, handle: int) -> None:
        """Wake a caller with the next publication; the one before him on this file is let go."""
        fd = file.wake_fd()
        with self._lock:
            before = self._waiting.get(fd)
            self._waiting[fd] = file, handle
            if before is not None:
                self._fuse.fuse_pollhandle_destroy(before[1])
            how = select.EPOLLIN | select.EPOLLONESHOT
            try:
                self._epoll.modify(fd, how)
            except FileNotFoundError:
                self._epoll.register(fd, how)

    def forget(self, file: NodeFile) -> None:
        """Let go of a file that is closed."""
        with self._lock:
            for fd, (waiting, handle) in list(self._waiting.items()):
                if waiting is file:
                    del self._waiting[fd]
                    self._fuse.fuse_pollhandle_destroy(handle)
                    with suppress(OSError, ValueError):
                        self._epoll.unregister(fd)

    def _run(self) -> None:
        while True:
            ready = {fd for fd, _ in self._epoll.poll(LOOK_S)}
            with self._lock:
                if not ready:
                    ready = {fd for fd, (file, _) in self._waiting.items() if file.events()}
                for fd in ready & self._waiting.keys():
                    file, handle = self._waiting.pop(fd)
                    file.drain()
                    self._fuse.fuse_notify_poll(handle)
                    self._fuse.fuse_pollhandle_destroy(handle)
