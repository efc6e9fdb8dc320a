"""The gateway over ZeroMQ: one ROUTER under CURVE for requests and readings; stops have another, and a thread
(``stops``).

Concurrency: the thread of the loop.
"""

from __future__ import annotations

import errno
import time
from typing import TYPE_CHECKING

import zmq

from sioms.client.keys import Folder, Pair
from sioms.client.zeromq import READABLE
from sioms.protocol import link

from .connections import PROOF_S, Connection, Connections, Strangers
from .inflow import MOST, Inflow
from .stops import DOMAIN, Stops

if TYPE_CHECKING:
    from .transport import Loop

TURN = 200
"""Frames of clients that are taken before others have their turn."""
QUEUE = 1000
"""Frames that wait for one client's connection, at most; a session with more has ended."""
QUEUE_IN = 200
"""Frames of a client that wait to be taken, at most; more wait at the client."""
HANDSHAKE_MS = 2000
MORE, LAST = int(zmq.SNDMORE | zmq.DONTWAIT), int(zmq.DONTWAIT)
"""How the parts of a frame are sent: whole, or not at all, which the first part tells."""


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


class ZeroMq:
    """See ``transport.Transport``.

    Args:
        loop: the loop it lives in.
        path: the daemon's socket.
        host, port: where to listen; stops come in at the port after it.
        folder: of keys.

    Raises:
        OSError: the port is taken, or no such address is ours.
    """

    def __init__(self, loop: Loop, path: str, host: str, port: int, folder: Folder) -> None:
        self._loop, self._gateway = loop, loop.gateway
        self._known: dict[bytes, tuple[str, str, int]] = {}
        self._connections, self._strangers = Connections((port, port + 1)), Strangers(loop.log)
        self._inflow = Inflow()
        pair = folder.own() or folder.new("gateway")
        self.about = {"address": f"zmq://{host}:{port}", "public": pair.public}
        self._context = zmq.Context(1)
        self._router = secured(self._context, zmq.ROUTER, pair)
        stops = secured(self._context, zmq.ROUTER, pair)
        self._stops = Stops(self._context, stops, path, loop.principal, self._inflow, loop.log)
        bind(self._router, host, port)
        bind(stops, host, port + 1)
        self._router_fd = int(self._router.getsockopt(zmq.FD))
        self._is_ready = False
        loop.add(self._router_fd, self._tell_ready)

    def _tell_ready(self) -> None:
        self._is_ready = True

    def start(self) -> None:
        """Begin to take stops."""
        self._stops.start()

    def owns(self, peer: bytes) -> bool:
        """Tell whether a peer is one of this transport: a connection that ZeroMQ has named."""
        return peer[:1] == b"\0"

    def send(self, peer: bytes, frame: bytes) -> bool:
        """Send a frame to a client; return False if it has disconnected or its queue is full."""
        try:
            self._router.send(peer, MORE)
            self._router.send(frame, LAST)
        except zmq.ZMQError:
            self._known.pop(peer, None)
            return False
        return True

    @property
    def pending(self) -> bool:
        """Whether frames wait: sending takes the edge off the descriptor of what has come."""
        return bool(int(self._router.getsockopt(zmq.EVENTS)) & READABLE)

    def take(self) -> bool:
        """Take frames of clients; return whether there are more."""
        router, known, gateway = self._router, self._known, self._gateway
        is_ready, self._is_ready = self._is_ready, False  # asking takes as long as trying
        for _ in range(TURN):
            if not is_ready and not int(router.getsockopt(zmq.EVENTS)) & READABLE:
                return False
            is_ready = False
            try:
                peer = router.recv(zmq.DONTWAIT)
            except zmq.Again:
                return False
            if peer in known and peer in gateway.sessions:
                frame = router.recv()
            else:
                first = router.recv(copy=False)
                known[peer] = (str(first.get("User-Id")), str(first.get("Peer-Address")), int(first.get(zmq.SRCFD)))
                frame = first.bytes
            public, host, fd = known[peer]
            size = len(frame)
            more = several = bool(router.getsockopt(zmq.RCVMORE))
            while more:
                size += len(router.recv())
                more = bool(router.getsockopt(zmq.RCVMORE))
            self._inflow.took(fd, size)
            # A peer that names itself could take over the name of one that has gone: those of ZeroMQ begin with zero.
            if several or not self.owns(peer):
                continue
            gateway.frame(peer, self._loop.principal(public), host, frame)
            if peer not in gateway.sessions:
                known.pop(peer, None)
        return True

    def look(self) -> None:
        """End connections of which too much waits, and those of strangers that are too many."""
        try:
            connections = self._connections.look()
        except OSError:  # no descriptor is left: nobody new comes in either
            return
        for fd in self._inflow.look(connections):
            self._loop.log("warning", "connection ended", why=f"more than {MOST} bytes of it wait", descriptor=fd)
        self._strangers.turn_away(connections, self._is_known)

    def _is_known(self, fd: int, connection: Connection) -> bool:
        """Tell who has proved himself: a handshake that lasts has succeeded, as ZeroMQ ends the others."""
        return self._inflow.has_heard(fd) or time.monotonic() - connection.since_s > PROOF_S

    def close(self) -> None:
        """Let go of everything."""
        self._stops.close()
        self._loop.remove(self._router_fd)
        self._router.close()
        self._context.term()


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
