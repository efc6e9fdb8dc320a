"""The daemon's side of the fork server, the process that knows the drivers.

The daemon imports no driver. The fork server imports them once, validates their settings, and forks one
process a device, so a driver process starts in milliseconds and shares the pages of its libraries.
A reload starts a fresh fork server, which sees changed driver files.
"""

from __future__ import annotations

import os
import signal
import socket
import time
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any

from sioms.descriptors import receive
from sioms.protocol.driver_verbs import Describe, Spawn
from sioms.protocol.messages import MAX_PACKET, MalformedMessage, decode_reply
from sioms.protocol.verbs import Message

from .fork_server_process import ForkServerProcess, start_fork_server
from .loop import Loop
from .patience import Patience

MAX_ANSWER = 1 << 20
"""Bytes of an answer of the fork server: the description of a device of many thousands of channels is long, even
compressed.
"""
_END_S = 2.0
"""A fork server that has been told to end is killed after so long [s]."""
DIED = -1
"""In the place of the errno of an answer: there is nobody to answer."""
Answer = Callable[[Any, int, str, list[int]], None]
"""Called with (value, errno, text, descriptors)."""


class ForkServer:
    """A fork server process and the requests it has not answered.

    Args:
        loop: the daemon's loop.
        died: called when the process has gone.
        process: one that has just been started; None: start one.
    """

    def __init__(
        self, loop: Loop, died: Callable[[ForkServer], None], process: ForkServerProcess | None = None
    ) -> None:
        self._loop = loop
        self._died = died
        process = process or start_fork_server()
        self._sock, self.pid = socket.socket(fileno=process.fd), process.pid
        self._sock.setblocking(False)
        self._pidfd = os.pidfd_open(self.pid)
        self._answers: dict[int, Answer] = {}
        self._unsent: deque[tuple[int, bytes, list[int]]] = deque()
        """Requests that the socket had no room for, with descriptors of their own; each answer makes room."""
        self._patience = Patience(self.pid)
        self._number = 0
        loop.watch(self._sock.fileno(), self._receive)
        loop.watch(self._pidfd, self._gone)

    def describe(self, device: str, driver: str, settings: dict[str, Any], folder: str, answer: Answer) -> None:
        """Validate a device's settings and describe its blocks."""
        self._request(answer, [], Describe(device, driver, settings, folder))

    def spawn(
        self, device: str, driver: str, settings: dict[str, Any], generation: int, options: dict[str, Any],
        fds: Sequence[int], answer: Answer,
    ) -> None:  # fmt: skip
        """Fork a driver process; answers with its pid and a descriptor of it."""
        self._request(answer, fds, Spawn(device, driver, settings, generation, options))

    def check(self, now_s: float) -> str:
        """Kill it when it owes an answer and is stuck, in a driver's import or stopped; return why, '' while all is
        well.
        """
        if not self._answers or not (why := self._patience.stuck(now_s)):
            return ""
        self._patience.renew(now_s)
        self._kill()
        return why

    def close(self) -> None:
        """End the fork server, also one that is stuck; the drivers it forked live on."""
        while self._unsent:
            for fd in self._unsent.popleft()[2]:
                os.close(fd)
        if self._sock.fileno() >= 0:
            self._loop.unwatch(self._sock.fileno())
            self._sock.close()
            self._loop.after(_END_S, self._kill)

    def _kill(self) -> None:
        if self._pidfd >= 0:
            signal.pidfd_send_signal(self._pidfd, signal.SIGKILL)

    def _gone(self) -> None:
        self._loop.unwatch(self._pidfd)
        os.close(self._pidfd)
        self._pidfd = -1
        if self._sock.fileno() >= 0:
            self._end()

    def _request(self, answer: Answer, fds: Sequence[int], message: Message) -> None:
        self._number += 1
        packet = message.packed(self._number)
        if len(packet) > MAX_PACKET:
            answer(None, 7, f"settings of {len(packet)} bytes; want at most {MAX_PACKET}", [])
            return
        if not self._answers:
            self._patience.renew(time.monotonic())
        self._answers[self._number] = answer
        if self._unsent or not self._send(self._number, packet, fds):
            self._unsent.append((self._number, packet, [os.dup(fd) for fd in fds]))

    def _send(self, number: int, packet: bytes, fds: Sequence[int]) -> bool:
        """Send a request, or answer it when that cannot be; return False when there is no room for it yet."""
        try:
            socket.send_fds(self._sock, [packet], list(fds))
        except BlockingIOError:
            return False
        except OSError as error:
            self._answers.pop(number)(None, DIED, f"the fork server does not answer: {error}", [])
        return True

    def _send_more(self) -> None:
        while self._unsent:
            request = self._unsent.popleft()
            if not self._send(*request):
                self._unsent.appendleft(request)
                return
            for fd in request[2]:
                os.close(fd)

    def _receive(self) -> None:
        try:
            packet, fds = receive(self._sock, MAX_ANSWER, 8)
        except BlockingIOError:
            return
        except OSError:
            packet, fds = b"", []
        if not packet:
            self._end()
            return
        self._patience.renew(time.monotonic())
        self._send_more()
        try:
            message = decode_reply(packet, MAX_ANSWER)
        except MalformedMessage:
            self._end()
            return
        answer = self._answers.pop(message[1], None)
        if answer is None:
            for fd in fds:
                os.close(fd)
        elif message[2]:
            answer(None, message[2], message[3], fds)
        else:
            answer(message[3], 0, "", fds)

    def _end(self) -> None:
        self.close()
        pending, self._answers = self._answers, {}
        for answer in pending.values():
            answer(None, DIED, "the fork server died", [])
        self._died(self)
