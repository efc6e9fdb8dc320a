"""Attacks of a holder of a key on rights that it has not, through a gateway: others' nodes, handles and markers, bits
and verbs that are not granted, frames that are sent again, a key that is revoked while it is connected, a name that two
cells claim. Each is tried many times; a local session looks whether anything has come of it.

The attacker speaks the frames of the link by itself: it sends what the client library never would.
"""

from __future__ import annotations

import contextlib
import errno
import random
import subprocess
import time
from collections.abc import Callable, Iterator
from typing import Any, Self

import zmq

from sioms.check.daemon import Daemon
from sioms.check.remote import Gateway
from sioms.client.command import command
from sioms.client.fleet import Fleet
from sioms.client.keys import Folder, Pair
from sioms.client.workcell import Workcell
from sioms.protocol import link, verbs
from sioms.protocol.flags import PROTOCOL_VERSION, Request, Right
from sioms.protocol.link import Down, Up
from sioms.protocol.messages import decode_reply, value_of
from sioms.protocol.records import BINARY_WRITE

from .figures import Bar, Report
from .options import Options
from .reach import cruiser, cruising
from .workcells import axes, workcell

PATIENCE_MS = 300
REVOKED_S = 0.25
"""A revoked key is out by then [s]: the gateway looks ten times a second."""
_GRANTS = """
[[grant]]
keys = ["eva"]
nodes = ["mod0*"]
rights = ["read", "write", "stop"]
[[grant]]
keys = ["mallory"]
nodes = ["mod1*"]
rights = ["read"]
[[grant]]
keys = ["mallory"]
nodes = ["io0.bit0"]
rights = ["read", "write"]
[device.io0]
driver = "sim-io"
outputs = 4
"""


class Attacker:
    """A connection under a key, whose frames are made by hand. Use it in a ``with`` block.

    Args:
        gateway: which it is connected to.
        pair: the key.
        stops: whether to connect to the port of stops.
    """

    def __init__(self, gateway: Gateway, pair: Pair, *, stops: bool = False) -> None:
        self._context = zmq.Context()
        self._sock = sock = self._context.socket(zmq.DEALER)
        sock.curve_publickey, sock.curve_secretkey = pair.public.encode(), pair.secret.encode()
        sock.curve_serverkey, sock.linger = gateway.public.encode(), 0
        sock.setsockopt(zmq.RECONNECT_IVL, -1)
        sock.connect(f"tcp://127.0.0.1:{gateway.port + stops}")
        self.number = self.message = self.told_ns = 0

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._context.destroy(0)

    def begin(self) -> Self:
        """Have the gateway and the daemon take this session in."""
        self.frame(Up.HELLO, link.VERSION)
        self.ask(verbs.Hello(PROTOCOL_VERSION, "attacker"))
        return self

    def frame(self, kind: int, channel: int = 0, body: bytes = b"", *, number: int | None = None) -> bytes:
        """Send a frame; return it."""
        self.number += number is None
        frame = link.pack(kind, channel, self.number if number is None else number, self.told_ns, body)
        with contextlib.suppress(zmq.ZMQError):
            self._sock.send(frame, zmq.DONTWAIT)
        return frame

    def again(self, frame: bytes) -> None:
        """Send a frame as it is."""
        with contextlib.suppress(zmq.ZMQError):
            self._sock.send(frame, zmq.DONTWAIT)

    def came(self, patience_ms: int = PATIENCE_MS) -> Iterator[tuple[int, int, bytes]]:
        """Receive frames; yield kind, channel and body of each."""
        deadline = time.monotonic() + patience_ms / 1e3
        while (left_s := deadline - time.monotonic()) > 0 and self._sock.poll(max(1, int(1e3 * left_s))):
            kind, channel, _, stamp_ns, body = link.unpack(self._sock.recv(), link.MAX_FROM_GATEWAY)
            self.told_ns = max(self.told_ns, stamp_ns)
            if kind == Down.OPENED:
                body = link.take_opened(body)[1]
            yield kind, channel, body

    def ask(self, message: verbs.Message, handle: int = 0, patience_ms: int = PATIENCE_MS) -> tuple[int, Any]:
        """Send a request; return errno and value of its answer: EPROTO, the session has ended; ETIME, none came."""
        self.message += 1
        self.frame(Up.PACKET, handle, message.packed(self.message))
        for kind, _, body in self.came(patience_ms):
            if kind == Down.END:
                return errno.EPROTO, body
            if kind in (Down.PACKET, Down.OPENED, Down.FOLLOWED) and body:
                answer = decode_reply(link.take_followed(body)[0] if kind == Down.FOLLOWED else body)
                if answer[1] in (0, self.message):
                    return answer[2], None if answer[2] else value_of(answer)
        return errno.ETIME, None


class _Scene:
    """Who is attacked: eva, who moves mod0 and has a marker; and a local session that sees everything."""

    def __init__(self, daemon: Daemon, gateway: Gateway, dice: random.Random) -> None:
        self.daemon, self.gateway, self.dice = daemon, gateway, dice
        self._victim: subprocess.Popen[str] | None = None
        self.own = Folder(f"{gateway.folder}/mallory")
        self.pair = self.own.new("mallory")
        self.allow()
        self.cell = daemon.cell("judge")
        self.eva = Workcell(gateway.socket, "victim")
        self.marker = self.eva.reserve_marker()
        self.node = self.cell.open("mod0.readonly")
        self.bits = self.cell.open("io0.readonly")

    def have_a_victim(self) -> None:
        """Start eva's program, in the place of one that is there, and wait until it moves."""
        self.end()
        with contextlib.suppress(OSError):
            self.cell.reset()
        self._victim = cruiser(self.gateway.socket, 10.0)
        with cruising(self._victim, self.cell):
            pass

    def end(self) -> None:
        """End eva's program."""
        if self._victim is not None:
            self._victim.kill()
            self._victim.wait()

    def allow(self) -> None:
        """Let mallory in."""
        self.gateway.keys.allow("mallory", self.pair.public)
        time.sleep(REVOKED_S)

    def attacker(self) -> Attacker:
        """Return a connection of mallory's."""
        return Attacker(self.gateway, self.pair)

    def is_disturbed(self) -> str:
        """Return what has come of attacks, '' for nothing."""
        status = self.cell.status()
        if status["stopped_ns"]:
            return f"the workcell is stopped: {status['stop_source']}"
        seen = self.node.read()
        if not all(seen.commanded_velocity):
            log = [line for line in self.gateway.process.said if "mallory" not in line]
            ended = self._victim.poll() if self._victim is not None else None
            return (
                f"axes of another have halted, status {seen.status}, its program's end {ended}; {' | '.join(log[-2:])}"
            )
        try:
            self.marker.wait(0.0)
            return "another's marker is signalled"
        except OSError as error:
            return "" if error.errno == errno.ETIMEDOUT else f"another's marker: {error.strerror}"


def _has_its_own(scene: _Scene) -> None:
    """See that the attacker gets what it is given: what is refused then is not refused because it is ill made."""
    with scene.attacker() as attacker:
        attacker.begin()
        opened, (code, tokens) = (
            attacker.ask(verbs.Open("mod1.readonly", 1, 0.0, 0.0)),
            attacker.ask(verbs.ReserveMarker(1, False)),
        )
        own = [opened[0], code, *(attacker.ask(verbs.SignalMarker(token))[0] for token in tokens or ())]
    if own != [0, 0, 0]:
        raise RuntimeError(f"attack rights: the attacker does not get its own: errnos {own}")


# --- attacks: each returns whether it got what it is not given ------------------------------------


def _nodes_of_others(scene: _Scene) -> bool:
    node = scene.dice.choice(("mod0", "mod0.a0", "mod0.readonly", "mod1", "mod1.a1", "io0", "io0.bit1", "io0.bit3"))
    message = verbs.Open(node, scene.dice.choice((int(Right.WRITE), 1, 2, 3)), 0.0, scene.dice.choice((0.0, 0.5)))
    with scene.attacker() as attacker:
        code, value = attacker.begin().ask(message)
    is_reading = node.startswith("mod1") and message.access == 1
    return code == 0 and not is_reading and bool(value)


def _handles_of_others(scene: _Scene) -> bool:
    records = command(0, velocity=0.0) if scene.dice.random() < 0.5 else scene.dice.randbytes(64)
    requests: list[verbs.Message] = [
        verbs.Write(1, 0.0, records), verbs.Ioctl(int(Request.STOP), None, 0.0),
        verbs.Ioctl(int(Request.EMERGENCY_STOP), None, 0.0), verbs.Heard(time.monotonic_ns()),
    ]  # fmt: skip
    with scene.attacker() as attacker:
        attacker.begin()
        for handle in scene.dice.sample(range(1, 200), 20):
            attacker.frame(Up.PACKET, handle, scene.dice.choice(requests).packed(5))
            attacker.frame(Up.CLOSED, handle)
        attacker.ask(verbs.Close(scene.dice.randrange(1, 200)))
        return any(kind == Down.PACKET and channel for kind, channel, _ in attacker.came(20))


def _bits_not_granted(scene: _Scene) -> bool:
    """Write through the bit that is granted to those beside it."""
    before = scene.bits.read().data[0] & 0b1110
    with scene.attacker() as attacker:
        code, value = attacker.begin().ask(verbs.Open("io0.bit0", 3, 2.0, 1.0), 0, 3000)
        if code:
            raise RuntimeError(f"attack a bit: the one that is granted is not opened: errno {code}")
        for _ in range(5):
            data, mask = scene.dice.getrandbits(8), scene.dice.choice((0xF, 0xE, 0xFF, scene.dice.getrandbits(63)))
            record = BINARY_WRITE.pack(scene.dice.choice((0, 0, 1, 2)), 0, data, mask)
            attacker.ask(verbs.Write(0, 0.0, record), value[0], 50)
        time.sleep(0.003)
        return bool(scene.bits.read().data[0] & 0b1110 != before)


def _markers_of_others(scene: _Scene) -> bool:
    token = int(scene.marker)
    guesses = [token & 1023, token ^ (1 << scene.dice.randrange(10, 50)), token + 1024, -token, 1 << 60, 0]
    guesses += [token & 1023 | scene.dice.getrandbits(40) << 10 for _ in range(20)]
    with scene.attacker() as attacker:
        attacker.begin()
        make = scene.dice.choice((verbs.SignalMarker, verbs.FreeMarker))
        return any(attacker.ask(make(guess))[0] == 0 for guess in guesses if guess != token)


def _verbs_not_granted(scene: _Scene) -> bool:
    asks: list[verbs.Message] = [
        *(verbs.EmergencyStop(node, "mine", False, 0) for node in ("", "mod0", "mod1")),
        verbs.EmergencyStop("mod9", "mine", True, 0),
        verbs.Supervise(0.05), verbs.Reset("mod0"), verbs.Reset("mod1"), verbs.Reload(), verbs.Journal(""),
        verbs.Journal("mod0"), verbs.Acknowledge("mod0", "mine"), verbs.TellAlarm("mod0.a0", "hot", 2, "mine"),
        verbs.TellAlarm("mod1.a0", "hot", 2, "mine"), verbs.Info("mod0"),
    ]  # fmt: skip
    with scene.attacker() as attacker:
        return attacker.begin().ask(scene.dice.choice(asks))[0] == 0


def _stops_by_their_port(scene: _Scene) -> bool:
    with Attacker(scene.gateway, scene.pair, stops=True) as attacker:
        attacker.frame(Up.HELLO)
        node = scene.dice.choice(("", "mod0", "mod1", "mod9"))
        return attacker.ask(verbs.EmergencyStop(node, "mine", True, 0))[0] == 0


def _names_of_others(scene: _Scene) -> bool:
    """Speak in the name of another, before and after the session is taken in."""
    claim = verbs.Represent("eva", "lab1", ["crew"])
    with scene.attacker() as attacker:
        attacker.frame(Up.HELLO, link.VERSION)
        if scene.dice.random() < 0.5:
            attacker.ask(verbs.Hello(PROTOCOL_VERSION, "attacker"))
        attacker.ask(claim)
        return attacker.ask(verbs.Open("mod0", 2, 0.0, 1.0))[0] == 0


def _frames_again(scene: _Scene) -> bool:
    """Send the frame of a write again and again, and on a new connection."""
    with scene.attacker() as attacker:
        code, value = attacker.begin().ask(verbs.Open("io0.bit0", 3, 2.0, 1.0), 0, 3000)
        if code:
            raise RuntimeError(f"attack by frames again: the bit that is granted is not opened: errno {code}")
        attacker.message += 1
        data = BINARY_WRITE.pack(0, 0, scene.dice.getrandbits(1), 1)
        frame = attacker.frame(Up.PACKET, value[0], verbs.Write(0, 0.0, data).packed(attacker.message))
        for _ in range(20):
            attacker.again(frame)
        answers = 0
        for patience_ms in (3000, 30):  # the first on a busy machine, and any that would follow
            for kind, _, body in attacker.came(patience_ms):
                if kind == Down.PACKET and body and decode_reply(body)[1] == attacker.message:
                    answers += 1
                    break
    with scene.attacker() as attacker:
        attacker.again(frame)
        later = [kind for kind, _, _ in attacker.came(10)]
    if not answers:
        raise RuntimeError("attack by frames again: the write that is granted is not acknowledged")
    return answers > 1 or bool(later)


def _key_revoked(scene: _Scene) -> bool:
    """Go on with a session and a handle when the key has been revoked."""
    with scene.attacker() as attacker:
        code, value = attacker.begin().ask(verbs.Open("io0.bit0", 3, 2.0, 10.0), 0, 3000)
        if code:
            raise RuntimeError(f"attack by a revoked key: it is not let in before: errno {code}")
        scene.gateway.keys.revoke("mallory")
        try:
            late = time.monotonic() + REVOKED_S
            while time.monotonic() < late:
                attacker.ask(verbs.Keepalive(), value[0], 10)
            data = BINARY_WRITE.pack(0, 0, 1, 1)
            asks = ((verbs.Write(0, 0.0, data), value[0]), (verbs.List(), 0), (verbs.Open("mod1", 1, 0.0, 0.0), 0))
            gained = any(attacker.ask(message, handle, 50)[0] == 0 for message, handle in asks)
            with scene.attacker() as other:
                return gained or other.begin().ask(verbs.List(), 0, 50)[0] == 0
        finally:
            scene.allow()


def _names_of_cells(scene: _Scene) -> bool:
    """Have a fleet take a cell for another of the same name, and one for what it is not."""
    address = scene.gateway.socket
    cells: Any = scene.dice.choice(([address, scene.daemon.socket], {"left": address}, [address, address]))
    try:
        with Fleet(cells, "fleet"):
            return True
    except OSError as error:
        return error.errno not in (errno.EEXIST, errno.EINVAL)


ATTACKS: dict[str, Callable[[_Scene], bool]] = {
    "others' nodes": _nodes_of_others, "others' handles": _handles_of_others, "bits not granted": _bits_not_granted,
    "others' markers": _markers_of_others, "verbs not granted": _verbs_not_granted,
    "stops by their port": _stops_by_their_port, "another's name": _names_of_others, "frames again": _frames_again,
    "key revoked while connected": _key_revoked, "a name that two cells claim": _names_of_cells,
}  # fmt: skip
SLOW = ("key revoked while connected",)


def bench_rights(options: Options, report: Report) -> None:
    """Attack, and count what has come of it."""
    with (
        Daemon(workcell([axes("mod0", 2, limits=False), axes("mod1", 2)]) + _GRANTS) as daemon,
        Gateway(daemon.socket) as gateway,
    ):
        scene = _Scene(daemon, gateway, random.Random(options.seed))
        try:
            scene.have_a_victim()
            _has_its_own(scene)
            for what, attack in ATTACKS.items():
                _try(scene, what, attack, options, report)
        finally:
            scene.end()


def _try(scene: _Scene, what: str, attack: Callable[[_Scene], bool], options: Options, report: Report) -> None:
    """Try an attack many times.

    A victim that halts is tried once more with a new one: on a busy machine its own program may have ended it.
    """
    gained, trials = 0, options.slow(3, 100) if what in SLOW else options.kills(10, 1000)
    for trial in range(trials):
        gained += attack(scene)
        if disturbed := scene.is_disturbed():
            report.note(f"{what}, trial {trial}: {disturbed}"[:600])
            scene.have_a_victim()
            gained += attack(scene)
            if again := scene.is_disturbed():
                gained += 1
                report.note(f"{what}, again: {again}"[:600])
                break
        report.progress(f"rights: {what}, {trial} of {trials}")
    report.value(f"rights gained: {what}", gained, bars=[Bar("value", 0)], notes=f"of {trials} tries")
