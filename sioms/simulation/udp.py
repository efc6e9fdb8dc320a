"""The UDP side of simulated sensors: a port whose datagrams can be dropped, doubled, delayed and cut."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

from .faults import Faults

Address = tuple[str, int]
HELD_UP_S = 0.25
"""Records older than this are not sent: no sensor lags behind its own clock."""


class UdpPort(asyncio.DatagramProtocol):
    """A UDP port of the loopback interface.

    Args:
        faults: of what it sends; ``deaf`` loses what comes.
        received: called with each datagram and its sender.

    Attributes:
        name: ``host:port``.
        sent: datagrams that have left.
    """

    def __init__(self, faults: Faults, received: Callable[[bytes, Address], None] = lambda data, sender: None) -> None:
        self._faults, self._received = faults, received
        self._transport: asyncio.DatagramTransport | None = None
        self.name = ""
        self.sent = 0

    async def open(self, port: int) -> None:
        """Open the port, 0 = a free one."""
        loop = asyncio.get_running_loop()
        self._transport, _ = await loop.create_datagram_endpoint(lambda: self, local_addr=("127.0.0.1", port))
        self.name = "{}:{}".format(*self._transport.get_extra_info("sockname")[:2])

    def send(self, data: bytes, to: Address) -> None:
        """Send a datagram, bent by the faults."""
        for delay_s, bent in self._faults.datagrams(data):
            if delay_s:
                asyncio.get_running_loop().call_later(delay_s, self._send, bent, to)
            else:
                self._send(bent, to)

    def garbage(self, size: int, to: Address) -> None:
        """Send a datagram of random bytes."""
        self._send(self._faults.chance.randbytes(size), to)

    def close(self) -> None:
        """Close the port."""
        if self._transport is not None:
            self._transport.close()

    def datagram_received(self, data: bytes, addr: Address) -> None:
        """Take a datagram."""
        if self._faults.hears():
            self._received(data, addr)

    def error_received(self, exc: Exception) -> None:
        """Nothing: a sensor goes on sending to a host that is no longer there."""

    def _send(self, data: bytes, to: Address) -> None:
        if self._transport is not None and not self._transport.is_closing():
            self._transport.sendto(data, to)
            self.sent += 1


def missed(next_s: float, now_s: float, rate_hz: float) -> int:
    """Return how many records a sensor's time has passed by while its process was held up; a sensor does not make up
    for them.
    """
    return int((now_s - next_s) * rate_hz) if now_s - next_s > HELD_UP_S else 0


async def stream(due: Callable[[], None], next_s: Callable[[], float], clock: Callable[[], float]) -> None:
    """Have what is due sent, as evenly as the event loop can.

    Args:
        due: sends what is due.
        next_s: when the next record is due, 0 while none is.
        clock: whose time that is [s].
    """
    while True:
        due()
        at_s = next_s()
        await asyncio.sleep(max(0.0002, at_s - clock()) if at_s else 0.002)
