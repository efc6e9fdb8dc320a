"""The loop around the sessions: transports bring frames of clients, the daemon and drivers bring packets.

Concurrency: one thread. Stops have others: ``stops``, ``zenoh``.
"""

from __future__ import annotations

import errno
import os
import select
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack, closing
from functools import partial

from sioms.client.keys import Folder
from sioms.client.wall import wall
from sioms.descriptors import permit_files
from sioms.ending import on_end
from sioms.heaps import one_heap
from sioms.notify import ServiceManager
from sioms.protocol.clock import Wall
from sioms.protocol.text import printable

from .core import Gateway
from .parts import Journal, Line, Node, Principal, Session
from .sockets import DaemonLine, FollowedJournal, OpenNode
from .transport import Transport

KEYS_S = 0.1
"""How often the list of keys, and what piles up, are looked at [s]."""
WALL_S = 1.0
"""How often the wall clock is looked at [s]."""


def log(level: str, event: str, **words: object) -> None:
    """Write a line to standard error."""
    text = " ".join(f"{key}={printable(str(word), 300)!r}" for key, word in words.items())
    print(f"level={level} event={event.replace(' ', '-')} {text}".rstrip(), file=sys.stderr, flush=True)


class Keys:
    """The keys that may come in, as the folder has them now.

    Args:
        folder: of keys.

    Raises:
        OSError: the list is not good.
    """

    def __init__(self, folder: Folder) -> None:
        self._folder = folder
        self._seen: tuple[int, ...] = ()
        self.by_public: dict[str, Principal] = {}
        self.look(strict=True)

    def look(self, *, strict: bool = False) -> bool:
        """Read the list again if it has changed; return whether it has. A damaged one lets nobody in."""
        try:
            about = os.stat(self._folder.file("allowed"))
            seen: tuple[int, ...] = (about.st_mtime_ns, about.st_ino, about.st_size)
        except OSError:
            seen = (0,)
        if seen == self._seen:
            return False
        self._seen = seen
        try:
            allowed = self._folder.allowed()
        except OSError as error:
            if strict:
                raise
            log("error", "keys", why=error.strerror)
            allowed = []
        self.by_public = {one.public: Principal(one.name, one.groups, one.public) for one in allowed}
        return True


class Serve:
    """A gateway over any number of transports.

    Args:
        path: the daemon's socket.
        folder: of keys.

    Attributes:
        gateway: the sessions.
        transports: what carries them.

    Raises:
        OSError: the list of keys is not good.
    """

    def __init__(self, path: str, folder: Folder) -> None:
        self._path = path
        self._epoll = select.epoll()
        self._readable: dict[int, Callable[[], None]] = {}
        self._writable: dict[int, Callable[[], None]] = {}
        self._ending = False
        self._wall, self._wall_ns = wall(), time.monotonic_ns()
        self._keys = Keys(folder)
        self.gateway = Gateway(self, time.monotonic_ns, self._wall_now)
        self.transports: list[Transport] = []

    def principal(self, public: str) -> Principal | None:
        """Return who holds a key, None: nobody who may come in."""
        return self._keys.by_public.get(public)

    # --- core.Outside ----------------------------------------------------------------------------

    def send(self, peer: bytes, frame: bytes) -> bool:
        """Send a frame to a client; False when it has gone, or takes no more."""
        return any(each.owns(peer) and each.send(peer, frame) for each in self.transports)

    def connect(self, session: Session) -> Line:
        """Connect to the daemon."""
        return DaemonLine(self._path, self, partial(self.gateway.daemon_packet, session))

    def attach(self, session: Session, handle: int, fds: Sequence[int]) -> Node:
        """Take the descriptors of an open."""

        def packet(data: bytes) -> None:
            if data:
                self.gateway.driver_packet(session, handle, data)
            else:
                self.gateway.driver_gone(session, handle)

        return OpenNode(fds, self, packet, partial(self.gateway.woken, session, handle))

    def follow(self, session: Session, fds: Sequence[int]) -> Journal:
        """Take the descriptors of a journal."""
        return FollowedJournal(fds, self, partial(self.gateway.unfollow, session))

    def drop(self, fds: Sequence[int]) -> None:
        """Close descriptors that nobody wants."""
        for fd in fds:
            os.close(fd)

    def log(self, level: str, event: str, **words: object) -> None:
        """Write a line."""
        log(level, event, **words)

    # --- the loop --------------------------------------------------------------------------------

    def add(self, fd: int, readable: Callable[[], None], writable: Callable[[], None] | None = None) -> None:
        """Call back when a descriptor is readable, or writable if that is wanted; again: instead of before."""
        events = select.EPOLLIN | (select.EPOLLOUT if writable else 0)
        if fd in self._readable:
            self._epoll.modify(fd, events)
        else:
            self._epoll.register(fd, events)
        self._readable[fd] = readable
        self._writable.pop(fd, None)
        if writable:
            self._writable[fd] = writable

    def remove(self, fd: int) -> None:
        """Watch it no more."""
        if self._readable.pop(fd, None):
            self._writable.pop(fd, None)
            self._epoll.unregister(fd)

    def _wall_now(self) -> Wall:
        now_ns = time.monotonic_ns()
        if now_ns - self._wall_ns > WALL_S * 1e9:
            self._wall, self._wall_ns = wall(), now_ns
        return self._wall

    def run(self) -> None:
        """Serve until ``end``; ``close`` comes after it, whatever it ends by."""
        for each in self.transports:
            each.start()
        manager = ServiceManager()
        manager.tell("READY=1")
        keys_ns = fed_ns = 0
        busy = False
        while not self._ending:
            wait_s = 0.0 if busy else max(0, self.gateway.due_ns - time.monotonic_ns()) * 1e-9
            for fd, event in self._epoll.poll(wait_s):
                if event & select.EPOLLOUT and (call := self._writable.get(fd)):
                    call()
                if event & ~select.EPOLLOUT and (call := self._readable.get(fd)):
                    call()
            busy = False
            for each in self.transports:
                busy = each.take() or busy
            now_ns = time.monotonic_ns()
            if now_ns >= self.gateway.due_ns:
                self.gateway.tick()
                busy = busy or any(each.pending for each in self.transports)
            if now_ns >= keys_ns:
                keys_ns = now_ns + int(KEYS_S * 1e9)
                for each in self.transports:
                    each.look()
                if self._keys.look():
                    self.gateway.allow(self._keys.by_public.values())
                    busy = True  # sending takes the edge off the descriptor of what has come
            if manager.watchdog_ns and now_ns - fed_ns >= manager.watchdog_ns:
                fed_ns = now_ns
                manager.tell("WATCHDOG=1")
        manager.tell("STOPPING=1")

    def end(self) -> None:
        """Have the loop end."""
        self._ending = True

    def close(self) -> None:
        """End all sessions, and let go of everything: nothing of a library calls us any more. One part that fails
        leaves none of the others open.
        """
        with ExitStack() as parts:
            parts.callback(self._epoll.close)
            for each in self.transports:
                parts.callback(each.close)
            for session in list(self.gateway.sessions.values()):
                parts.callback(self.gateway.end, session, errno.EIO, "the gateway ends")


def serve(path: str, folder: Folder, *, zmq: tuple[str, int] | None, zenoh: tuple[str, int] | None) -> None:
    """Serve until SIGTERM or SIGINT.

    Args:
        path: the daemon's socket.
        folder: of keys.
        zmq, zenoh: host and port where each transport listens, None: not at all.

    Raises:
        OSError: with a sentence: a place that is taken or not ours, no certificate.
    """
    permit_files()
    one_heap()
    gateway = Serve(path, folder)
    with closing(gateway):
        if zmq is not None:
            from .zeromq import ZeroMq

            gateway.transports.append(ZeroMq(gateway, path, *zmq, folder))
        if zenoh is not None:
            from .zenoh import Zenoh

            gateway.transports.append(Zenoh(gateway, path, *zenoh, folder))
        on_end(gateway.end)
        for each in gateway.transports:
            log("info", "ready", **each.about, keys=folder.path)
        gateway.run()
