"""Messages of the framed sample stream of tactile arrays and ADC front ends, protocol version 1.

Little-endian payloads in COBS frames (see :mod:`.cobs`); the first byte tells the message. A sample
block is numbered, stamped in microseconds by the device's own clock, and carries one value per
channel. The device stops a stream when it has heard nothing for 5 s; the host says hello every 1 s.
"""

from __future__ import annotations

import errno
from dataclasses import dataclass
from enum import IntEnum, IntFlag
from functools import cache
from struct import Struct, pack, unpack_from
from typing import Any

from sioms.sdk.exchange import DeviceError, Exchange, LinkError

from .cobs import FrameReceiver, frame

PROTOCOL_VERSION = 1
HEARTBEAT_S = 1.0
DEAD_MAN_S = 5.0
SEQUENCE_MODULUS = 0x10000
CLOCK_MODULUS_US = 1 << 32
_MAX_FOREIGN_BYTES = 65536
"""A reply that has not come within this many bytes of other frames will not come."""


class Message(IntEnum):
    """First byte of a payload."""

    SAMPLES_I16 = 0x01
    SAMPLES_I32 = 0x02
    SAMPLES_F32 = 0x03
    HELLO = 0x10
    HELLO_REPLY = 0x11
    START = 0x12
    STOP = 0x13
    ZERO = 0x14
    ACKNOWLEDGE = 0x1F


class SampleFlag(IntFlag):
    """Flags of a sample block."""

    SATURATED = 1
    OVERRUN = 2
    REFERENCE_FAULT = 4


class Format(IntEnum):
    """Format of the values that a device announces."""

    I16 = 0
    I32 = 1
    F32 = 2


_CODES = {Message.SAMPLES_I16: "h", Message.SAMPLES_I32: "i", Message.SAMPLES_F32: "f"}
_HEAD = Struct("<BBHIBB")
_ERRORS = {
    1: (errno.ENOTSUP, "unknown request"),
    2: (errno.EINVAL, "value out of range"),
    3: (errno.EBUSY, "busy"),
}


@dataclass(frozen=True, slots=True)
class SampleBlock:
    """One block of samples.

    Args:
        stream: number of the stream.
        sequence: number of the block, modulo 65536.
        t_us: device clock [us], modulo 2**32.
        flags: see :class:`SampleFlag`.
        values: one raw value a channel.
    """

    stream: int
    sequence: int
    t_us: int
    flags: int
    values: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class Hello:
    """What a device says of itself.

    Args:
        version: of the protocol.
        channels: values in a block.
        format: of the values.
        max_rate_hz: highest rate of blocks [Hz].
        name: type of the device.
    """

    version: int
    channels: int
    format: Format
    max_rate_hz: int
    name: str


@cache
def _layout(code: str, channels: int) -> Struct:
    return Struct(f"<{channels}{code}")


def parse_samples(payload: bytes) -> SampleBlock | None:
    """Return the sample block, or None when the payload is another message or inconsistent.

    Example:
        >>> parse_samples(bytes.fromhex("010107 0040e2010004006400 38ff0000ff7f".replace(" ", ""))).values
        (100, -200, 0, 32767)
    """
    code = _CODES.get(payload[0]) if payload else None  # type: ignore[call-overload]
    if code is None or len(payload) < _HEAD.size:
        return None
    _, stream, sequence, t_us, channels, flags = _HEAD.unpack_from(payload)
    layout = _layout(code, channels)
    if len(payload) != _HEAD.size + layout.size:
        return None
    return SampleBlock(stream, sequence, t_us, flags, layout.unpack_from(payload, _HEAD.size))


def build_samples(block: SampleBlock, form: Format) -> bytes:
    """Return the payload of a sample block; values must fit the format."""
    message = Message(form + 1)
    head = _HEAD.pack(message, block.stream, block.sequence, block.t_us, len(block.values), block.flags)
    values = block.values if form is Format.F32 else [int(value) for value in block.values]
    return head + _layout(_CODES[message], len(block.values)).pack(*values)


def parse_hello(payload: bytes) -> Hello:
    """Return what a device says of itself.

    Raises:
        LinkError: not a hello reply.
    """
    if len(payload) < 8 or payload[0] != Message.HELLO_REPLY or payload[3] not in set(Format):
        raise LinkError(f"read the hello reply: {payload.hex(' ')} is none")
    version, channels, form, rate = unpack_from("<BBBI", payload, 1)
    return Hello(version, channels, Format(form), rate, payload[8:].decode("ascii", "replace"))


def hello(timeout_s: float = 0.5) -> Exchange:
    """Return the exchange that asks a device what it is; its value is a :class:`Hello`."""
    return _exchange(bytes((Message.HELLO,)), Message.HELLO_REPLY, parse_hello, timeout_s, "hello", True)


def start(stream: int, rate_hz: int, timeout_s: float = 0.5) -> Exchange:
    """Return the exchange that starts a stream; starting a running one again changes its rate."""
    request = pack("<BBI", Message.START, stream, rate_hz)
    return _acknowledged(request, timeout_s, f"start stream {stream} at {rate_hz} Hz", True)


def stop(stream: int, timeout_s: float = 0.5) -> Exchange:
    """Return the exchange that stops a stream."""
    return _acknowledged(bytes((Message.STOP, stream)), timeout_s, f"stop stream {stream}", True)


def zero(stream: int, timeout_s: float = 2.0) -> Exchange:
    """Return the exchange that makes the device take the present values as its zero. Not repeatable."""
    return _acknowledged(bytes((Message.ZERO, stream)), timeout_s, f"zero stream {stream}", False)


def _acknowledged(request: bytes, timeout_s: float, what: str, repeatable: bool) -> Exchange:
    def decode(payload: bytes) -> None:
        if payload[2]:
            number, text = _ERRORS.get(payload[2], (errno.EIO, "unknown error"))
            raise DeviceError(number, f"{what}: the device answers error {payload[2]}, {text}")

    return _exchange(request, Message.ACKNOWLEDGE, decode, timeout_s, what, repeatable)


def _exchange(request: bytes, reply: Message, decode: Any, timeout_s: float, what: str, repeatable: bool) -> Exchange:
    """Return an exchange whose reply may come behind sample blocks that are still under way."""

    def find(data: bytes) -> tuple[int, bytes] | None:
        receiver, start_at = FrameReceiver(), 0
        while (end := data.find(b"\0", start_at)) >= 0:
            payloads = receiver.feed(data[start_at : end + 1])
            start_at = end + 1
            if payloads and _answers(payloads[0], reply, request[0]):
                return start_at, payloads[0]
        if len(data) > _MAX_FOREIGN_BYTES:
            raise LinkError(f"{what}: no reply within {_MAX_FOREIGN_BYTES} bytes")
        return None

    def want(data: bytes) -> int | None:
        found = find(data)
        return found[0] if found else None

    def unpack(data: bytes) -> Any:
        found = find(data)
        if found is None:
            raise LinkError(f"{what}: {len(data)} bytes without a reply")
        return decode(found[1])

    return Exchange(frame(request), want, unpack, timeout_s, repeatable, what)


def _answers(payload: bytes, reply: Message, request: int) -> bool:
    if payload[0] != reply:
        return False
    return reply != Message.ACKNOWLEDGE or (len(payload) == 3 and payload[1] == request)
