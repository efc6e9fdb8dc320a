"""SCHUNK FTS sensors behind the Ethernet interface box (IFB-EN), without I/O: commands on TCP, records on UDP.

Both frames begin ``FF FF``, a counter (u16) and the length of what follows (u16); all numbers are little-endian. A
reply has command,
error code and data. **Its counter is no echo**: the box numbers its replies on each connection from 1 on, and the
vendor's library sends 0 in every command; so a reply belongs to a command by its order and by the command byte. A
record of 35 bytes comes a thousand times a second; its ``packet`` is a second counter of 8 bits that runs with every
record. Source: the vendor's public driver and simulator (SCHUNK-SE-Co-KG/schunk_force_torque_sensor b0e4359:
``schunk_fts_dummy/src/tcp.rs``, ``udp.rs``, ``schunk_fts_library/utility.py``).
"""

from __future__ import annotations

import errno
from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum, IntFlag
from struct import Struct, pack, unpack_from
from typing import Any

from sioms.sdk.exchange import DeviceError, Exchange, LinkError

DATA_PORT = 54843
RATE_HZ = 1000.0
SEQUENCE_MODULUS = 1 << 16
RECORD_BYTES = 35
_SYNC = b"\xff\xff"
_HEAD_BYTES = 6
_MAX_PAYLOAD = 1024
TIMEOUT_S = 1.0
"""Longest time to an answer."""
_RECORD = Struct("<2sHHBI6f")
_RECORD_PAYLOAD = RECORD_BYTES - _HEAD_BYTES


class Command(IntEnum):
    """Commands on TCP."""

    TARE = 0x12
    RESET_TARE = 0x13
    TOOL = 0x30
    NOISE_FILTER = 0x31
    START = 0x40
    STOP = 0x41
    GET_PARAMETER = 0xF0


PRODUCT, PRODUCT_ID, UNIT, FIRMWARE = (0x0001, 0), (0x0001, 3), (0x0050, 0), (0x1002, 1)
"""Index and subindex of parameters."""

_ERRORS = {
    0x01: (errno.ENOTSUP, "unknown command"),
    0x02: (errno.EINVAL, "wrong length"),
    0x03: (errno.EINVAL, "wrong value"),
    0x04: (errno.EBUSY, "busy"),
    0x05: (errno.EBUSY, "not while it streams"),
    0x06: (errno.EIO, "storage"),
    0x07: (errno.EIO, "internal bus"),
    0x08: (errno.EIO, "time-out inside the sensor"),
    0x10: (errno.EPERM, "user level too low"),
    0x11: (errno.EACCES, "read only"),
    0x12: (errno.EACCES, "write only"),
    0x13: (errno.ENXIO, "unknown index"),
    0x14: (errno.ENXIO, "unknown subindex"),
    0x15: (errno.EINVAL, "wrong length of the value"),
    0x16: (errno.EINVAL, "wrong value"),
    0x17: (errno.EACCES, "login failed"),
    0x18: (errno.EACCES, "login blocked"),
    0x19: (errno.EACCES, "locked"),
    0x30: (errno.EBUSY, "firmware update"),
    0x31: (errno.EBUSY, "firmware update"),
}


class Status(IntFlag):
    """Status of a record."""

    READY = 1
    INVALID = 2
    TEMPERATURE = 4
    HARDWARE = 8
    MECHANICAL_RANGE = 16
    USER_RANGE = 32


_WORDS = {
    Status.INVALID: "process data invalid", Status.TEMPERATURE: "temperature", Status.HARDWARE: "hardware",
    Status.MECHANICAL_RANGE: "loaded beyond its mechanical range", Status.USER_RANGE: "loaded beyond the user's range",
}  # fmt: skip
_KNOWN = 0x3F


@dataclass(frozen=True, slots=True)
class Record:
    """One record: forces [N], torques [N m] unless the sensor was set to other units.

    Args:
        counter: number of the record, modulo 65536.
        packet: a counter of its own, modulo 256.
        status: see :class:`Status`.
        values: fx, fy, fz, tx, ty, tz.
    """

    counter: int
    packet: int
    status: int
    values: tuple[float, ...]


def parse(datagram: bytes) -> Record | None:
    """Return the record of a datagram, None when it is none."""
    if len(datagram) != RECORD_BYTES:
        return None
    sync, counter, length, packet, status, *values = _RECORD.unpack(datagram)
    if sync != _SYNC or length != _RECORD_PAYLOAD:
        return None
    return Record(counter, packet, status, tuple(values))


def build(record: Record) -> bytes:
    """Return the datagram of a record."""
    return _RECORD.pack(_SYNC, record.counter, _RECORD_PAYLOAD, record.packet, record.status, *record.values)


def status_text(status: int) -> str:
    """Return a status in words.

    Example:
        >>> status_text(1), status_text(0x12)
        ('ok', 'not ready; process data invalid; loaded beyond its mechanical range')
    """
    words = [] if status & Status.READY else ["not ready"]
    words += [text for bit, text in _WORDS.items() if status & bit]
    if status & ~_KNOWN:
        words.append(f"bits {status & ~_KNOWN:#x}, which have no meaning here")
    return "; ".join(words) or "ok"


def act(command: Command, *arguments: int, timeout_s: float = TIMEOUT_S) -> Exchange:
    """Return the exchange of a command without data in its reply; each sets a state, and may be sent twice.

    Example:
        >>> act(Command.START).data.hex(" ")
        'ff ff 00 00 01 00 40'
    """
    what = command.name.lower().replace("_", " ") + "".join(f" {each}" for each in arguments)
    return _exchange(bytes((command, *arguments)), lambda data: None, what, True, timeout_s)


def get(parameter: tuple[int, int], timeout_s: float = TIMEOUT_S) -> Exchange:
    """Return the exchange that reads a parameter; its value is bytes."""
    index = pack("<HB", *parameter)
    what = f"read parameter {parameter[0]:#06x}/{parameter[1]}"

    def decode(data: bytes) -> bytes:
        if data[:3] != index:
            raise LinkError(f"{what}: the reply is to {data[:3].hex(' ')}")
        return data[3:]

    return _exchange(bytes((Command.GET_PARAMETER,)) + index, decode, what, True, timeout_s)


def _exchange(
    payload: bytes, decode: Callable[[bytes], Any], what: str, repeatable: bool, timeout_s: float
) -> Exchange:
    frame = pack("<2sHH", _SYNC, 0, len(payload)) + payload

    def want(reply: bytes) -> int | None:
        if len(reply) < _HEAD_BYTES:
            return None
        sync, _, length = unpack_from("<2sHH", reply)
        if sync != _SYNC or length > _MAX_PAYLOAD:
            raise LinkError(f"{what}: {reply[:_HEAD_BYTES].hex(' ')} begins no reply of this sensor")
        return _HEAD_BYTES + int(length)

    def unpack(reply: bytes) -> Any:
        end = want(reply)
        if end is None or len(reply) < end:
            raise LinkError(f"{what}: the reply is cut after {len(reply)} bytes")
        body = reply[_HEAD_BYTES:end]
        if len(body) < 2 or body[0] != payload[0]:
            raise LinkError(f"{what}: the reply {body.hex(' ')} does not answer command {payload[0]:02x}")
        if body[1]:
            number, text = _ERRORS.get(body[1], (errno.EIO, "unknown error"))
            raise DeviceError(number, f"{what}: the sensor answers error {body[1]:02x}, {text}")
        return decode(body[2:])

    return Exchange(frame, want, unpack, timeout_s, repeatable, what)
