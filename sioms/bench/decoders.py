"""Decoders of what strangers send or write: each with bytes to begin with, and what it may raise.

A target takes any bytes. What it raises beside what it names is a finding, and so is more memory or time than a few
times its input. ``sioms bench fuzz`` searches for hours; a unit test replays in seconds what was found.

This module alone of the bench imports what daemon, drivers and laboratories read with.
"""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from importlib.metadata import entry_points
from importlib.resources import files
from pathlib import Path
from typing import Any

import msgpack
import numpy as np

from sioms.check.traces import BadTrace, read_trace
from sioms.client.keys import Folder
from sioms.daemon.config import parse as parse_config
from sioms.documents import json_of, toml_of
from sioms.drivers.ascii_stream.codec import LineReceiver
from sioms.drivers.ati_rdt.codec import parse as parse_rdt
from sioms.drivers.framed_adc.cobs import FrameReceiver
from sioms.drivers.framed_adc.codec import parse_samples
from sioms.drivers.ft300.codec import RecordReceiver
from sioms.drivers.iio.codec import Element, Layout, ScanReceiver, parse_type
from sioms.drivers.modbus.regmap_files import RegisterMapError, parse_map
from sioms.drivers.schunk_ft.codec import parse as parse_schunk
from sioms.gateway.core import OWN_NUMBERS, Gateway
from sioms.gateway.parts import Principal
from sioms.lab.arrays import UnreadableError, read_npz
from sioms.lab.mat import read_mat
from sioms.plant.effects import EffectsError, parse_effects
from sioms.protocol import link, verbs, wire
from sioms.protocol.clock import Wall
from sioms.protocol.driver_verbs import FROM_DRIVER, TO_DRIVER, TO_FORK_SERVER, DriverVerb, ForkServerVerb
from sioms.protocol.flags import NodeClass, PageState
from sioms.protocol.journal import HEADER, JournalReader, JournalWriter, Note, pack_events, take_events
from sioms.protocol.journal import Event as Noted
from sioms.protocol.messages import (
    MAX_PACKET,
    ClientVerb,
    HandleVerb,
    MalformedMessage,
    decode,
    decode_reply,
    encode,
    refusal,
    reply,
    value_of,
)
from sioms.protocol.nodeinfo import ChannelInfo, NodeInfo
from sioms.protocol.page import PageReader, PageWriter, page_size
from sioms.protocol.stopfile import StopRequest
from sioms.protocol.stopjournal import Stopped, entries_from, node_entry, replay, workcell_entry
from sioms.protocol.text import printable, shown
from sioms.protocol.verbs import FROM_CLIENT, ON_HANDLE, take
from sioms.reconcile.errors import BadInputError
from sioms.reconcile.files.axis import read_model
from sioms.reconcile.files.table import load_table
from sioms.reconcile.live.force import read_stand
from sioms.recording import mcap
from sioms.recording.messages import EVENT, EVENTS, Event, NodeFormat
from sioms.recording.reader import Recording
from sioms.recording.rewrite import LIBRARY, rewrite
from sioms.recording.story import sentence, tell, utc
from sioms.recording.tables import columns_of
from sioms.sdk.exchange import DeviceError, LinkError
from sioms.sdk.golden import Golden, Incomplete, read_reply
from sioms.sdk.persistence import Contents, Entry
from sioms.sdk.persistence import decode as decode_positions
from sioms.sdk.persistence import encode as encode_positions
from sioms.tactile.cylinder import Cylinder
from sioms.tactile.files import read_recording
from sioms.tactile.finger import from_toml, nominal_finger, to_toml
from sioms.tools.tokens import Tokens


@dataclass(frozen=True)
class Target:
    """A decoder.

    Args:
        run: is fed any bytes.
        seeds: bytes that it takes.
        raises: what it may raise.
        share: of the files, or, where it takes frames, of these.
        frames: whether it takes messages of a wire, as against files.
    """

    run: Callable[[bytes], object]
    seeds: Sequence[bytes]
    raises: tuple[type[Exception], ...]
    share: int = 1
    frames: bool = False


def _link(data: bytes) -> None:
    """Each body of a frame of the link is taken or malformed."""
    for decode_body in (
        link.take_opened, link.take_ping, link.take_pong, lambda body: link.Update.take(body, 8),
        lambda body: link.unpack(body, link.MAX_TO_GATEWAY),
    ):  # fmt: skip
        with suppress(link.MalformedFrame):
            decode_body(data)


def _events(data: bytes) -> None:
    """Events of a journal come into its copy with their numbers, or are malformed."""
    memory = bytearray(HEADER + 4096)
    writer, reader = JournalWriter(memoryview(memory)), JournalReader(memory)
    try:
        _, events = link.take_followed(data)
        found = [event for event in take_events(events) if len(event.payload) < 1024]
    except (link.MalformedFrame, MalformedMessage):
        return
    for event in found:
        writer.put(event)
        (copy,) = reader.read()
        assert (copy.number, copy.kind, copy.payload) == (event.number, event.kind, event.payload)


def _message(data: bytes) -> None:
    """The two decoders agree, and what they take can be shown and packed again."""
    try:
        plain = wire.unpack(data)
    except (ValueError, UnicodeDecodeError):
        plain = None
    try:
        message = decode(data)
    except MalformedMessage as error:
        assert str(error).isprintable()
        return
    assert repr(message) == repr(plain) or len(data) > MAX_PACKET
    assert shown(message).isprintable()
    assert repr(decode(encode(*message))) == repr(message)
    verbs = (FROM_CLIENT, ON_HANDLE, TO_DRIVER, FROM_DRIVER, TO_FORK_SERVER)[len(data) % 5]
    try:
        _, taken = take(data, verbs)
    except MalformedMessage as error:
        assert str(error).isprintable()
    else:
        assert len(taken) == len(verbs[message[0]].fields)


def _reply(data: bytes) -> None:
    value_of(decode_reply(data))


def _config(data: bytes) -> None:
    _, errors = parse_config(data.decode("utf-8", "replace"), "/")
    assert all(errors)


def _text(data: bytes) -> None:
    text = printable(data.decode("utf-8", "surrogateescape"), 100)
    assert text.isprintable() and len(text) <= 100


def _file(read: Callable[[Path], object], suffix: str) -> Callable[[bytes], object]:
    """A reader of files, of bytes in memory."""

    def run(data: bytes) -> object:
        with tempfile.NamedTemporaryFile(dir="/dev/shm", suffix=suffix) as file:
            file.write(data)
            file.flush()
            return read(Path(file.name))

    return run


def _golden() -> list[Golden]:
    found = []
    for entry in sorted(entry_points(group="sioms.drivers"), key=lambda each: each.name):
        try:
            found += [golden for golden in entry.load().golden(None) if golden.reply]
        except (ImportError, AttributeError, TypeError):
            continue  # without its library, or for golden frames of certain settings only
    if not found:
        raise RuntimeError("find golden frames of the drivers: none; install this tree again")
    return found


GOLDEN = _golden()


def _device(data: bytes) -> object:
    """The decoder of one exchange with a device: the first byte chooses which."""
    return read_reply(GOLDEN[data[0] % len(GOLDEN)], data[1:], max(len(data) - 1, 1)) if data else None


def _streams(data: bytes) -> None:
    cut = len(data) // 3
    for receiver in (FrameReceiver(), RecordReceiver(), LineReceiver(3), LineReceiver(1, True)):
        for part in (data[:cut], data[cut:]):
            receiver.feed(part)
    for parse in (parse_rdt, parse_schunk, parse_samples):
        parse(data)
    scans = ScanReceiver(SCAN.size)
    for part in (data[:cut], data[cut:]):
        SCAN.decode(scans.feed(part))


SCAN = Layout([Element("a", 0, parse_type("le:s12/16>>4")), Element("b", 1, parse_type("be:u24/32>>0"))])


def _pipe(data: bytes) -> None:
    """What comes through a pipe ends the tool with a sentence, or gives finite numbers."""
    for skip in (False, True):
        tokens = Tokens(skip)
        for part in (data[: len(data) // 2], data[len(data) // 2 :], b""):
            tokens.feed(part)
        assert all(-1e400 < value < 1e400 for value, _ in tokens.numbers)
        assert tokens.bad.isprintable() and all(text.isprintable() for text in tokens.skipped)


def _journal(data: bytes) -> Stopped:
    """A journal whose last line has no end has stopped the workcell."""
    found = replay(data, 0, 1.0)
    assert found.workcell or not data.rpartition(b"\n")[2].strip(b"\0")
    replay(data, 1, 1.0)
    entries, _ = entries_from(data)
    again = Stopped()
    for entry in entries:
        again.take(entry)
    found.nodes()
    for entry in found.entries():
        Stopped().apply(entry)
    return found


def _stop_request(data: bytes) -> None:
    with tempfile.TemporaryFile(dir="/dev/shm") as file, tempfile.TemporaryFile(dir="/dev/shm") as taken:
        file.write(data)
        file.flush()
        request = StopRequest(os.dup(file.fileno()), os.dup(taken.fileno()))
        assert request.source.isprintable()
        request.take(request.mark)
        request.close()


def _positions(data: bytes) -> Contents:
    found = decode_positions(data)
    decode_positions(encode_positions(found))
    return found


class _Far:
    """What is around a gateway: a daemon that takes a session in and grants every open, a driver that takes all."""

    def __init__(self) -> None:
        memory = bytearray(page_size(NodeClass.AXIS, 1, 8))
        PageWriter(memoryview(memory), NodeClass.AXIS, 1, 8, 10**12, 1, 77).set_state(PageState.GOOD)
        self.page = PageReader(memory)
        self.shape = link.PageShape(NodeClass.AXIS, 1, 8, 10**12, 1, 77)
        self.answers: list[tuple[bytes, Sequence[int]]] = []
        self.told_ns = 0

    def send(self, peer: bytes, frame: bytes) -> bool:
        """Take what goes to a client: the next frame of it repeats its time."""
        self.told_ns = link.unpack(frame, link.MAX_FROM_GATEWAY)[3]
        return True

    def connect(self, session: object) -> _Line:
        return _Line(self)

    def attach(self, session: object, handle: int, fds: object) -> _Node:
        return _Node(self)

    def follow(self, session: object, fds: object) -> _Journal:
        return _Journal()

    def drop(self, fds: object) -> None: ...

    def log(self, level: str, event: str, **words: object) -> None:
        assert level != "error", words


class _Line:
    """A connection to that daemon."""

    def __init__(self, far: _Far) -> None:
        self._answers = far.answers

    def send(self, packet: bytes) -> None:
        """Answer a request."""
        number, message = verbs.take(packet, verbs.FROM_CLIENT)
        match message:
            case verbs.Info():
                self._answers.append((reply(number, ["mod0", 3, False, []]), ()))
            case verbs.Journal():
                self._answers.append((reply(number, 0), (0, 0)))
            case verbs.Open():
                self._answers.append((reply(number, [number, [], [0], -1, [1, 1]]), (0, 0, 0)))
            case _ if number and number != OWN_NUMBERS:  # 0: a notice, which has no answer
                self._answers.append((reply(number), ()))

    def close(self) -> None: ...


class _Journal:
    """A journal of it, which never ends."""

    def read(self, most_bytes: int) -> list[Noted]:
        return [Noted(Note.CLOSED, 1, 7, b"\x90")]

    def close(self) -> None: ...


class _Node:
    """A node of it."""

    def __init__(self, far: _Far) -> None:
        self.page, self.shape = far.page, far.shape

    def send(self, packet: bytes) -> None: ...

    def end(self) -> None: ...

    def close(self) -> None: ...


def _gateway(data: bytes) -> None:
    """Frames of a client that is let in: a kind, a handle and a length each. No more than its session ends."""
    far, now_ns = _Far(), 10**9
    gateway = Gateway(far, lambda: now_ns, lambda: Wall(5, 7, 1))
    gateway.frame(b"other", Principal("other"), "h", link.pack(link.Up.HELLO, link.VERSION, 1))
    at = number = 0
    while at + 3 <= len(data) and number < 100:
        kind, channel, size = data[at : at + 3]
        body, at, number = data[at + 3 : at + 3 + size], at + 3 + size, number + 1
        now_ns += 1_000_000 * (kind >> 4)
        head = (kind & 15, channel or link.VERSION * (number == 1), number, far.told_ns)
        gateway.frame(b"peer", Principal("a"), "h", link.pack(*head, body))
        session = gateway.sessions.get(b"peer")
        if session is not None and session.line is not None and not session.taken_in:
            gateway.daemon_packet(session, reply(OWN_NUMBERS))
        while far.answers and b"peer" in gateway.sessions:
            gateway.daemon_packet(gateway.sessions[b"peer"], *far.answers.pop(0))
        far.answers.clear()
        gateway.tick()
    assert b"other" in gateway.sessions
    assert all(held.lease_ns for session in gateway.sessions.values() for held in session.held.values())


def _frames(*frames: tuple[int, int, bytes]) -> bytes:
    return b"".join([bytes([kind, channel, len(body)]) + body for kind, channel, body in frames])


def _keys(data: bytes) -> object:
    """The files of a folder of keys."""
    with tempfile.TemporaryDirectory(dir="/dev/shm") as path:
        folder = Folder(path)
        for name in ("secret", "allowed", "trusted"):
            fd = os.open(folder.file(name), os.O_WRONLY | os.O_CREAT, 0o600)
            with open(fd, "wb") as file:
                file.write(data)
        with suppress(OSError):
            folder.own()
        with suppress(OSError):
            folder.trusted()
        return folder.allowed()


def _mcap(path: Path) -> None:
    """All that is done with a recording."""
    with Recording(path) as recording:
        first, last, _ = recording.span()
        events = recording.events()
        told = [f"{utc(event.stamp_ns + recording.offset_ns)} {sentence(event)}" for event in events]
        assert all(
            isinstance(line, str) for line in (utc(first), utc(last), tell(events).text, *told, *recording.damage)
        )
        for name in list(recording.nodes)[:3]:
            columns_of(recording, name)
        lost = set(recording.damage)
    packed = path.with_suffix(".packed")
    try:
        rewrite([str(path)], str(packed))
        with Recording(packed) as recording:
            assert recording.span() and lost.issuperset(recording.damage)
    finally:
        packed.unlink(missing_ok=True)


def _recorded() -> bytes:
    """A live recording of an axis, with an event."""
    schemas: list[bytes] = []

    def schema(name: str, text: str) -> int:
        schemas.append(mcap.Schema(len(schemas) + 1, name, "ros2msg", text.encode()).packed())
        return len(schemas)

    info = NodeInfo(
        ["x", int(NodeClass.AXIS), False, [ChannelInfo("a", "m").pack()], -1, 1000.0, 16, "dev", "sim-axes", 2]
    )
    event = Event(5, 1, "dev", "stop", "x", "eva", 0, "why", {"stop": "EMERGENCY"}, b"raw").packed()
    node = NodeFormat(info, -1, 2, schema, 10**18)
    channels = [mcap.Channel(1, schema(*EVENT), EVENTS, "cdr"), *node.channels]
    slots = np.arange(4 * (4 + 13), dtype="<u8").reshape(4, -1)
    about = mcap.metadata("sioms", {"offset_ns": str(10**18), "workcell": "w"})
    parts = [mcap.header(LIBRARY), about, *schemas, *[channel.packed() for channel in channels]]
    return b"".join([*parts, node.messages(slots), mcap.message(1, 1, 10**18 + 5, event)])


def _packed_again(data: bytes) -> bytes:
    with tempfile.TemporaryDirectory(dir="/dev/shm") as folder:
        path = Path(folder, "a")
        path.write_bytes(data)
        rewrite([str(path)], str(path))
        return path.read_bytes()


def _saved(save: Callable[[Any], None]) -> bytes:
    with tempfile.TemporaryFile() as file:
        save(file)
        file.seek(0)
        return file.read()


def _mat(file: Any, packed: bool | None = None) -> None:
    """Save a MAT file of version 5, packed or not, or of version 4."""
    from scipy.io import savemat

    given: dict[str, Any] = {"a": np.ones(3), "b": "text", "d": np.ones((2, 2), "i2"), "z": np.ones(2) * 1j}
    if packed is None:
        savemat(file, given, format="4")
        return
    given |= {"c": np.array([1, "x"], dtype=object), "s": {"t": np.ones(4, "u1"), "deep": {"x": np.ones(2, "f4")}}}
    savemat(file, given, do_compression=packed)


def _finger() -> bytes:
    return to_toml(
        nominal_finger(Cylinder(4.8e-3, 6.35e-3, 0.49, 1.5e5), np.linspace(-0.5, 0.5, 4), 5.8e-3, 1.0, 5e-4)
    ).encode()


MAP = (files("sioms.drivers") / "modbus" / "maps" / "leadshine.toml").read_bytes()
AXIS = b"""{"kind": "linear", "unit_position": "m", "unit_force": "N", "sample_time": 0.001, "inertia": 12.4, "viscous": 3.9,
"encoder_resolution": 5e-08, "index_pitch": 0.01, "start_position": 0.0, "position_max_speed": 0.32, "max_acceleration": 5.1,
"controller": {"k": 2.3e5, "kz": -0.98, "kp": -0.67, "kb": -0.59, "tau_o": 0.0, "tau_m": 163.2, "vel_filter_hz": 100.0}}"""  # noqa: E501
STAND = b'[[push]]\nname = "x"\naxis = "a"\nreference = "r"\nwrench = [1.0, 0.0]\nmost = 5.0\n[[hang]]\nname = "w"\nwrench = [0, 1]\nloads = [2.0]\n'  # noqa: E501
TRACE = b"""{"sioms_trace": 1, "device": "a", "driver": "b", "table": {}}
{"t": 1, "n": 0, "e": "open", "text": ""}\n{"t": 2, "n": 0, "d": ">", "b": "00ff"}\n{"t": 3, "n": 0, "d": "<", "b": ""}
"""
JOURNAL = (
    b"\n".join(
        json.dumps({"at": 1.0, **entry}).encode()
        for entry in (
            workcell_entry("a", stop=True),
            node_entry("n", "d", "b", [(0, 0), (1, 3)], "me", stop=True),
            {"checkpoint": [node_entry("n", "d", "b", [(2, 0)], "me", stop=True)], "from": 0},
            workcell_entry("a", stop=False),
        )
    )
    + b"\n"
)
CONFIG = (
    b'[workcell]\nname = "a"\n[device.io0]\ndriver = "sim-io"\noutputs = 8\n[[grant]]\nrights = ["read"]\n'
    b'[node.x]\nof = "io0"\n[[alarm]]\nnode = "x"\nhigh = 1.0\n[[emergency_stop]]\nnode = "x"\n'
)
TARGETS = {
    "message": Target(
        _message,
        [
            encode(ClientVerb.OPEN, 2, "mod0", 3, 0.5, 0.0),
            encode(HandleVerb.IOCTL, 2, 23, {"position_max": [0.2, None]}, 0.0),
            encode(HandleVerb.WRITE, 1, 0, None, bytes(144)),
            encode(DriverVerb.LOG, 0, "error", "no"),
            encode(ForkServerVerb.DESCRIBE, 1, "a", "b", {"c": [1, -5, True]}, "/"),
            b"\x95\x02\x01\x1b" + b"\x91" * 40 + b"\xc0\x00",
            msgpack.packb([1, 1, msgpack.ExtType(5, b"x"), 1 << 63]),
        ],
        (),
        4,
        True,
    ),
    "reply": Target(
        _reply, [reply(1, {"a": [1]}, 5), refusal(1, 5, "no"), reply(1, ["x"] * 70_000)], (MalformedMessage,), 3, True
    ),
    "device": Target(
        _device,
        [bytes([i]) + bytes.fromhex(golden.reply) for i, golden in enumerate(GOLDEN[:256])],
        (LinkError, DeviceError, Incomplete),
        7,
        True,
    ),
    "link": Target(
        _link,
        [
            link.pack(17, 1, 2, 3, b"x"),
            link.ping(3),
            link.pong(1, 2, 3, 4, 1),
            link.opened(link.PageShape(NodeClass.AXIS, 3, 64, 10**8, 2, 9), b"packet"),
            link.Update(9, 1, 2, b"why", True, 1, bytes(8)).packed(),
        ],
        (),
        2,
        True,
    ),
    "events": Target(_events, [link.followed(b"answer", pack_events([Noted(8, 5, 7, b"\x90")] * 2))], (), 1, True),
    "streams": Target(
        _streams,
        [b"1.0, 2.0, 3.0\n1,2,3\n", bytes.fromhex("ff204ed8fe2efb2e16640038ff2c017daf"), bytes(36)],
        (),
        2,
        True,
    ),
    "text": Target(_text, [b"a\x1b[2J\r\n", "µ\u202e".encode()], (), 1, True),
    "pipe": Target(_pipe, [b"1 2.5e-3\n-4\n", b"1 two\n3\n"], (), 2, True),
    "config": Target(_config, [CONFIG], (), 6),
    "toml": Target(toml_of, [CONFIG, b"x = [{ a = 1979-05-27 }]"], (ValueError,), 3),
    "json": Target(json_of, [b'{"a": [1, -2.5e3, null, "x"]}'], (ValueError,)),
    "register map": Target(lambda data: parse_map(toml_of(data), "x"), [MAP], (RegisterMapError, ValueError)),
    "effects": Target(
        lambda data: parse_effects(data.decode("latin-1"), ["x"]), [b"[x.payload]\nmass = 0.5\n"], (EffectsError,)
    ),
    "finger": Target(lambda data: from_toml(data.decode("latin-1")), [_finger()], (ValueError,)),
    "model": Target(_file(read_model, ".json"), [AXIS], (BadInputError,)),
    "stand": Target(_file(lambda path: read_stand(path, 2), ".toml"), [STAND], (BadInputError,)),
    "npz": Target(
        _file(read_npz, ".npz"),
        [_saved(lambda f: np.savez(f, raw=np.ones((2, 3)), time=np.arange(2.0)))],
        (UnreadableError,),
    ),
    "recording": Target(
        _file(read_recording, ".npz"),
        [_saved(lambda f: np.savez(f, raw=np.ones((2, 3)), time=np.arange(2.0)))],
        (ValueError,),
    ),
    "mat": Target(
        _file(read_mat, ".mat"),
        [_saved(partial(_mat, packed=packed)) for packed in (True, False, None)],
        (UnreadableError,),
    ),
    "table": Target(_file(load_table, ".csv"), [b"time [s],position [m]\n0.0,1.0\n0.1,2.0\n0.2,3\n"], (BadInputError,)),
    "trace": Target(_file(read_trace, ".trace"), [TRACE], (BadTrace,)),
    "positions": Target(
        _positions,
        [encode_positions(Contents({"x": Entry(3, 0.5, 1.0), "y": Entry(0, -1.0, 2.0)}, True, "boot"))],
        (ValueError,),
    ),
    "journal of stops": Target(_journal, [JOURNAL], (), 2),
    "gateway": Target(
        _gateway,
        [
            _frames(
                (link.Up.HELLO, 0, b""),
                (link.Up.PACKET, 0, verbs.Hello(2, "a").packed(1)),
                (link.Up.PACKET, 0, verbs.Open("mod0", 3, 0.0, 0.1).packed(2)),
                (link.Up.PACKET, 0, verbs.Journal("mod0").packed(3)),
                (link.Up.PACKET, 2, b"write"),
                (link.Up.CREDIT, 2, b""),
                (link.Up.CREDIT, 2, b"\2"),
                (link.Up.PING, 0, link.ping(1)),
                (link.Up.CLOSED, 2, b""),
                (link.Up.BYE, 0, b""),
            )
        ],
        (),
        2,
        True,
    ),
    "keys": Target(_keys, [b"eva " + b"a1-Z." * 8 + b" crew,ops\n# no\nben " + b"b2+Y." * 8], (OSError,)),
    "recording of a workcell": Target(_file(_mcap, ".mcap"), [_recorded(), _packed_again(_recorded())], (OSError,), 2),
    "stop request": Target(_stop_request, [bytes(16) + b"why", b"\xff" * 300], ()),
}


def feed(target: Target, data: bytes) -> bool:
    """Feed bytes to a target; return whether it took them."""
    try:
        target.run(data)
    except target.raises as error:
        if not str(error).strip():
            raise AssertionError(f"{type(error).__name__} without a word") from error
        return False
    return True
