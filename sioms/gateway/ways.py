"""Sessions at the daemon for stops alone, one for each holder of a key: what any transport's way of stops ends in.

Concurrency: one thread of its own, which no other traffic uses.
"""

from __future__ import annotations

import errno
import time
from contextlib import suppress

from sioms.client.cell_verbs import request_stop
from sioms.client.channel import Call, Channel
from sioms.client.connecting import connect
from sioms.protocol import link, verbs
from sioms.protocol.flags import PROTOCOL_VERSION
from sioms.protocol.link import Down, Up
from sioms.protocol.messages import refusal, reply
from sioms.protocol.stopfile import StopRequest
from sioms.protocol.text import printable

from .parts import Principal

MOST_WAYS = 64
"""Sessions at the daemon that are kept for the next stop; the oldest gives way."""


class Way:
    """A session at the daemon on behalf of the holder of a key, for stops alone.

    Raises:
        OSError: the daemon does not take it.
    """

    def __init__(self, path: str, who: Principal, host: str) -> None:
        self._channel = Channel(connect(path), "the daemon")
        self._request: StopRequest | None = None
        try:
            self._channel.call(Call("represent", verbs.Represent(who.name, host, list(who.groups))))
            answer = self._channel.call(Call("hello", verbs.Hello(PROTOCOL_VERSION, "stop")))
            self._request = StopRequest(*answer.fds) if answer.fds else None
        except BaseException:
            self.close()
            raise

    def stop(self, stop: verbs.EmergencyStop) -> int:
        """Stop, if need be without the daemon; return the instant from which readings show it [ns]."""
        why = printable(str(stop.why))
        taken = request_stop(None if stop.node else self._request, why)
        try:
            self._channel.call(Call("emergency stop", stop, enough=taken))
        except OSError:
            if taken is None or not taken():
                raise
        return time.monotonic_ns()

    def close(self) -> None:
        """End the session."""
        self._channel.close()
        if self._request is not None:
            self._request.close()


class Ways:
    """All of them.

    Args:
        path: the daemon's socket.
    """

    def __init__(self, path: str) -> None:
        self._path = path
        self._ways: dict[tuple[Principal, str], Way] = {}

    def answer(self, who: Principal, host: str, frame: bytes) -> bytes | None:
        """Obey a frame of a client; return the frame that answers it, None for one that draws no answer.

        Raises:
            MalformedFrame, MalformedMessage: it is none.
        """
        kind, _, _, _, packet = link.unpack(frame, link.MAX_TO_GATEWAY)
        if kind == Up.HELLO:
            with suppress(OSError):  # it will be tried again, and told, when it matters
                self._way(who, host)
            return None
        number, message = verbs.take(packet, verbs.FROM_CLIENT)
        if kind != Up.PACKET or not isinstance(message, verbs.EmergencyStop):
            return None
        return link.pack(Down.PACKET, body=self._stop(who, host, number, message))

    def _stop(self, who: Principal, host: str, number: int, message: verbs.EmergencyStop) -> bytes:
        for attempt in (0, 1):
            try:
                return reply(number, None, self._way(who, host).stop(message))
            except OSError as error:
                way = self._ways.pop((who, host), None) if error.errno == errno.EIO else None
                if way is not None:  # the daemon has been started again since
                    way.close()
                if way is not None and not attempt:
                    continue
                return refusal(number, error.errno or errno.EIO, error.strerror or str(error))
        raise AssertionError("two attempts")

    def _way(self, who: Principal, host: str) -> Way:
        way = self._ways.get((who, host))
        if way is None:
            way = self._ways[who, host] = Way(self._path, who, host)
            if len(self._ways) > MOST_WAYS:
                self._ways.pop(next(iter(self._ways))).close()
        return way

    def close(self) -> None:
        """End them all."""
        for way in self._ways.values():
            way.close()
        self._ways.clear()
