"""The driver's end of its socket to the daemon: orders overtake what else the daemon has sent.

Concurrency: the one thread of the driver process.
"""

from __future__ import annotations

import os
import socket
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from typing import TypeAlias

from sioms.descriptors import has_ended, receive
from sioms.protocol import driver_verbs
from sioms.protocol.messages import MAX_PACKET, MAX_UNPACKED
from sioms.protocol.verbs import Message, take

MOST_AHEAD = 512
"""More messages than the daemon's socket holds: what is behind them has been sent since they were begun with."""
MOST_UNSENT = 4096
"""Messages that wait for a daemon that is held up; log lines beyond a sixteenth of it are dropped, all beyond it."""
Order: TypeAlias = driver_verbs.NodeStop | driver_verbs.NodeReset
Received: TypeAlias = tuple[Message, list[int]]


class Control:
    """The control socket of a driver process.

    Args:
        fd: its descriptor.
        room: told whether to watch for room in the socket, for ``send_rest``.
    """

    def __init__(self, fd: int, room: Callable[[bool], None] = lambda wanted: None) -> None:
        self._sock = socket.socket(fileno=fd)
        self._sock.setblocking(False)
        self._kept: deque[Received] = deque()
        self._unsent: deque[tuple[bytes, list[int]]] = deque()
        self._room = room

    def fileno(self) -> int:
        return self._sock.fileno()

    @property
    def is_behind(self) -> bool:
        """Whether there are messages to take that orders have overtaken: the descriptor tells nothing of them."""
        return bool(self._kept)

    @property
    def has_ended(self) -> bool:
        """Whether the daemon has gone, and nothing that it has sent is left to take."""
        return not self._kept and has_ended(self._sock)

    def tell(self, message: Message) -> None:
        """Send the daemon a message; when there is room, if it has left none."""
        is_kept = len(self._unsent) < (MOST_UNSENT >> 4 if isinstance(message, driver_verbs.LogLine) else MOST_UNSENT)
        if self._unsent:
            if is_kept:
                self._unsent.append((message.packed(), []))
            return
        try:
            self._sock.send(message.packed())
        except BlockingIOError:
            self._unsent.append((message.packed(), []))
            self._room(True)
        except OSError:
            return  # a daemon that is gone is noticed by its end of file, a hung one by its lease

    @property
    def waits_for_room(self) -> bool:
        """Whether there is something to send for which there was no room."""
        return bool(self._unsent)

    def send_rest(self) -> None:
        """Send what there was no room for."""
        if not self._unsent:
            return
        while self._unsent:
            packet, fds = self._unsent[0]
            try:
                socket.send_fds(self._sock, [packet], fds) if fds else self._sock.send(packet)
            except BlockingIOError:
                return
            except OSError:
                pass  # as above
            self._unsent.popleft()
            for fd in fds:
                os.close(fd)
        self._room(False)

    def tell_ready(self, pages: Sequence[int]) -> None:
        """Tell the daemon that publishing has begun, with the descriptors of the pages; after what was told before."""
        self._unsent.append((driver_verbs.Ready(len(pages)).packed(), [os.dup(fd) for fd in pages]))
        self.send_rest()
        if self._unsent:
            self._room(True)

    def orders(self) -> Iterator[Order]:
        """Give the orders that have come; what lies before and between them is kept for ``take``.

        Whose request waits for it waits for receiving only, not for what the other messages have the driver do.
        """
        for _ in range(MOST_AHEAD):
            try:
                received = self._receive()
            except EOFError:
                return  # it shows again, behind what is kept
            if received is None:
                return
            if isinstance(received[0], Order):
                yield received[0]
            else:
                self._kept.append(received)

    def take(self) -> Received | None:
        """Return the next message and its descriptors; None when there is none.

        Raises:
            EOFError: the daemon has gone.
        """
        return self._kept.popleft() if self._kept else self._receive()

    def close(self) -> None:
        """Close the socket, and the descriptors of what has not been taken or sent."""
        self._sock.close()
        for _, fds in (*self._kept, *self._unsent):
            for fd in fds:
                os.close(fd)

    def _receive(self) -> Received | None:
        try:
            packet, fds = receive(self._sock, MAX_PACKET, 8)
        except BlockingIOError:
            return None
        except ConnectionResetError:
            return self._receive()  # it is reported once, ahead of what is still there to read
        except OSError:
            packet, fds = b"", []
        if not packet:
            raise EOFError
        return take(packet, driver_verbs.TO_DRIVER, values=MAX_UNPACKED)[1], fds
