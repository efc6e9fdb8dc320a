"""Connections: a serial port, a TCP stream, a UDP association or a device file as one non-blocking descriptor."""

from __future__ import annotations

import errno
import os
import socket
import termios
from collections.abc import Callable
from io import FileIO
from pathlib import Path

import serial

from sioms.descriptors import is_writable

from .datagram import Datagrams, split_address
from .locks import PortLock
from .settings import LineSettings

MOST_PORTS = 4
"""Ports that a sentence names."""
_LOOK = "check host, port and network"


class Connection:
    """A line that is open, or being opened.

    Args:
        settings: which line.
        stranger: called for each datagram that came from another host and was dropped.

    Raises:
        OSError: it cannot be opened; the text says what to look at.
    """

    def __init__(self, settings: LineSettings, stranger: Callable[[], None] = lambda: None) -> None:
        self.settings = settings
        self._serial: serial.Serial | None = None
        self._sock: socket.socket | None = None
        self._datagrams: Datagrams | None = None
        self._file: FileIO | None = None
        self._lock: PortLock | None = None
        if settings.serial is not None:
            self._open_serial(settings)
        elif settings.udp is not None:
            self._datagrams = Datagrams(settings.udp, settings.local, stranger)
        elif settings.path is not None:
            self._open_file(settings.path)
        else:
            self._open_tcp(settings)

    @property
    def fd(self) -> int:
        """The descriptor, for epoll."""
        owner = self._serial or self._sock or self._datagrams or self._file
        return owner.fileno() if owner is not None else -1

    def is_connected(self) -> bool:
        """Tell whether a TCP connection has come about; raises OSError when it was refused."""
        if self._sock is None:
            return True
        if not is_writable(self._sock):
            return False
        error = self._sock.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR)
        if error:
            raise OSError(error, f"connect to {self.settings}: {os.strerror(error).lower()}; {_LOOK}")
        return True

    def write(self, data: bytes) -> None:
        """Send bytes at once, or fail: requests are far smaller than any buffer. On UDP this is one datagram."""
        if self._datagrams is not None:
            self._datagrams.write(data)
            return
        sent = os.write(self.fd, data)
        if sent != len(data):
            raise OSError(errno.EIO, f"send on {self.settings}: took {sent} of {len(data)} bytes")

    def read(self) -> bytes:
        """Return what has come, b'' when nothing has; on UDP the next datagram.

        Raises:
            OSError: the line is gone: unplugged, closed by the device, or refused by its host.
        """
        if self._datagrams is not None:
            return self._datagrams.read()
        try:
            data = os.read(self.fd, 65536)
        except BlockingIOError:
            return b""
        except OSError as error:
            raise OSError(error.errno, f"{self.settings} is gone: {os.strerror(error.errno or 5).lower()}") from None
        if not data:
            raise OSError(errno.EIO, f"{self.settings} is gone: it was closed from the other side")
        return data

    def close(self) -> None:
        """Release the line."""
        if self._lock is not None:
            self._lock.release()
        if self._serial is not None:
            self._serial.close()
        if self._sock is not None:
            self._sock.close()
        if self._datagrams is not None:
            self._datagrams.close()
        if self._file is not None:
            self._file.close()

    def _open_file(self, path: str) -> None:
        try:
            fd = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
        except OSError as error:
            hint = {
                errno.ENOENT: "no such device; is it plugged in, and its driver loaded",
                errno.EACCES: "no permission; give the daemon's user rights on it by a udev rule",
                errno.EBUSY: "in use by another process",
            }.get(error.errno or 0, os.strerror(error.errno or errno.EIO).lower())
            raise OSError(error.errno, f"open {path}: {hint}") from None
        self._file = FileIO(fd)

    def _open_serial(self, settings: LineSettings) -> None:
        self._lock = PortLock(settings.serial or "")
        try:
            self._open_port(settings, self._lock)
        except OSError:
            self._lock.release()
            raise

    def _open_port(self, settings: LineSettings, lock: PortLock) -> None:
        try:
            self._serial = serial.Serial(
                settings.serial, settings.baud, parity=settings.parity, stopbits=settings.stop_bits,
                timeout=0, exclusive=True,
            )  # fmt: skip
        except serial.SerialException as error:
            cause = error.__context__  # the port was opened, and is none
            number = error.errno or (cause.args[0] if isinstance(cause, termios.error) else errno.EIO)
            hint = {
                errno.ENOTTY: "it is not a serial port",
                errno.ENOENT: f"no such port; is the device plugged in{_or_one_of(_ports())}",
                errno.EACCES: "no permission; is the user in the group dialout",
                errno.EBUSY: "in use by another process",
                errno.EWOULDBLOCK: "in use by another process",
            }.get(number, str(error).lower())
            raise OSError(number, f"open {settings.serial}: {hint}") from None
        except (ValueError, termios.error) as error:
            raise OSError(errno.EINVAL, f"open {settings.serial} at {settings.baud} baud: {error}") from None
        fd = self._serial.fileno()
        lock.exclude(fd)
        os.set_blocking(fd, False)
        # VMIN 1: without data a read says EAGAIN, so that an empty read can only mean a hang-up.
        attributes = termios.tcgetattr(fd)
        attributes[6][termios.VMIN] = 1
        termios.tcsetattr(fd, termios.TCSANOW, attributes)

    def _open_tcp(self, settings: LineSettings) -> None:
        host, port = split_address(settings.tcp or "")
        sock = socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET, socket.SOCK_STREAM)
        try:
            sock.setblocking(False)
            sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            if settings.local:
                sock.bind(split_address(settings.local))
            result = sock.connect_ex((host, port))
        except OSError as error:
            sock.close()
            why = (error.strerror or str(error)).lower()
            raise OSError(error.errno, f"connect to {settings}: {why}; {_LOOK}") from None
        if result not in (0, errno.EINPROGRESS):
            sock.close()
            raise OSError(result, f"connect to {settings}: {os.strerror(result).lower()}; {_LOOK}")
        self._sock = sock


def _ports() -> list[str]:
    """Return the serial ports that devices were plugged into, by the names that last where they have such."""
    for pattern in ("serial/by-id/*", "ttyUSB*", "ttyACM*"):
        if found := sorted(map(str, Path("/dev").glob(pattern))):
            return found[:MOST_PORTS]
    return []


def _or_one_of(ports: list[str]) -> str:
    return f", or is it {' or '.join(ports)}" if ports else ""


opened: Callable[..., Connection] = Connection
"""What opens a line. A trace puts its own in place, so that nothing is spent on it otherwise."""


def open_connection(settings: LineSettings, stranger: Callable[[], None] = lambda: None) -> Connection:
    """Open a line; see ``Connection`` for what is given and raised."""
    return opened(settings, stranger)
