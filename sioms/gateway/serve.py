"""ZeroMQ around the sessions: one ROUTER under CURVE for requests and readings, and the loop that serves it.

Concurrency: one thread; stops, and the question who may come in at all, have another (``stops``).
"""

from __future__ import annotations

import errno
import os
import select
import signal
import sys
import time
from collections.abc import Callable, Sequence
from functools import partial

import zmq

from sioms.client.keys import Folder, Pair
from sioms.client.wall import wall
from sioms.notify import ServiceManager
from sioms.protocol import link
from sioms.protocol.clock import Wall
from sioms.protocol.text import printable

from .core import Gateway, Line, Node, Principal, Session
from .inflow import MOST, Inflow
from .sockets import DaemonLine, OpenNode
from .stops import DOMAIN, Stops

KEYS_S = 0.1
"""How often the list of keys, and what piles up, are looked at [s]."""
WALL_S = 1.0
"""How often the wall clock is looked at [s]."""
TURN = 200
"""Frames of clients that are taken before others have their turn."""
QUEUE = 1000
"""Frames that wait for one client's connection, at most; a session with more has ended."""
QUEUE_IN = 200
"""Frames of a client that wait to be taken, at most; more wait at the client."""
HANDSHAKE_MS = 2000


def log(level: str, event: str, **words: object) -> None:
    """Write a line to standard error."""
    text = " ".join(f"{key}={printable(str(word), 300)!r}" for key, word in words.items())
    print(f"level={level} event={event.replace(' ', '-')} {text}".rstrip(), file=sys.stderr, flush=True)


def secured(context: zmq.Context[zmq.Socket[bytes]], kind: int, pair: Pair) -> zmq.Socket[bytes]:
    """Return a server's socket on which nobody is heard whose key is not allowed."""
    sock = context.socket(kind)
    sock.curve_server = True
    sock.curve_secretkey = pair.secret.encode()
    sock.zap_domain = DOMAIN
    for option, value in (
        (zmq.MAXMSGSIZE, link.MAX_TO_GATEWAY), (zmq.HANDSHAKE_IVL, HANDSHAKE_MS), (zmq.LINGER, 200),
        (zmq.SNDHWM, QUEUE), (zmq.RCVHWM, QUEUE_IN), (zmq.ROUTER_MANDATORY, 1),
    ):  # fmt: skip
        sock.setsockopt(option, value)
    return sock


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
    """A gateway over ZeroMQ.

    Args:
        path: the daemon's socket.
        host, port: where to listen; stops come in at the port after it.
        folder: of keys.

    Raises:
        OSError: the port is taken, or no such address is ours.
    """

    def __init__(self, path: str, host: str, port: int, folder: Folder) -> None:
        self._path = path
        self._epoll = select.epoll()
        self._readable: dict[int, Callable[[], None]] = {}
        self._writable: dict[int, Callable[[], None]] = {}
        self._known: dict[bytes, tuple[str, str, int]] = {}
        self._inflow = Inflow()
        self._ending = False
        self._wall, self._wall_ns = wall(), time.monotonic_ns()
        self._keys = Keys(folder)
        self.gateway = Gateway(self, time.monotonic_ns, self._wall_now)
        pair = folder.own() or folder.new("gateway")
        self.public = pair.public
        self._context = zmq.Context(1)
        self._router = secured(self._context, zmq.ROUTER, pair)
        stops = secured(self._context, zmq.ROUTER, pair)
        self._stops = Stops(self._context, stops, path, self._principal, self._inflow, log)
        bind(self._router, host, port)
        bind(stops, host, port + 1)
        self._router_fd = int(self._router.getsockopt(zmq.FD))
        self.add(self._router_fd, lambda: None)

    def _principal(self, public: str) -> Principal | None:
        return self._keys.by_public.get(public)

    # --- core.Outside ----------------------------------------------------------------------------

    def send(self, peer: bytes, frame: bytes) -> bool:
        """Send a frame to a client; False when it has gone, or takes no more."""
        try:
            self._router.send_multipart((peer, frame), zmq.DONTWAIT)
        except zmq.ZMQError:
            self._known.pop(peer, None)
            return False
        return True

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

    def _take(self) -> bool:
        """Take frames of clients; return whether there are more."""
        router, known = self._router, self._known
        for _ in range(TURN):
            if not int(router.getsockopt(zmq.EVENTS)) & zmq.POLLIN:
                return False
            peer = router.recv()
            if peer in known and peer in self.gateway.sessions:
                frame = router.recv()
            else:
                first = router.recv(copy=False)
                known[peer] = (str(first.get("User-Id")), str(first.get("Peer-Address")), int(first.get(zmq.SRCFD)))
                frame = first.bytes
            public, host, fd = known[peer]
            size, more = len(frame), router.getsockopt(zmq.RCVMORE)
            while router.getsockopt(zmq.RCVMORE):
                size += len(router.recv())
            self._inflow.took(fd, size)
            # A peer that names itself could take over the name of one that has gone: those of ZeroMQ begin with zero.
            if more or peer[:1] != b"\0":
                continue
            self.gateway.frame(peer, self._principal(public), host, frame)
            if peer not in self.gateway.sessions:
                known.pop(peer, None)
        return True

    def run(self) -> None:
        """Serve until ``end``."""
        self._stops.start()
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
            busy = self._take()
            now_ns = time.monotonic_ns()
            if now_ns >= self.gateway.due_ns:
                self.gateway.tick()
                busy = busy or bool(int(self._router.getsockopt(zmq.EVENTS)) & zmq.POLLIN)
            if now_ns >= keys_ns:
                keys_ns = now_ns + int(KEYS_S * 1e9)
                for fd in self._inflow.look():
                    log("warning", "connection ended", why=f"more than {MOST} bytes of it wait", descriptor=fd)
                if self._keys.look():
                    self.gateway.allow(self._keys.by_public.values())
                    busy = True  # sending takes the edge off the descriptor of what has come
            if manager.watchdog_ns and now_ns - fed_ns >= manager.watchdog_ns:
                fed_ns = now_ns
                manager.tell("WATCHDOG=1")
        manager.tell("STOPPING=1")
        self.close()

    def end(self, *_: object) -> None:
        """Have the loop end, as a signal's handler."""
        self._ending = True

    def close(self) -> None:
        """End all sessions, and let go of everything."""
        for session in list(self.gateway.sessions.values()):
            self.gateway.end(session, errno.EIO, "the gateway ends")
        self._stops.close()
        self.remove(self._router_fd)
        self._router.close()
        self._context.term()
        self._epoll.close()


def bind(sock: zmq.Socket[bytes], host: str, port: int) -> None:
    """Listen.

    Raises:
        OSError: with a sentence.
    """
    place = f"[{host}]" if ":" in host else host
    sock.setsockopt(zmq.IPV6, int(":" in host))
    try:
        sock.bind(f"tcp://{place}:{port}")
    except zmq.ZMQError as error:
        hint = {
            errno.EADDRINUSE: "another program listens there; stop it, or choose another port (and the one after it)",
            errno.ENODEV: "no address of this machine; want one of `ip address`, or * for all",
            errno.EADDRNOTAVAIL: "no address of this machine; want one of `ip address`, or * for all",
            errno.EACCES: "no right to that port; choose one above 1023",
        }.get(error.errno or 0, str(error))
        raise OSError(error.errno, f"listen on {place}:{port}: {hint}") from None


def serve(path: str, host: str, port: int, folder: Folder) -> None:
    """Serve until SIGTERM or SIGINT."""
    gateway = Serve(path, host, port, folder)
    signal.signal(signal.SIGTERM, gateway.end)
    signal.signal(signal.SIGINT, gateway.end)
    log("info", "ready", address=f"zmq://{host}:{port}", public=gateway.public, keys=folder.path)
    gateway.run()
