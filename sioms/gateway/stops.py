"""The way of stops over ZeroMQ: a port, a thread and sessions at the daemon of their own, so that no other traffic is
ahead.

The same thread answers whose keys may come in (ZAP, RFC 27), which ZeroMQ asks before anything of a peer is passed on.

Concurrency: one thread of its own; it shares with the gateway's the list of keys, which is replaced as a whole.
"""

from __future__ import annotations

import threading
import traceback
from collections.abc import Callable

import zmq
from zmq.utils import z85

from sioms.prompt import be_prompt
from sioms.protocol.link import MalformedFrame
from sioms.protocol.messages import MalformedMessage

from .inflow import Inflow
from .parts import Principal
from .ways import Ways

DOMAIN = b"sioms"


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
        self._principal = principal
        self._inflow = inflow
        self._log = log
        self._ways = Ways(path)
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
        if self._thread.ident is None:  # it has not been started: nobody else lets go
            self._release()
        else:
            self._told.send(b"")
            self._thread.join(2.0)
        self._told.close()

    def _run(self) -> None:
        be_prompt()
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
        self._release()

    def _release(self) -> None:
        self._ways.close()
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
        if answer := self._ways.answer(who, host, frames[0].bytes):
            self._sock.send_multipart((peer.bytes, answer), zmq.DONTWAIT)
