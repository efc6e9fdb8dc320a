"""Sessions at the daemon for stops alone, one for each holder of a key: what any transport's way of stops ends in.

Concurrency: one thread of its own, which no other traffic uses; ``Ways.begin`` may be called in any.
"""

from __future__ import annotations

import errno
import threading
import time
from contextlib import suppress

from sioms.client.cell_verbs import Asked, request_stop, stop_call
from sioms.client.channel import Call, Channel
from sioms.client.connecting import connect
from sioms.protocol import link, verbs
from sioms.protocol.flags import PROTOCOL_VERSION
from sioms.protocol.link import Down, MalformedFrame, Up
from sioms.protocol.messages import MalformedMessage, refusal, reply
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
        self._begins = threading.Lock()
        try:
            self._channel.call(Call("represent", verbs.Represent(who.name, host, list(who.groups))))
            answer = self._channel.call(Call("hello", verbs.Hello(PROTOCOL_VERSION, "stop")))
            self._request = StopRequest(*answer.fds.take()) if answer.fds else None
        except BaseException:
            self.close()
            raise

    def begin(self, stop: verbs.EmergencyStop) -> Asked | None:
        """Have all drivers brake, if it is for the workcell and its holder may stop that. In any thread."""
        if stop.node:
            return None
        with self._begins:  # a descriptor that is closed meanwhile would be another file's
            return request_stop(self._request, printable(str(stop.why)))

    def stop(self, stop: verbs.EmergencyStop, begun: Asked | None = None) -> int:
        """Stop, if need be without the daemon; return the instant from which readings show it [ns].

        Args:
            stop: what is asked for.
            begun: what ``begin`` returned for it; None: it is to begin now.
        """
        taken = begun or self.begin(stop)
        try:
            self._channel.call(stop_call(stop.node, stop.why, stop.or_all, taken))  # the word is ours, not the client's
        except OSError:
            if taken is None or not taken():
                raise
        return time.monotonic_ns()

    def close(self) -> None:
        """End the session."""
        self._channel.close()
        with self._begins:
            request, self._request = self._request, None
        if request is not None:
            request.close()


class Ways:
    """All of them.

    Args:
        path: the daemon's socket.
    """

    def __init__(self, path: str) -> None:
        self._path = path
        self._ways: dict[tuple[Principal, str], Way] = {}
        self._of: dict[Principal, Way] = {}

    def begin(self, who: Principal | None, frame: bytes) -> Asked | None:
        """Have all drivers brake, if a frame stops the workcell and its sender has a session here; it is still to be
        answered. In any thread, and at once: there is nothing in it that waits.

        Returns:
            What ``answer`` is to be told; None: it has not begun, and ``answer`` begins it.
        """
        way = self._of.get(who) if who is not None else None
        if way is None:
            return None
        try:
            kind, _, _, _, packet = link.unpack(frame, link.MAX_TO_GATEWAY)
            message = verbs.take(packet, verbs.FROM_CLIENT)[1] if kind == Up.PACKET else None
        except (MalformedFrame, MalformedMessage):
            return None
        return way.begin(message) if isinstance(message, verbs.EmergencyStop) else None

    def answer(self, who: Principal, host: str, frame: bytes, begun: Asked | None = None) -> bytes | None:
        """Obey a frame of a client; return the frame that answers it, None for one that draws no answer.

        Args:
            who, host: whose it is, and where that is.
            frame: as it came.
            begun: what ``begin`` returned for it.

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
        answer = self._stop(who, host, number, message, begun)
        return link.pack(Down.PACKET, stamp_ns=time.monotonic_ns(), body=answer)

    def _stop(
        self, who: Principal, host: str, number: int, message: verbs.EmergencyStop, begun: Asked | None = None
    ) -> bytes:
        for attempt in (0, 1):
            try:
                return reply(number, None, self._way(who, host).stop(message, None if attempt else begun))
            except OSError as error:
                way = self._ways.pop((who, host), None) if error.errno == errno.EIO else None
                if way is not None:  # the daemon has been started again since
                    self._drop(who, way)
                if way is not None and not attempt:
                    continue
                text = error.strerror or str(error)
                return refusal(number, error.errno or errno.EIO, text, time.monotonic_ns())  # it may have stopped more
        raise AssertionError("two attempts")

    def _way(self, who: Principal, host: str) -> Way:
        way = self._ways.get((who, host))
        if way is None:
            way = self._ways[who, host] = self._of[who] = Way(self._path, who, host)
            if len(self._ways) > MOST_WAYS:
                oldest = next(iter(self._ways))
                self._drop(oldest[0], self._ways.pop(oldest))
        return way

    def _drop(self, who: Principal, way: Way) -> None:
        if self._of.get(who) is way:
            del self._of[who]
        way.close()

    def close(self) -> None:
        """End them all."""
        for way in self._ways.values():
            way.close()
        self._ways.clear()
        self._of.clear()
