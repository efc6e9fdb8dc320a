"""The TCP connection beside a line, for devices that send samples on UDP and take requests elsewhere.

Opened when something is first asked on it, kept while the device keeps it, and opened again after any failure, so
that a late reply is never taken for the next.

Concurrency: owned by the line; driven by ``advance``.
"""

from __future__ import annotations

import errno
from typing import Any

from .connection import Connection, open_connection
from .exchange import DeviceError, Exchange, LinkError
from .settings import LineSettings


class SideConnection:
    """One exchange at a time on a TCP connection.

    Args:
        settings: names it.
    """

    def __init__(self, settings: LineSettings) -> None:
        self.settings = settings
        self._connection: Connection | None = None
        self._exchange: Exchange | None = None
        self._sent = self._is_kept = False
        self._reply = bytearray()
        self._until_ns = 0

    def begin(self, exchange: Exchange, now_ns: int) -> None:
        """Ask; ``advance`` brings the answer. An exchange that is under way is given up."""
        if self._exchange is not None or not self._is_alive():
            self.close()
        self._exchange, self._sent = exchange, False
        self._is_kept = self._connection is not None
        self._reply.clear()
        self._until_ns = now_ns + int(self.settings.connect_timeout_s * 1e9)

    def advance(self, now_ns: int) -> tuple[Any] | None:
        """Do what can be done now.

        Returns:
            The reply's value, in a tuple; None while it has not come.

        Raises:
            LinkError: no connection, no reply, or a damaged one.
            DeviceError: the device refused.
        """
        exchange = self._exchange
        if exchange is None:
            raise RuntimeError("nothing was asked")
        try:
            found = None
            if self._sent:
                found = self._receive(exchange, now_ns)
            else:
                self._transmit(exchange, now_ns)
        except OSError as error:
            self.close()
            raise LinkError(f"{exchange.what}: {error.strerror or error}") from None
        except LinkError:
            self.close()
            raise
        except DeviceError:
            self._exchange = None
            raise
        if found is None and now_ns > self._until_ns:
            self.close()
            why = "no reply within its time-out" if self._sent else "nobody answers there"
            raise LinkError(f"{exchange.what} at {self.settings}: {why}; check its address, power and cable")
        if found is not None:
            self._exchange = None
        return found

    def close(self) -> None:
        """Release the connection."""
        if self._connection is not None:
            self._connection.close()
        self._connection = self._exchange = None

    def _is_alive(self) -> bool:
        """Tell whether the connection is still there, and throw away what came unasked."""
        if self._connection is None:
            return False
        try:
            self._connection.read()
        except OSError:
            return False
        return True

    def _transmit(self, exchange: Exchange, now_ns: int) -> None:
        if self._connection is None:
            self._connection = open_connection(self.settings)
        if self._connection.is_connected():
            self._connection.write(exchange.data)
            self._sent = True
            self._until_ns = now_ns + int(exchange.timeout_s * 1e9)

    def _receive(self, exchange: Exchange, now_ns: int) -> tuple[Any] | None:
        if self._connection is None:
            raise OSError(errno.ENOTCONN, f"{self.settings} is not connected")
        try:
            self._reply += self._connection.read()
        except OSError:
            self._connection.close()
            self._connection = None
            if self._is_kept and exchange.repeatable and not self._reply:
                # the other side was ending it when this was sent, and nothing could tell: ask on a new one
                self._sent = self._is_kept = False
                self._until_ns = now_ns + int(self.settings.connect_timeout_s * 1e9)
                return None
            return (exchange.decode(bytes(self._reply)),)  # the end of the connection may be the end of the reply
        size = exchange.want(bytes(self._reply))
        if size is None or len(self._reply) < size:
            return None
        return (exchange.decode(bytes(self._reply[:size])),)
