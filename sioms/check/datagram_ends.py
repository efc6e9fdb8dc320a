"""The ends of a wire that carries datagrams: to and from a device that is spoken to, and from one that sends by
itself.
"""

from __future__ import annotations

import contextlib
import socket

GONE = (ConnectionError, BlockingIOError, TimeoutError)


class UdpHost:
    """A UDP port that the driver sends to; what the device says goes to where the driver spoke from last."""

    def __init__(self) -> None:
        self._sock = _bound(0)
        self._driver: tuple[str, int] | None = None
        self._plugged = True
        self.name = f"127.0.0.1:{self._sock.getsockname()[1]}"

    def fds(self) -> list[int]:
        """Return the socket."""
        return [self._sock.fileno()]

    def read(self, fd: int) -> bytes | None:
        """Return a datagram of the driver."""
        try:
            data, self._driver = self._sock.recvfrom(65536)
        except GONE:
            return b""
        return data if self._plugged else b""

    def write(self, data: bytes) -> None:
        """Send a datagram to the driver."""
        if self._driver is not None and self._plugged:
            with contextlib.suppress(*GONE):
                self._sock.sendto(data, self._driver)

    def plug(self) -> None:
        """Carry datagrams again."""
        self._plugged = True

    def unplug(self) -> None:
        """Lose every datagram: a pulled network cable."""
        self._plugged = False


class UdpDevice:
    """The association with the device."""

    def __init__(self, port: str) -> None:
        host, _, number = port.rpartition(":")
        self._sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._sock.connect((host, int(number)))
        self._sock.setblocking(False)

    def fds(self) -> list[int]:
        """Return the socket."""
        return [self._sock.fileno()]

    def read(self, fd: int) -> bytes | None:
        """Return a datagram of the device."""
        try:
            return self._sock.recv(65536)
        except GONE:
            return b""

    def write(self, data: bytes) -> None:
        """Send a datagram."""
        with contextlib.suppress(*GONE):
            self._sock.send(data)

    def plug(self) -> None:
        """Nothing: it is always there."""

    def unplug(self) -> None:
        """Nothing: the other end loses what is sent."""


class PushedHost(UdpHost):
    """Sends to a free port on which the driver may listen; hears nothing."""

    def __init__(self) -> None:
        super().__init__()
        with _bound(0) as free:
            self._driver = free.getsockname()
        self.name = f"127.0.0.1:{self._driver[1]}"

    def fds(self) -> list[int]:
        """Return nothing to wait on."""
        return []


class PushedDevice(UdpDevice):
    """The port to which the device sends."""

    def __init__(self, port: str) -> None:
        self._sock = _bound(int(port.rpartition(":")[2]))

    def write(self, data: bytes) -> None:
        """Nothing: the device is told elsewhere what to send."""


def _bound(port: int) -> socket.socket:
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sock.bind(("127.0.0.1", port))
    sock.setblocking(False)
    return sock
