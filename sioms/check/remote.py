"""A gateway of one's own with keys for both sides, and a relay that treats its link badly."""

from __future__ import annotations

import contextlib
import os
import random
import shutil
import socket
import tempfile
import threading
import time
from collections import deque
from typing import Self

from sioms.children import Process
from sioms.client.keys import VARIABLE, Folder
from sioms.descriptors import readable


def free_ports() -> int:
    """Return a port that is free, as the one after it is."""
    while True:
        with socket.socket() as one, socket.socket() as two, contextlib.suppress(OSError):
            one.bind(("127.0.0.1", 0))
            port = int(one.getsockname()[1])
            two.bind(("127.0.0.1", port + 1))
            return port


class Gateway:
    """``sioms serve`` on loopback for the clients of this process and its children. Use it in a ``with`` block.

    Args:
        daemon_socket: of the daemon.
        name: of the key that clients have.
        host: where it listens; what this thread starts is on that host (``other_host``).

    Attributes:
        socket: the address, as that of a daemon.
        keys, own: folders of keys of the gateway and of the clients.
    """

    def __init__(self, daemon_socket: str, name: str = "eva", *, host: str = "127.0.0.1") -> None:
        self.host = host
        self.folder = tempfile.mkdtemp(prefix="sioms-gateway-")
        self.keys, self.own = Folder(f"{self.folder}/cell"), Folder(f"{self.folder}/own")
        self.name, self._daemon_socket = name, daemon_socket
        self._keys()
        self.port = free_ports()
        self.socket = self.trusted(self.port)
        self._before = os.environ.get(VARIABLE)
        os.environ[VARIABLE] = self.own.path
        self.start()

    def _keys(self) -> None:
        self.public = self.keys.new("gateway").public
        self.keys.allow(self.name, self.own.new(self.name).public, ("crew",))

    def _place(self) -> list[str]:
        return ["--listen", f"{self.host}:{self.port}"]

    def trusted(self, port: int) -> str:
        """Return the address of a port of this machine, at which this gateway's key is trusted from now on."""
        self.own.trust(f"{self.host}:{port}", self.public)
        return f"zmq://{self.host}:{port}"

    def start(self) -> None:
        """Start the process, which has not been started or has ended."""
        place = [*self._place(), "--socket", self._daemon_socket, "--keys", self.keys.path]
        self.process = Process(["sioms.tools.front", "serve", *place], "event=ready", errors=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.process.end()
        os.environ.pop(VARIABLE, None)
        if self._before is not None:
            os.environ[VARIABLE] = self._before
        shutil.rmtree(self.folder, ignore_errors=True)


class ZenohGateway(Gateway):
    """The same over Zenoh, with an authority of its own.

    Args:
        daemon_socket, name: as of ``Gateway``; the name is that of the certificate of the clients.
        authority: the folder of another gateway's, whose certificates both take; None: one of its own.

    Attributes:
        number: of the certificate of the clients.
    """

    def __init__(
        self, daemon_socket: str, name: str = "eva", authority: Folder | None = None, *, host: str = "127.0.0.1"
    ) -> None:
        from sioms.gateway import certificates

        self._certificates = certificates
        self._shared = authority
        super().__init__(daemon_socket, name, host=host)

    def _keys(self) -> None:
        certificates = self._certificates
        self.authority = self._shared or Folder(f"{self.folder}/authority")
        if self._shared is None:
            certificates.new_authority(self.authority, "fleet", 1)
        self.certify(self.keys, "cell", (self.host,))
        self.number = self.certify(self.own, self.name)
        self.keys.allow(self.name, self.number, ("crew",))

    def certify(self, folder: Folder, name: str, hosts: tuple[str, ...] = (), days: int = 1) -> str:
        """Have a certificate for a folder signed by this authority; return its number."""
        asked = self._certificates.request(folder, name).encode()
        signed, made = self._certificates.sign(self.authority, asked, hosts, days)
        self._certificates.install(folder, signed.encode())
        return made.number

    def _place(self) -> list[str]:
        return ["--zenoh", f"{self.host}:{self.port}"]

    def trusted(self, port: int) -> str:
        """Return the address of a port of this machine: the certificate vouches for whoever listens there."""
        return f"zenoh://{self.host}:{port}"


class Relay:
    """Passes TCP connections on to a gateway's two ports, as badly as it is told. Use it in a ``with`` block.

    Args:
        to_port: of the gateway.

    Attributes:
        port: where clients connect.
        delay_s: how long bytes stay on their way [s].
        jitter_s: how much longer at most, at random [s]; they stay in order.
        stalled: whether nothing comes through; what has been sent comes when it does again.
        doubled: whether every piece comes twice.
        losing: whether pieces get lost: the next one of each direction, and then one of two.

    Concurrency: a thread of its own; attributes may be set by any.
    """

    def __init__(self, to_port: int) -> None:
        self.delay_s, self.jitter_s, self.stalled, self.doubled, self.losing = 0.0, 0.0, False, False, False
        self.port = free_ports()
        self._pairs: dict[socket.socket, socket.socket] = {}
        self._held: deque[tuple[float, socket.socket, bytes]] = deque()
        self._lost: set[socket.socket] = set()
        self._to = to_port
        self._listeners = [socket.create_server(("127.0.0.1", self.port + i)) for i in (0, 1)]
        self._ending = False
        self._lock = threading.Lock()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._ending = True
        self._thread.join()
        self.cut()
        for listener in self._listeners:
            listener.close()

    def cut(self) -> int:
        """End all connections; return when [ns, CLOCK_MONOTONIC]."""
        with self._lock:
            now_ns = time.monotonic_ns()
            for sock in self._pairs:
                sock.close()
            self._pairs.clear()
            self._held.clear()
        return now_ns

    def treat(self, *, stalled: bool = False, doubled: bool = False, losing: bool = False, delay_s: float = 0.0) -> int:
        """Treat what comes so; return from when on [ns, CLOCK_MONOTONIC]."""
        with self._lock:
            self.stalled, self.doubled, self.losing, self.delay_s = stalled, doubled, losing, delay_s
            return time.monotonic_ns()

    def _run(self) -> None:
        while not self._ending:
            try:
                ready = readable([*self._listeners, *list(self._pairs)], 0.001)
            except (OSError, ValueError):  # cut meanwhile
                continue
            with self._lock:
                for sock in ready:
                    if sock in self._listeners:
                        self._accept(sock)
                    elif sock in self._pairs:
                        self._take(sock)
                now = time.monotonic()
                while self._held and not self.stalled and self._held[0][0] <= now:
                    _, sock, data = self._held.popleft()
                    with contextlib.suppress(OSError):
                        sock.sendall(data)

    def _accept(self, listener: socket.socket) -> None:
        near, _ = listener.accept()
        try:
            far = socket.create_connection(("127.0.0.1", self._to + self._listeners.index(listener)))
        except OSError:  # nobody there any more
            near.close()
            return
        for sock in (near, far):
            sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._pairs |= {near: far, far: near}

    def _take(self, sock: socket.socket) -> None:
        try:
            data = sock.recv(65536)
        except OSError:
            data = b""
        other = self._pairs[sock]
        if data and self._loses(sock):
            return
        if data:
            way_s = self.delay_s + self.jitter_s * random.random()
            self._held.append((time.monotonic() + way_s, other, data * (2 if self.doubled else 1)))
            return
        for each in (sock, other):
            self._pairs.pop(each, None)
            each.close()

    def _loses(self, sock: socket.socket) -> bool:
        if not self.losing:
            self._lost.clear()
            return False
        if sock in self._lost and random.random() < 0.5:
            return False
        self._lost.add(sock)
        return True
