"""Decoders of what strangers send or write: each with bytes to begin with, and what it may raise.

A target takes any bytes. What it raises beside what it names is a finding, and so is more memory or time than a few times
its input. ``test_corpus.py`` replays what was found and random changes of it in seconds; ``run.py`` searches for hours.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.metadata import entry_points
from importlib.resources import files
from pathlib import Path

import msgpack
import numpy as np

from sioms.daemon.config import parse as parse_config
from sioms.documents import json_of, toml_of
from sioms.drivers.ascii_stream.codec import LineReceiver
from sioms.drivers.ati_rdt.codec import parse as parse_rdt
from sioms.drivers.framed_adc.cobs import FrameReceiver
from sioms.drivers.framed_adc.codec import parse_samples
from sioms.drivers.ft300.codec import RecordReceiver
from sioms.drivers.modbus.regmap import RegisterMapError, parse_map
from sioms.drivers.schunk_ft.codec import parse as parse_schunk
from sioms.lab.arrays import UnreadableError, read_mat, read_npz
from sioms.plant.effects import EffectsError, parse_effects
from sioms.protocol import wire
from sioms.protocol.driver_verbs import FROM_DRIVER, TO_DRIVER, TO_NURSERY, DriverVerb, NurseryVerb
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
from sioms.protocol.text import printable, shown
from sioms.protocol.verbs import FROM_CLIENT, ON_HANDLE, take
from sioms.reconcile.errors import BadInputError
from sioms.reconcile.files.axis import read_model
from sioms.reconcile.files.table import load_table
from sioms.sdk.exchange import DeviceError, LinkError
from sioms.sdk.golden import Golden, Incomplete, _read
from sioms.tactile.cylinder import Cylinder
from sioms.tactile.finger import from_toml, nominal_finger, to_toml


@dataclass(frozen=True)
class Target:
    """A decoder.

    Args:
        run: is fed any bytes.
        seeds: bytes that it takes.
        raises: what it may raise.
    """

    run: Callable[[bytes], object]
    seeds: Sequence[bytes]
    raises: tuple[type[Exception], ...]


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
    for verbs in (FROM_CLIENT, ON_HANDLE, TO_DRIVER, FROM_DRIVER, TO_NURSERY):
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
    return found


GOLDEN = _golden()


def _device(data: bytes) -> object:
    """The decoder of one exchange with a device: the first byte chooses which."""
    return _read(GOLDEN[data[0] % len(GOLDEN)], data[1:], max(len(data) - 1, 1)) if data else None


def _streams(data: bytes) -> None:
    cut = len(data) // 3
    for receiver in (FrameReceiver(), RecordReceiver(), LineReceiver(3), LineReceiver(1, True)):
        for part in (data[:cut], data[cut:]):
            receiver.feed(part)
    for parse in (parse_rdt, parse_schunk, parse_samples):
        parse(data)


def _saved(save: Callable[[object], None]) -> bytes:
    with tempfile.TemporaryFile() as file:
        save(file)
        file.seek(0)
        return file.read()


def _finger() -> bytes:
    return to_toml(
        nominal_finger(Cylinder(4.8e-3, 6.35e-3, 0.49, 1.5e5), np.linspace(-0.5, 0.5, 4), 5.8e-3, 1.0, 5e-4)
    ).encode()


MAP = (files("sioms.drivers") / "modbus" / "maps" / "leadshine.toml").read_bytes()
NOMINAL = Path(__file__).parents[1] / "physics" / "reconcile_axes" / "s18" / "nominal.json"
CONFIG = (
    b'[workcell]\nname = "a"\n[device.io0]\ndriver = "sim-io"\noutputs = 8\n[[grant]]\nrights = ["read"]\n'
    b'[node.x]\nof = "io0"\n[[alarm]]\nnode = "x"\nhigh = 1.0\n[[emergency_stop]]\nnode = "x"\n'
)
TARGETS = {
    "message": Target(
        _message,
        [
            encode(ClientVerb.OPEN, 2, "mod0", 3, 0.5, 0.0), encode(HandleVerb.IOCTL, 2, 23, {"position_max": [0.2, None]}, 0.0),
            encode(HandleVerb.WRITE, 1, 0, None, bytes(144)), encode(DriverVerb.LOG, 0, "error", "no"),
            encode(NurseryVerb.DESCRIBE, 1, "a", "b", {"c": [1, -5, True]}, "/"), b"\x95\x02\x01\x1b" + b"\x91" * 40 + b"\xc0\x00",
            msgpack.packb([1, 1, msgpack.ExtType(5, b"x"), 1 << 63]),
        ],
        (),
    ),
    "reply": Target(_reply, [reply(1, {"a": [1]}, 5), refusal(1, 5, "no"), reply(1, ["x"] * 70_000)], (MalformedMessage,)),
    "text": Target(_text, [b"a\x1b[2J\r\n", "µ\u202e".encode()], ()),
    "config": Target(_config, [CONFIG], ()),
    "toml": Target(toml_of, [CONFIG, b"x = [{ a = 1979-05-27 }]"], (ValueError,)),
    "json": Target(json_of, [b'{"a": [1, -2.5e3, null, "x"]}'], (ValueError,)),
    "register map": Target(lambda data: parse_map(toml_of(data), "x"), [MAP], (RegisterMapError, ValueError)),
    "effects": Target(lambda data: parse_effects(data.decode("latin-1"), ["x"]), [b"[x.payload]\nmass = 0.5\n"], (EffectsError,)),
    "finger": Target(lambda data: from_toml(data.decode("latin-1")), [_finger()], (ValueError,)),
    "model": Target(_file(read_model, ".json"), [NOMINAL.read_bytes()], (BadInputError,)),
    "npz": Target(
        _file(read_npz, ".npz"), [_saved(lambda f: np.savez(f, raw=np.ones((2, 3)), time=np.arange(2.0)))], (UnreadableError,)
    ),
    "table": Target(_file(load_table, ".csv"), [b"time [s],position [m]\n0.0,1.0\n0.1,2.0\n0.2,3\n"], (BadInputError,)),
    "device": Target(
        _device,
        [bytes([i]) + bytes.fromhex(golden.reply) for i, golden in enumerate(GOLDEN[:256])],
        (LinkError, DeviceError, Incomplete),
    ),
    "streams": Target(_streams, [b"1.0, 2.0, 3.0\n1,2,3\n", bytes.fromhex("ff204ed8fe2efb2e16640038ff2c017daf"), bytes(36)], ()),
}  # fmt: skip


def _mat_seed() -> bytes:
    from scipy.io import savemat

    return _saved(
        lambda f: savemat(
            f, {"a": np.ones(3), "b": "text", "c": np.array([1, "x"], dtype=object)}, do_compression=True
        )
    )


TARGETS["mat"] = Target(_file(read_mat, ".mat"), [_mat_seed()], (UnreadableError,))


def feed(target: Target, data: bytes) -> bool:
    """Feed bytes to a target; return whether it took them."""
    try:
        target.run(data)
    except target.raises as error:
        if not str(error).strip():
            raise AssertionError(f"{type(error).__name__} without a word") from error
        return False
    return True
