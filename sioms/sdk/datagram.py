"""Datagrams: a UDP socket that hears one device and nobody else.

The socket is not connected, because a connected one drops what others send without telling anybody: here it is
counted. Refusals by the device's host (ICMP port unreachable) still come, through IP_RECVERR.
"""

from __future__ import annotations

import errno
import os
import socket
from collections.abc import Callable
from typing import Any

MAX_DATAGRAM = 8192
"""Longest datagram that is taken whole [bytes]; no sensor here sends more than an Ethernet frame holds."""
STRANGERS_A_READ = 16
"""So many datagrams of others are dropped in one go before clients and the tick have their turn."""
RECEIVE_BUFFER = 1 << 20
"""Asked of the kernel, which gives what it may: room for some hundred small datagrams while the process is held up."""
_IP_RECVERR, _IPV6_RECVERR = 11, 25  # linux/in.h, linux/in6.h; no names in the socket module


def split_address(text: str) -> tuple[str, int]:
    """Return host and port of ``host:port``, an IPv6 host without its brackets.

    Example:
        >>> split_address("[fe80::1]:49152")
        ('fe80::1', 49152)
    """
    host, _, port = text.rpartition(":")
    return host.strip("[]"), int(port)


class Datagrams:
    """What goes to and comes from one device over UDP.

    Args:
        peer: ``host:port`` of the device; port 0 takes what comes from any port of that host, and nothing can be sent.
        local: ``host:port`` to listen on; a free port of all addresses when empty.
        stranger: called for each datagram that came from elsewhere and was dropped.

    Raises:
        OSError: the host's name is not known, or the local port is not free.
    """

    def __init__(self, peer: str, local: str, stranger: Callable[[], None]) -> None:
        self._peer, self._stranger = peer, stranger
        host, port = split_address(peer)
        family, self._address = _resolve(host, port)
        self._host, self._any_port = _bare(self._address[0]), port == 0
        self._sock = socket.socket(family, socket.SOCK_DGRAM)
        try:
            self._sock.setblocking(False)
            self._sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER)
            if family == socket.AF_INET6:
                self._sock.setsockopt(socket.IPPROTO_IPV6, _IPV6_RECVERR, 1)
            else:
                self._sock.setsockopt(socket.IPPROTO_IP, _IP_RECVERR, 1)
            self._sock.bind(split_address(local) if local else ("", 0))
        except OSError as error:
            self._sock.close()
            why = os.strerror(error.errno or errno.EIO).lower()
            raise OSError(error.errno, f"listen on {local or 'a free port'} for {peer}: {why}") from None

    def fileno(self) -> int:
        """Return the descriptor, for epoll."""
        return self._sock.fileno()

    def read(self) -> bytes:
        """Return the next datagram of the device, b'' when there is none.

        Raises:
            OSError: the device's host refuses datagrams, or cannot be reached.
        """
        for _ in range(STRANGERS_A_READ):
            try:
                data, sender = self._sock.recvfrom(MAX_DATAGRAM)
            except BlockingIOError:
                return b""
            except OSError as error:
                raise self._gone(error) from None
            if _bare(sender[0]) != self._host or not (self._any_port or sender[1] == self._address[1]):
                self._stranger()
            elif data:
                return data
        return b""

    def write(self, data: bytes) -> None:
        """Send one datagram.

        Raises:
            OSError: there is no way to the device, or its host has refused an earlier datagram.
        """
        try:
            self._sock.sendto(data, self._address)
        except OSError as error:
            raise self._gone(error) from None

    def close(self) -> None:
        """Release the port."""
        self._sock.close()

    def _gone(self, error: OSError) -> OSError:
        number = error.errno or errno.EIO
        if number == errno.ECONNREFUSED:
            why = "nothing takes datagrams at this port; check host and port"
        else:
            why = f"{os.strerror(number).lower()}; check the host and the network"
        return OSError(number, f"datagrams of {self._peer}: {why}")


def _resolve(host: str, port: int) -> tuple[int, tuple[Any, ...]]:
    """Return family and address of a host; names are taken for IPv4, which is what sensors have."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        found = socket.getaddrinfo(host, port, family, socket.SOCK_DGRAM)
    except socket.gaierror as error:
        raise OSError(errno.ENXIO, f"find the host {host}: {(error.strerror or '').lower()}") from None
    return family, found[0][4]


def _bare(host: str) -> str:
    """Return an address without the interface behind its %, in the kernel's spelling."""
    return host.partition("%")[0]
