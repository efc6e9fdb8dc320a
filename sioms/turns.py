"""Turns: whose request is served next, so that no client's behaviour makes another's wait.

Clients are asked in the order of what their sources have used, one packet at a time. A source is a user, or what he
owns: whatever he sends over however many connections, another's next packet waits for at most one of his.
Concurrency: one thread, that of the process that serves.
"""

from __future__ import annotations

import os
import select
import time
from collections.abc import Callable, Hashable

Callback = Callable[[], object]

WINDOW_NS = 1_000_000
"""What a class of sources may use is counted in windows of this length: a neighbour on the processor waits no longer.
"""


class _Source:
    """The connections of one source.

    Attributes:
        fd: what the loop waits for: its one connection, or ``waiting``.
        waiting: epoll of several connections; the kernel passes them round.
        used_ns: virtual time up to which it has been served.
    """

    __slots__ = ("callbacks", "fd", "kind", "used_ns", "waiting")

    def __init__(self, kind: int) -> None:
        self.kind = kind
        self.fd = -1
        self.waiting: select.epoll | None = None
        self.callbacks: dict[int, Callback] = {}
        self.used_ns = 0


class Turns:
    """Serves connections in turn; the loop calls ``serve`` after everything that comes first.

    Args:
        epoll: that of the loop; an event of it that ``mark`` knows is a source with packets.
        shares: of every window, by the kind of source, in the order in which kinds come first.

    Attributes:
        gives_way: whether processes of the same real-time priority may run after every packet.
    """

    def __init__(self, epoll: select.epoll, shares: tuple[float, ...]) -> None:
        self.gives_way = False
        self._epoll = epoll
        self._budgets_ns = [int(share * WINDOW_NS) for share in shares]
        self._left_ns = list(self._budgets_ns)
        self._paused: list[_Source] = []
        self._window_ns = 0
        self._sources: dict[Hashable, _Source] = {}
        self._by_fd: dict[int, _Source] = {}
        self._of: dict[int, tuple[Hashable, _Source]] = {}
        self._ready: list[_Source] = []
        self._now_ns = 0
        """Virtual time: when the turn of the source that is served began."""

    def add(self, fd: int, source: Hashable, kind: int, callback: Callback) -> None:
        """Serve a connection; the callback takes one packet of it.

        Args:
            fd: descriptor of the connection.
            source: whose it is.
            kind: index of the source's share; 0 comes first.
            callback: called when there is a packet, or an end of file.
        """
        key = (source, kind)
        found = self._sources.get(key)
        if found is None:
            found = self._sources[key] = _Source(kind)
        found.callbacks[fd] = callback
        self._of[fd] = (key, found)
        if found.waiting is not None:
            found.waiting.register(fd, select.EPOLLIN)
            return
        if found.fd < 0:
            self._wait_for(found, fd)
            return
        found.waiting = select.epoll()
        for each in found.callbacks:
            found.waiting.register(each, select.EPOLLIN)
        self._wait_no_more(found)
        self._wait_for(found, found.waiting.fileno())

    def _wait_for(self, source: _Source, fd: int) -> None:
        source.fd = fd
        self._by_fd[fd] = source
        self._epoll.register(fd, 0 if source in self._paused else select.EPOLLIN)

    def _wait_no_more(self, source: _Source) -> None:
        self._epoll.unregister(source.fd)
        del self._by_fd[source.fd]

    def remove(self, fd: int) -> bool:
        """Serve a connection no more; call before closing it. Returns whether it was served."""
        key, source = self._of.pop(fd, (None, None))
        if source is None:
            return False
        del source.callbacks[fd]
        if source.waiting is not None:
            source.waiting.unregister(fd)
        if not source.callbacks:
            self._wait_no_more(source)
            del self._sources[key]
            self._ready = [other for other in self._ready if other is not source]
            self._paused = [other for other in self._paused if other is not source]
            if source.waiting is not None:
                source.waiting.close()
        return True

    def mark(self, fd: int) -> None:
        """Note an event of the loop's epoll: if it is of a source, that has packets."""
        source = self._by_fd.get(fd)
        if source is not None:
            self._ready.append(source)

    @property
    def pause_s(self) -> float | None:
        """How long the loop may wait before ``serve`` has to be called again [s]; None for ever: no source pauses, or
        none has to any more.
        """
        if not self._paused:
            return None
        now_ns = time.monotonic_ns()
        left_ns = self._window_ns + WINDOW_NS - now_ns
        if left_ns > 0:
            return left_ns * 1e-9
        self._open_window(now_ns)
        return None

    def serve(self) -> None:
        """Take one packet of the source whose turn it is; call after every wait of the loop."""
        ready = self._ready
        if not ready and not self._paused:
            return
        began_ns = time.monotonic_ns()
        if began_ns - self._window_ns >= WINDOW_NS:
            self._open_window(began_ns)
        if not ready:
            return
        source = ready[0] if len(ready) == 1 else min(ready, key=lambda s: (s.kind, s.used_ns))
        ready.clear()
        self._now_ns = max(source.used_ns, self._now_ns)
        if source.waiting is None:
            source.callbacks[source.fd]()
        else:
            for fd, _ in source.waiting.poll(0, 1):
                source.callbacks[fd]()
        self._use(source, time.monotonic_ns() - began_ns)
        if self.gives_way:
            os.sched_yield()

    def charge(self, fd: int, took_ns: int) -> None:
        """Count what has been served of a connection without its turn [ns]; one that is served no more has no count."""
        _, source = self._of.get(fd, (None, None))
        if source is None:
            return
        began_ns = time.monotonic_ns()
        if began_ns - self._window_ns >= WINDOW_NS:
            self._open_window(began_ns)
        self._now_ns = max(source.used_ns, self._now_ns)
        self._use(source, took_ns)

    def _use(self, source: _Source, took_ns: int) -> None:
        # Beyond a window, others of this processor have had it meanwhile.
        took_ns = min(took_ns, WINDOW_NS)
        source.used_ns = self._now_ns + took_ns
        self._left_ns[source.kind] -= took_ns
        if self._left_ns[source.kind] <= 0:
            for other in self._sources.values():
                if other.kind == source.kind and other not in self._paused:
                    self._paused.append(other)
                    self._epoll.modify(other.fd, 0)

    def _open_window(self, now_ns: int) -> None:
        self._window_ns = now_ns
        self._left_ns[:] = self._budgets_ns
        for source in self._paused:
            self._epoll.modify(source.fd, select.EPOLLIN)
        self._paused.clear()
