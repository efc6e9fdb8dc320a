"""The link over ZeroMQ with CURVE: a connection for requests and readings, and another one for stops.

Concurrency: the thread of the session.
"""

from __future__ import annotations

import errno
import os
import time
from collections.abc import Collection, Iterator
from contextlib import suppress
from typing import Any

import zmq
from zmq.utils.monitor import parse_monitor_message

from sioms.protocol import link
from sioms.protocol.link import Up

from .keys import Folder
from .places import probe

READABLE = int(zmq.POLLIN)
"""Of ``zmq.EVENTS``. What is done with members of an enumeration takes half as long as to ask a socket."""
_contexts: dict[int, zmq.Context[zmq.Socket[bytes]]] = {}
"""By process: the threads of a parent's are not in a forked child, which leaves it alone."""


def _socket(public: str, secret: str, server: str) -> zmq.Socket[bytes]:
    pid = os.getpid()
    if pid not in _contexts or _contexts[pid].closed:
        _contexts[pid] = zmq.Context(1)
    sock = _contexts[pid].socket(zmq.DEALER)
    sock.curve_publickey, sock.curve_secretkey = public.encode(), secret.encode()
    sock.curve_serverkey = server.encode()
    for option, value in (
        (zmq.LINGER, 200), (zmq.RECONNECT_IVL, -1), (zmq.MAXMSGSIZE, link.MAX_FROM_GATEWAY), (zmq.IPV6, 1),
        (zmq.HANDSHAKE_IVL, 2000),
    ):  # fmt: skip
        sock.setsockopt(option, value)
    return sock


class ZmqLink:
    """See ``remote.Link``.

    Args:
        what: what is attempted, for messages.
        address, host, port: of the gateway.
        timeout_s: how long connecting may take [s].

    Raises:
        OSError: no such host, nobody there, a key that is not known.
    """

    def __init__(self, what: str, address: str, host: str, port: int, timeout_s: float) -> None:
        folder = Folder()
        own = folder.own()
        if own is None:
            raise OSError(errno.EACCES, f"{what}: you have no key in {folder.path}; make one with: sioms key new")
        server = folder.trusted().get(f"{host}:{port}")
        if server is None:
            raise OSError(
                errno.EACCES,
                f"{what}: the key of that gateway is not known here; look it up there with `sioms key list`, and run: "
                f"sioms key trust {address} KEY",
            )
        numeric = probe(what, host, port, timeout_s)
        self._public = own.public
        self._requests = _socket(own.public, own.secret, server)
        self._stops = _socket(own.public, own.secret, server)
        self._monitor = self._requests.get_monitor_socket(
            zmq.EVENT_DISCONNECTED | zmq.EVENT_HANDSHAKE_SUCCEEDED | zmq.EVENT_HANDSHAKE_FAILED_AUTH
            | zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL | zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL
        )  # fmt: skip
        self._requests.connect(f"tcp://{numeric}:{port}")
        self._stops.connect(f"tcp://{numeric}:{port + 1}")
        self._monitor_fd = int(self._monitor.getsockopt(zmq.FD))
        fds = [int(sock.getsockopt(zmq.FD)) for sock in (self._requests, self._stops)]
        self.fds: tuple[int, ...] = (*fds, self._monitor_fd)
        try:
            self._shake_hands(what, timeout_s)
        except BaseException:
            self.close()
            raise

    def _shake_hands(self, what: str, timeout_s: float) -> None:
        deadline = time.monotonic() + timeout_s
        while True:
            if not self._monitor.poll(max(0, int(1e3 * (deadline - time.monotonic())))):
                raise OSError(errno.ETIMEDOUT, f"{what}: whoever listens there does not answer as a gateway does")
            happened: Any = parse_monitor_message(self._monitor.recv_multipart())
            if happened["event"] == zmq.EVENT_HANDSHAKE_SUCCEEDED:
                break
            if happened["event"] == zmq.EVENT_HANDSHAKE_FAILED_AUTH:
                raise OSError(
                    errno.EACCES,
                    f"{what}: the gateway does not let your key in; on its machine run `sioms key allow NAME "
                    f"{self._public}`",
                )
            raise OSError(
                errno.EACCES,
                f"{what}: whoever listens there has another key than the one trusted here, or is not a gateway; "
                "compare `sioms key list` of both machines",
            )
        with suppress(zmq.ZMQError):
            self._stops.send(link.pack(Up.HELLO), zmq.DONTWAIT)
            self._stops.getsockopt(zmq.EVENTS)  # from now on its descriptor tells

    def send(self, frame: bytes) -> None:
        """Send a frame; raises OSError."""
        try:
            self._requests.send(frame, zmq.DONTWAIT)
        except zmq.ZMQError as error:
            raise OSError(error.errno or errno.EIO, str(error)) from None

    def stop(self, frame: bytes) -> None:
        """Send a stop on its own way, if that takes one."""
        with suppress(zmq.ZMQError):  # it goes the other way then
            self._stops.send(frame, zmq.DONTWAIT)

    @property
    def pending(self) -> bool:
        """Whether frames wait of which no descriptor tells: sending takes the edge off that."""
        return bool(int(self._requests.getsockopt(zmq.EVENTS)) & READABLE)

    def frames(self, ready: Collection[int] = ()) -> Iterator[bytes]:
        """Take what has come."""
        for sock, fd in ((self._stops, self.fds[1]), (self._requests, self.fds[0])):
            is_ready = fd in ready  # asking takes as long as trying
            if ready and not is_ready and sock is self._stops:  # who takes frames may have sent some
                continue
            try:
                while is_ready or int(sock.getsockopt(zmq.EVENTS)) & READABLE:
                    is_ready = False
                    yield sock.recv(zmq.DONTWAIT)
            except zmq.Again:
                continue

    def lost(self, ready: Collection[int] | None = None) -> str:
        """Return why the connection has ended, '' if it has not."""
        if ready is not None and self._monitor_fd not in ready:
            return ""
        while int(self._monitor.getsockopt(zmq.EVENTS)) & READABLE:
            happened: Any = parse_monitor_message(self._monitor.recv_multipart())
            if happened["event"] == zmq.EVENT_DISCONNECTED:
                return "the connection has ended"
        return ""

    def close(self) -> None:
        """Let go of everything."""
        self._requests.disable_monitor()
        for sock in (self._monitor, self._requests, self._stops):
            sock.close()
