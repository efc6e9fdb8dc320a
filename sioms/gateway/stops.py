"""The way of stops: a port, a thread and sessions at the daemon of their own, so that no other traffic is ahead.

The same thread answers whose keys may come in (ZAP, RFC 27), which ZeroMQ asks before anything of a peer is passed on.

Concurrency: one thread of its own; it shares with the gateway's the list of keys, which is replaced as a whole.
"""

from __future__ import annotations

import errno
import threading
import time
import traceback
from collections.abc import Callable
from contextlib import suppress

import zmq
from zmq.utils import z85

from sioms.client.cell_verbs import request_stop
from sioms.client.channel import Call, Channel, connect
from sioms.protocol import link, verbs
from sioms.protocol.flags import PROTOCOL_VERSION
from sioms.protocol.link import Down, MalformedFrame, Up
from sioms.protocol.messages import MalformedMessage, refusal, reply
from sioms.protocol.stopfile import StopRequest
from sioms.protocol.text import printable

from .core import Principal
from .inflow import Inflow

DOMAIN = b"sioms"
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


class Stops:
    """The thread.

    Args:
        context: of ZeroMQ.
        sock: the ROUTER for stops, owned from now on.
        path: the daemon's socket.
        principal: tells who holds a public key, None for nobody who may come in.
        inflow: is told what has been taken.
        log: writes a line: level, event, words.
    """

    def __init__(
        self,
        context: zmq.Context[zmq.Socket[bytes]],
        sock: zmq.Socket[bytes],
        path: str,
        principal: Callable[[str], Principal | None],
        inflow: Inflow,
        log: Callable[..., None],
    ) -> None:
        self._sock = sock
        self._path = path
        self._principal = principal
        self._inflow = inflow
        self._log = log
        self._ways: dict[tuple[Principal, str], Way] = {}
        self._zap = context.socket(zmq.REP)
        self._zap.linger = 0
        self._zap.bind("inproc://zeromq.zap.01")  # before any socket listens: nobody is let in unasked
        self._quit = context.socket(zmq.PAIR)
        self._quit.bind("inproc://sioms.stops")
        self._told = context.socket(zmq.PAIR)
        self._told.connect("inproc://sioms.stops")
        self._thread = threading.Thread(target=self._run, name="stops", daemon=True)

    def start(self) -> None:
        """Begin."""
        self._thread.start()

    def close(self) -> None:
        """End, and let go of everything."""
        self._told.send(b"")
        self._thread.join(2.0)
        self._told.close()

    def _run(self) -> None:
        poller = zmq.Poller()
        for sock in (self._zap, self._sock, self._quit):
            poller.register(sock, zmq.POLLIN)
        while True:
            ready = dict(poller.poll())
            if self._sock in ready:
                self._serve(self._take)
            if self._zap in ready:
                self._serve(self._judge)
            if self._quit in ready:
                break
        for way in self._ways.values():
            way.close()
        for each in (self._zap, self._sock, self._quit):
            each.close()

    def _serve(self, take: Callable[[], None]) -> None:
        """Take what has come. A mistake of ours costs what came, not the next stop."""
        try:
            take()
        except (zmq.ZMQError, MalformedFrame, MalformedMessage):
            return
        except Exception as error:
            self._log("error", "internal error", trace="".join(traceback.format_exception(error)[-3:]))

    def _judge(self) -> None:
        """Answer whether a peer may come in; its name from now on is its public key."""
        asked = self._zap.recv_multipart()
        version, number, _, _, _, mechanism = asked[:6]
        public = z85.encode(asked[6]).decode() if mechanism == b"CURVE" and len(asked) == 7 else ""
        good = bool(public) and self._principal(public) is not None
        status, text, name = (b"200", b"OK", public.encode()) if good else (b"400", b"no such key", b"")
        self._zap.send_multipart((version, number, status, text, name, b""))

    def _take(self) -> None:
        peer, *frames = self._sock.recv_multipart(zmq.DONTWAIT, copy=False)
        self._inflow.took(int(frames[0].get(zmq.SRCFD)), sum(map(len, frames)))
        if len(frames) != 1:
            return
        who, host = self._principal(str(frames[0].get("User-Id"))), str(frames[0].get("Peer-Address"))
        if who is None:
            return  # revoked since it came in
        kind, _, _, _, packet = link.unpack(frames[0].bytes, link.MAX_TO_GATEWAY)
        if kind == Up.HELLO:
            with suppress(OSError):  # it will be tried again, and told, when it matters
                self._way(who, host)
            return
        number, message = verbs.take(packet, verbs.FROM_CLIENT)
        if kind != Up.PACKET or not isinstance(message, verbs.EmergencyStop):
            return
        answer = self._stop(who, host, number, message)
        self._sock.send_multipart((peer.bytes, link.pack(Down.PACKET, body=answer)), zmq.DONTWAIT)

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
