"""Dynamixel protocol 2.0 without I/O: framing with byte stuffing and CRC-16/UMTS, and the requests that a driver needs.

Inside instruction and parameters ``FF FF FD`` is sent as ``FF FF FD FD``; length and CRC count the stuffed form. A
servo that received a damaged request stays silent. Source: ROBOTIS e-Manual, "DYNAMIXEL Protocol 2.0".
"""

from __future__ import annotations

import errno
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum
from struct import unpack_from
from typing import Any

from sioms.sdk.codec.checksum import crc16_umts
from sioms.sdk.exchange import DeviceError, Exchange, LinkError

HEADER = b"\xff\xff\xfd\x00"
BROADCAST = 0xFE
STATUS = 0x55
ALERT = 0x80
MAX_LENGTH = 1024
_SHORTEST = 11
"""Bytes of a status packet without parameters."""
ERRORS = {
    1: (errno.EIO, "result fail"), 2: (errno.ENOTTY, "unknown instruction"), 3: (errno.EIO, "CRC of the request"),
    4: (errno.ERANGE, "data range"), 5: (errno.EINVAL, "data length"), 6: (errno.ERANGE, "data limit"),
    7: (errno.EACCES, "access"),
}  # fmt: skip


class Op(IntEnum):
    """Instructions."""

    PING = 0x01
    READ = 0x02
    WRITE = 0x03
    REBOOT = 0x08
    SYNC_READ = 0x82
    SYNC_WRITE = 0x83


@dataclass(frozen=True, slots=True)
class Status:
    """The answer of one servo.

    Args:
        id: of the servo.
        data: parameters behind the error byte.
        alert: the servo has a hardware error (register 70).
    """

    id: int
    data: bytes
    alert: bool


def stuff(content: bytes) -> bytes:
    """Return instruction and parameters as they are sent.

    Example:
        >>> stuff(bytes.fromhex("03 74 00 ff ff fd 01")).hex(" ")
        '03 74 00 ff ff fd fd 01'
    """
    return content.replace(b"\xff\xff\xfd", b"\xff\xff\xfd\xfd")


def unstuff(content: bytes) -> bytes:
    """Return instruction and parameters as they are meant."""
    return content.replace(b"\xff\xff\xfd\xfd", b"\xff\xff\xfd")


def packet(servo: int, op: int, parameters: bytes = b"") -> bytes:
    """Return a packet.

    Example:
        >>> packet(1, Op.PING).hex(" ")
        'ff ff fd 00 01 03 00 01 19 4e'
    """
    content = stuff(bytes((op,)) + parameters)
    body = HEADER + bytes((servo,)) + (len(content) + 2).to_bytes(2, "little") + content
    return body + crc16_umts(body).to_bytes(2, "little")


def little(value: int, size: int) -> bytes:
    """Return a register of 1, 2 or 4 bytes; raises ValueError when the value does not fit."""
    low, high = (0, 255) if size == 1 else (-(1 << 8 * size - 1), (1 << 8 * size) - 1)
    if not low <= value <= high:
        raise ValueError(f"value {value} does not fit into {size} bytes; want {low} to {high}")
    return (value & (1 << 8 * size) - 1).to_bytes(size, "little")


def signed(data: bytes, at: int, size: int) -> int:
    """Return a signed register in data."""
    return int.from_bytes(data[at : at + size], "little", signed=True)


def find(data: bytes, what: str) -> tuple[int, int] | None:
    """Return where the status packet in data begins and ends, behind stray bytes and a local echo; None while it is not
    whole.

    Raises:
        LinkError: data holds none.
    """
    at = 0
    while (at := data.find(HEADER, at)) >= 0:
        if len(data) < at + 7:
            break
        length = int(unpack_from("<H", data, at + 5)[0])
        if not 3 <= length <= MAX_LENGTH:
            raise LinkError(f"{what}: the reply tells a length of {length}; want 4 to {MAX_LENGTH}")
        end = at + length + 7
        if len(data) < end:
            break
        if data[at + 7] == STATUS or not is_whole(data[at:end]):
            return at, end
        at = end
    if len(data) > 2 * MAX_LENGTH:
        raise LinkError(f"{what}: no reply in {len(data)} bytes; want one beginning with ff ff fd 00")
    return None


def is_whole(data: bytes) -> bool:
    """Tell whether the CRC of a packet is right."""
    return crc16_umts(data[:-2]).to_bytes(2, "little") == data[-2:]


def parse(data: bytes, what: str) -> Status:
    """Return a status packet.

    Raises:
        LinkError: damaged, or no status.
        DeviceError: the servo refuses.
    """
    if len(data) < _SHORTEST or not is_whole(data):
        raise LinkError(f"{what}: the CRC of the reply is wrong ({data.hex(' ')})")
    content = unstuff(data[7:-2])
    if content[0] != STATUS or len(content) < 2:
        raise LinkError(f"{what}: instruction {content[0]:#04x} instead of a status")
    code = content[1] & 0x7F
    if code:
        errno_, text = ERRORS.get(code, (errno.EIO, "unknown"))
        raise DeviceError(errno_, f"{what}: servo {data[4]} refuses with error {code}, {text}")
    return Status(data[4], content[2:], bool(content[1] & ALERT))


@dataclass(frozen=True, slots=True)
class Bus:
    """Requests on one line, as exchanges.

    Args:
        character_s: time of one character [s].
        turnaround_s: longest time that a servo needs before it answers [s].
    """

    character_s: float
    turnaround_s: float

    def ping(self, servo: int) -> Exchange:
        """Ask for model number and firmware; the value is a Status with three bytes."""
        return self._one(servo, Op.PING, b"", 3, f"ping servo {servo}", repeatable=True)

    def read(self, servo: int, address: int, size: int) -> Exchange:
        """Read registers; the value is a Status."""
        parameters = little(address, 2) + little(size, 2)
        what = f"read {size} bytes at {address} of servo {servo}"
        return self._one(servo, Op.READ, parameters, size, what, repeatable=True)

    def write(self, servo: int, address: int, value: int, size: int, *, repeatable: bool = False) -> Exchange:
        """Write one register."""
        return self.write_all(servo, address, [(value, size)], repeatable=repeatable)

    def write_all(
        self, servo: int, address: int, values: Sequence[tuple[int, int]], *, repeatable: bool = False
    ) -> Exchange:
        """Write registers that follow one another, each as (value, size), at once."""
        parameters = little(address, 2) + b"".join(little(value, size) for value, size in values)
        what = f"write {', '.join(str(value) for value, _ in values)} at {address} of servo {servo}"
        return self._one(servo, Op.WRITE, parameters, 0, what, repeatable=repeatable)

    def reboot(self, servo: int) -> Exchange:
        """Restart a servo: clears a shutdown."""
        return self._one(servo, Op.REBOOT, b"", 0, f"reboot servo {servo}", repeatable=False)

    def _one(self, servo: int, op: Op, parameters: bytes, size: int, what: str, *, repeatable: bool) -> Exchange:
        timeout_s = self.turnaround_s + (size + _SHORTEST) * self.character_s

        def want(data: bytes) -> int | None:
            found = find(data, what)
            return found[1] if found else None

        return Exchange(packet(servo, op, parameters), want, _from(servo, size, what), timeout_s, repeatable, what)


def sync_read(servos: Sequence[int], address: int, size: int) -> bytes:
    """Return the packet that asks several servos for the same registers; each answers for itself, in this order."""
    return packet(BROADCAST, Op.SYNC_READ, little(address, 2) + little(size, 2) + bytes(servos))


def sync_write(values: Mapping[int, int], address: int, size: int) -> bytes:
    """Return the packet that writes one register of several servos; nobody answers it."""
    data = b"".join(bytes((servo,)) + little(value, size) for servo, value in values.items())
    return packet(BROADCAST, Op.SYNC_WRITE, little(address, 2) + little(size, 2) + data)


def _from(servo: int, size: int, what: str) -> Callable[[bytes], Any]:
    def decode(data: bytes) -> Status:
        found = find(data, what) or (0, len(data))
        status = parse(data[slice(*found)], what)
        if status.id != servo or len(status.data) != size:
            raise LinkError(f"{what}: {len(status.data)} bytes from servo {status.id}; want {size} from {servo}")
        return status

    return decode
