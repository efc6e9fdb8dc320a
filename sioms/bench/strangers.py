"""Frames of peers who have no allowed key, to both ports of a gateway over ZeroMQ: none may be taken apart.

Streams of bytes as strangers make them: noise; greetings of other mechanisms, and of CURVE, each with thousands of
frames behind it; the whole of what another sent who was let in, again and with changes; and clients of ZeroMQ whose
keys are not allowed. The gateway counts what it takes apart (``counted_gateway``), and is seen to count what it should.
"""

from __future__ import annotations

import contextlib
import mmap
import random
import socket
import struct
import threading
import time
from collections.abc import Callable
from pathlib import Path

import zmq

from sioms.check.daemon import Daemon, wait_for
from sioms.check.remote import Gateway
from sioms.children import Process
from sioms.client.keys import Pair
from sioms.client.workcell import Workcell
from sioms.protocol import link
from sioms.protocol.link import Up

from .figures import Bar, Report
from .options import Options
from .workcells import axes, workcell

FRAMES = 4000
"""Of a stream: more than the kernel takes before the gateway has ended a connection."""
SETTLE_S = 30.0
KEPT = 400_000
"""Bytes kept of what somebody sends who is let in."""
_BODY = link.pack(Up.HELLO, link.VERSION, 1)


class CountedGateway(Gateway):
    """A gateway that counts the frames that it takes apart.

    Attributes:
        taken: how many, until now.
    """

    def start(self) -> None:
        """Start the process."""
        path = Path(f"{self.folder}/count")
        path.write_bytes(bytes(mmap.PAGESIZE))
        with path.open("r+b") as file:
            self._count = mmap.mmap(file.fileno(), mmap.PAGESIZE)
        place = [*self._place(), "--socket", self._daemon_socket, "--keys", self.keys.path]
        self.process = Process(
            ["sioms.bench.counted_gateway", str(path), "serve", *place], "event=ready", errors=True
        )  # fmt: skip

    @property
    def taken(self) -> int:
        """How many frames it has taken apart."""
        return int(struct.unpack_from("<Q", self._count)[0])


def _overheard(gateway: Gateway, keep: int) -> bytes:
    """Return what a client that is let in sends to a gateway: its greeting, its handshake and sealed frames."""
    kept = bytearray()
    with socket.create_server(("127.0.0.1", 0)) as listener:

        def pass_on() -> None:
            near, _ = listener.accept()
            with near, socket.create_connection(("127.0.0.1", gateway.port)) as far:
                threading.Thread(target=_pump, args=(far, near, bytearray()), daemon=True).start()
                _pump(near, far, kept)

        thread = threading.Thread(target=pass_on, daemon=True)
        thread.start()
        sock, context = _client(gateway, gateway.own.own(), listener.getsockname()[1])
        for number in range(2, keep // len(_BODY)):
            sock.send(link.pack(Up.CREDIT, 0, number))
        wait_for(lambda: len(kept) > keep, 20.0, "a session to be overheard")
        context.destroy(0)
        thread.join(5.0)
    return bytes(kept[:keep])


def _pump(source: socket.socket, sink: socket.socket, kept: bytearray) -> None:
    with contextlib.suppress(OSError):
        while data := source.recv(65536):
            kept += data
            sink.sendall(data)
        sink.shutdown(socket.SHUT_WR)


def _client(gateway: Gateway, pair: Pair | None, port: int) -> tuple[zmq.Socket[bytes], zmq.Context[zmq.Socket[bytes]]]:
    """Return a client of ZeroMQ under a key, which has greeted."""
    assert pair is not None
    context = zmq.Context()
    sock = context.socket(zmq.DEALER)
    sock.curve_publickey, sock.curve_secretkey = pair.public.encode(), pair.secret.encode()
    sock.curve_serverkey, sock.linger = gateway.public.encode(), 0
    sock.setsockopt(zmq.RECONNECT_IVL, -1)
    sock.connect(f"tcp://127.0.0.1:{port}")
    sock.send(_BODY)
    return sock, context


def _greeting(mechanism: bytes) -> bytes:
    """Return that of ZMTP 3.1 of a client."""
    return b"\xff" + bytes(8) + b"\x7f\x03\x01" + mechanism.ljust(20, b"\0") + bytes(32)


def _framed(body: bytes, flags: int = 0) -> bytes:
    """Return a frame of ZMTP: flags are 2 for a long one, and 4 for a command."""
    size = len(body)
    return bytes((flags, size)) + body if size < 256 else bytes((flags | 2,)) + size.to_bytes(8, "big") + body


def _command(name: bytes, body: bytes) -> bytes:
    return _framed(bytes((len(name),)) + name + body, 4)


# --- streams: bytes, and how many frames they are -------------------------------------------------

Stream = tuple[list[bytes], int]


def _noise(dice: random.Random, _: list[bytes]) -> Stream:
    return [dice.randbytes(dice.randrange(1, 600)) for _ in range(8)], 8


def _other_mechanism(dice: random.Random, _: list[bytes]) -> Stream:
    name = dice.choice((b"NULL", b"PLAIN", b"GSSAPI", b"CURVE2", b""))
    ready = _command(dice.choice((b"READY", b"HELLO", b"INITIATE")), dice.randbytes(dice.randrange(40)))
    return [_greeting(name), ready, _framed(_BODY) * FRAMES], FRAMES


def _curve_without_a_key(dice: random.Random, _: list[bytes]) -> Stream:
    hello = _command(b"HELLO", b"\1\0" + bytes(72) + dice.randbytes(120))
    message = _command(b"MESSAGE", dice.randbytes(8) + bytes(16) + _BODY)
    steps = [_greeting(b"CURVE"), hello, _command(b"INITIATE", dice.randbytes(250)), message * FRAMES]
    return steps[: 1 + dice.randrange(3)] + steps[-1:], FRAMES


def _what_another_sent(dice: random.Random, overheard: list[bytes]) -> Stream:
    return overheard, FRAMES


def _what_another_sent_changed(dice: random.Random, overheard: list[bytes]) -> Stream:
    data = bytearray(b"".join(overheard))
    for _ in range(dice.randrange(1, 5)):
        data[dice.randrange(64, 800)] ^= 1 << dice.randrange(8)  # behind the greeting: the handshake, and first frames
    return [bytes(data)], FRAMES


STREAMS: dict[str, Callable[[random.Random, list[bytes]], Stream]] = {
    "noise": _noise, "other mechanisms": _other_mechanism, "CURVE without its handshake": _curve_without_a_key,
    "what another sent, again": _what_another_sent, "the same, changed": _what_another_sent_changed,
}  # fmt: skip


def _send(port: int, steps: list[bytes], frames: int) -> int:
    """Send a stream; return how many of its frames the kernel has taken before the connection ended."""
    total, sent = sum(map(len, steps)), 0
    with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", port), 2.0) as sock:
        sock.settimeout(2.0)
        for step in steps:
            view = memoryview(step)
            while view:
                count = sock.send(view)
                sent, view = sent + count, view[count:]
            if len(steps) > 1:
                sock.settimeout(0.01)
                with contextlib.suppress(TimeoutError):
                    sock.recv(4096)
                sock.settimeout(2.0)
    return frames * sent // total


# --- the bench ------------------------------------------------------------------------------------


def bench_strangers(options: Options, report: Report) -> None:
    """Send them, and see what the gateway has taken apart."""
    wanted, dice = options.frames or options.count(100_000, 10_000_000), random.Random(options.seed)
    with Daemon(workcell([axes("mod0", 1)])) as daemon, CountedGateway(daemon.socket) as gateway:
        overheard = _overheard(gateway, KEPT)
        if not gateway.taken:
            raise RuntimeError("the gateway counts nothing of a client that is let in")
        heard = [overheard[i : i + 65536] for i in range(0, len(overheard), 65536)]
        _settle(gateway)
        sent, connections, before = dict.fromkeys(STREAMS, 0), 0, gateway.taken
        while sum(sent.values()) < wanted:
            what = dice.choice(list(STREAMS))
            steps, frames = STREAMS[what](dice, heard)
            sent[what] += _send(gateway.port + dice.randrange(2), steps, frames)
            connections += 1
            report.progress(f"strangers: {sum(sent.values())} of {wanted}")
        unknown = _unknown_keys(gateway, options.slow(5, 200))
        taken = gateway.taken - before
        told = ", ".join(f"{count} {what}" for what, count in sent.items())
        told = f"in {connections} connections: {told}; and {unknown} clients of unknown keys"
        report.value(
            "frames of strangers taken apart", taken, bars=[Bar("value", 0)],
            notes=f"of {sum(sent.values())} {told}",
        )  # fmt: skip
        _still_serves(gateway, report)


def _settle(gateway: CountedGateway) -> None:
    """Wait until the gateway has taken apart all that has come of a client that was let in: it may be behind."""
    deadline, before = time.monotonic() + SETTLE_S, -1
    while gateway.taken != before and time.monotonic() < deadline:
        before = gateway.taken
        time.sleep(1.0)


def _unknown_keys(gateway: Gateway, count: int) -> int:
    """Have clients of ZeroMQ with keys of their own try to say something; return how many."""
    for each in range(count):
        public, secret = (key.decode() for key in zmq.curve_keypair())
        sock, context = _client(gateway, Pair("stranger", public, secret), gateway.port + each % 2)
        for _ in range(50):
            sock.send(_BODY)
        sock.poll(50)
        context.destroy(0)
    return count


def _still_serves(gateway: CountedGateway, report: Report) -> None:
    begin, before = time.monotonic(), gateway.taken
    with Workcell(gateway.socket, "afterwards") as cell:
        served = bool(cell.nodes()) and gateway.taken > before
    took_ms = 1e3 * (time.monotonic() - begin)
    report.value("the gateway serves others afterwards", int(served), notes=f"connected after {took_ms:.0f} ms")
