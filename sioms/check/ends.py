"""The two ends of a wire: what a driver opens, and what leads to its device. Serial ports and TCP; UDP is in
``datagram_ends``.

All are non-blocking. ``read`` returns whole datagrams on UDP. A line that is not there takes bytes and loses them.
"""

from __future__ import annotations

import contextlib
import os
import socket
import tty
from pathlib import Path
from typing import Protocol

from sioms.simulation.ports import allow_parity, make_link

from .datagram_ends import GONE, PushedDevice, PushedHost, UdpDevice, UdpHost

KINDS = ("serial", "tcp", "udp", "pushed")
DATAGRAMS = ("udp", "pushed")


class End(Protocol):
    """An end of the wire."""

    def fds(self) -> list[int]:
        """Return the descriptors to wait on."""

    def read(self, fd: int) -> bytes | None:
        """Return what has come on a descriptor, b'' when there is nothing, None when that end was closed."""

    def write(self, data: bytes) -> None:
        """Send."""

    def plug(self) -> None:
        """Make the end appear."""

    def unplug(self) -> None:
        """Make it vanish."""


class Host(End, Protocol):
    """The driver's end.

    Attributes:
        name: what the driver opens.
    """

    name: str


class SerialHost:
    """A pty that the driver opens by a link."""

    def __init__(self, link: Path) -> None:
        self._link = link
        self._master = self._slave = -1
        self.name = str(link)

    def fds(self) -> list[int]:
        """Return the pty."""
        return [self._master] if self._master >= 0 else []

    def read(self, fd: int) -> bytes | None:
        """Return what the driver sent."""
        try:
            data = os.read(fd, 4096)
        except OSError:
            return b""
        allow_parity(self._slave)
        return data

    def write(self, data: bytes) -> None:
        """Send; what does not fit while nobody reads is lost, as on a wire."""
        if self._master >= 0:
            with contextlib.suppress(OSError):
                os.write(self._master, data)

    def plug(self) -> None:
        """Make a new pty under the old link; its slave stays open here, so that a driver closing it ends nothing."""
        if self._master < 0:
            self._master, self._slave = os.openpty()
            tty.setraw(self._slave)
            os.set_blocking(self._master, False)
            make_link(self._link, os.ttyname(self._slave))

    def unplug(self) -> None:
        """Close the pty: the driver sees a hang-up."""
        if self._master >= 0:
            self._link.unlink(missing_ok=True)
            os.close(self._master)
            os.close(self._slave)
            self._master = self._slave = -1


class SerialDevice:
    """The simulator's pty, opened by name and again when it has vanished."""

    def __init__(self, port: str) -> None:
        self._port = port
        self._fd = -1

    def fds(self) -> list[int]:
        """Return the port."""
        self.plug()
        return [self._fd] if self._fd >= 0 else []

    def read(self, fd: int) -> bytes | None:
        """Return what the device sent."""
        try:
            return os.read(fd, 4096)
        except BlockingIOError:
            return b""
        except OSError:
            self.unplug()
            return b""

    def write(self, data: bytes) -> None:
        """Send."""
        self.plug()
        if self._fd >= 0:
            with contextlib.suppress(OSError):
                os.write(self._fd, data)

    def plug(self) -> None:
        """Open the port, if it is there."""
        if self._fd < 0:
            with contextlib.suppress(OSError):
                self._fd = os.open(self._port, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
                tty.setraw(self._fd)

    def unplug(self) -> None:
        """Close the port."""
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1


class TcpHost:
    """A listening TCP port with one driver at a time; its connection leads on to the device."""

    def __init__(self) -> None:
        self._server: socket.socket | None = None
        self._port = 0
        self._driver: socket.socket | None = None
        self.device = TcpDevice()
        self.plug()
        self.name = f"127.0.0.1:{self._port}"

    def fds(self) -> list[int]:
        """Return the listening socket and the connection."""
        return [each.fileno() for each in (self._server, self._driver) if each is not None]

    def read(self, fd: int) -> bytes | None:
        """Return what the driver sent, after letting a new one in."""
        if self._server is not None and fd == self._server.fileno():
            self._accept()
            return b""
        return _receive(self._driver) if self._driver is not None else b""

    def _accept(self) -> None:
        if self._server is None:
            return
        with contextlib.suppress(OSError):
            sock, _ = self._server.accept()
            self.hang_up()
            sock.setblocking(False)
            sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._driver = sock
            self.device.plug()

    def hang_up(self) -> None:
        """End the present connection on both sides."""
        if self._driver is not None:
            self._driver.close()
            self._driver = None
        self.device.unplug()

    def write(self, data: bytes) -> None:
        """Send to the driver, if there is one."""
        if self._driver is not None:
            with contextlib.suppress(*GONE):
                self._driver.send(data)

    def plug(self) -> None:
        """Listen, on the same port as before."""
        if self._server is None:
            self._server = socket.create_server(("127.0.0.1", self._port))
            self._server.setblocking(False)
            self._port = self._server.getsockname()[1]

    def unplug(self) -> None:
        """Stop listening and cut the connection."""
        self.hang_up()
        if self._server is not None:
            self._server.close()
            self._server = None


class TcpDevice:
    """The connection to the device, made when a driver comes."""

    def __init__(self) -> None:
        self.port = ""
        self._sock: socket.socket | None = None

    def fds(self) -> list[int]:
        """Return the connection."""
        return [self._sock.fileno()] if self._sock is not None else []

    def read(self, fd: int) -> bytes | None:
        """Return what the device sent, None when it hung up."""
        return _receive(self._sock) if self._sock is not None else b""

    def write(self, data: bytes) -> None:
        """Send."""
        if self._sock is not None:
            with contextlib.suppress(*GONE):
                self._sock.send(data)

    def plug(self) -> None:
        """Connect, if there is a device."""
        if not self.port:
            return
        host, _, port = self.port.rpartition(":")
        with contextlib.suppress(OSError):
            self._sock = socket.create_connection((host, int(port)), 1.0)
            self._sock.setblocking(False)
            self._sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def unplug(self) -> None:
        """Hang up."""
        if self._sock is not None:
            self._sock.close()
            self._sock = None


def _receive(sock: socket.socket) -> bytes | None:
    try:
        return sock.recv(65536) or None
    except BlockingIOError:
        return b""
    except OSError:
        return None


def make_ends(kind: str, device_port: str, link: Path) -> tuple[Host, End]:
    """Return both ends of a wire of one of KINDS."""
    match kind:
        case "serial":
            host = SerialHost(link)
            host.plug()
            return host, SerialDevice(device_port)
        case "tcp":
            tcp = TcpHost()
            tcp.device.port = device_port
            return tcp, tcp.device
        case "udp":
            return UdpHost(), UdpDevice(device_port)
        case "pushed":
            return PushedHost(), PushedDevice(device_port)
    raise ValueError(f"make a wire: no kind {kind}; want one of {', '.join(KINDS)}")
