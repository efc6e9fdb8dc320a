"""Modbus requests as values: the PDU, what its reply must look like, and how to read it.

Source: Modbus application protocol specification V1.1b3, sections 4 and 6. A PDU is framed by
:mod:`sioms.sdk.codec.modbus`. Registers are unsigned 16-bit, big-endian on the wire. Bits are an
integer whose bit 0 is the first bit read.
"""

from __future__ import annotations

import errno
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from struct import pack, unpack
from typing import Any

from sioms.sdk.exchange import DeviceError, LinkError

READ_COILS, READ_DISCRETE, READ_HOLDING, READ_INPUT = 1, 2, 3, 4
WRITE_COIL, WRITE_REGISTER, WRITE_COILS, WRITE_REGISTERS, READ_WRITE_REGISTERS = 5, 6, 0x0F, 0x10, 0x17

MAX_READ_BITS, MAX_READ_REGISTERS = 2000, 125
MAX_WRITE_BITS, MAX_WRITE_REGISTERS, MAX_READ_WRITE_REGISTERS = 1968, 123, 121

# Exception code -> errno and text. 8 and 0x0B are faults of a line, not refusals: see decode_reply.
_EXCEPTIONS = {
    1: (errno.ENOTSUP, "illegal function"),
    2: (errno.ENXIO, "illegal address"),
    3: (errno.EINVAL, "illegal value"),
    4: (errno.EIO, "device failure"),
    5: (errno.EINPROGRESS, "accepted, still working"),
    6: (errno.EBUSY, "busy"),
    10: (errno.EHOSTUNREACH, "gateway path unavailable"),
}
_LINE_EXCEPTIONS = {8: "checksum or parity error seen by the device", 11: "gateway target does not answer"}


@dataclass(frozen=True, slots=True)
class Pdu:
    """One request.

    Args:
        data: function code and data.
        head: first bytes of the regular reply, function code included; they tell it from others.
        size: length of the regular reply [bytes].
        decode: turns the checked regular reply into its value.
        repeatable: True for reads.
        what: the request in words.
    """

    data: bytes
    head: bytes
    size: int
    decode: Callable[[bytes], Any]
    repeatable: bool
    what: str


def reply_size(pdu: Pdu, reply: bytes) -> int | None:
    """Return the length of the reply PDU that starts with ``reply``, or None if it is too short to tell.

    Raises:
        LinkError: the bytes cannot be the reply to this request.
    """
    if not reply:
        return None
    if reply[0] == pdu.data[0] | 0x80:
        return 2
    if not (reply.startswith(pdu.head) or pdu.head.startswith(reply)):
        got = reply[: len(pdu.head)].hex(" ")
        raise LinkError(f"{pdu.what}: reply starts with {got}, that of this request with {pdu.head.hex(' ')}")
    return pdu.size


def decode_reply(pdu: Pdu, reply: bytes) -> Any:
    """Return the value in a complete reply PDU.

    Raises:
        DeviceError: the device refused.
        LinkError: not the reply to this request, of another length, or an exception that reports
            a damaged line (8, checksum error; 0x0B, nothing behind the gateway).
    """
    if reply_size(pdu, reply) != len(reply):
        raise LinkError(f"{pdu.what}: reply of {len(reply)} bytes; {pdu.size} are right")
    if reply[0] & 0x80:
        raise _refusal(pdu, reply[1])
    return pdu.decode(reply)


def _refusal(pdu: Pdu, code: int) -> Exception:
    if code in _LINE_EXCEPTIONS:
        return LinkError(f"{pdu.what}: exception {code}, {_LINE_EXCEPTIONS[code]}")
    number, text = _EXCEPTIONS.get(code, (errno.EIO, "unknown exception"))
    return DeviceError(number, f"{pdu.what}: the device answers exception {code}, {text}")


def _check(what: str, address: int, count: int, most: int) -> None:
    if not 1 <= count <= most:
        raise ValueError(f"{what}: count is {count}; 1 to {most} is right")
    if not 0 <= address <= 0x10000 - count:
        raise ValueError(f"{what}: address is {address:#x}; 0 to {0x10000 - count:#x} is right")


def _check_words(what: str, values: Sequence[int]) -> None:
    for value in values:
        if not 0 <= value <= 0xFFFF:
            raise ValueError(f"{what}: a register cannot hold {value}; 0 to 65535 is right")


def _plural(count: int, noun: str) -> str:
    return f"{count} {noun}" + ("s" if count != 1 else "")


def _nothing(reply: bytes) -> None:
    return None


_BIT_NAMES = {READ_COILS: "coil", READ_DISCRETE: "discrete input"}
_REGISTER_NAMES = {READ_HOLDING: "holding register", READ_INPUT: "input register"}


def read_bits(function: int, address: int, count: int) -> Pdu:
    """Return the request for 1 to 2000 coils (1) or discrete inputs (2); its value is an integer."""
    what = f"read {_plural(count, _BIT_NAMES[function])} at {address:#06x}"
    _check(what, address, count, MAX_READ_BITS)
    size = (count + 7) // 8
    mask = (1 << count) - 1
    head = bytes((function, size))
    data = pack(">BHH", function, address, count)
    return Pdu(data, head, 2 + size, lambda reply: int.from_bytes(reply[2:], "little") & mask, True, what)


def read_registers(function: int, address: int, count: int) -> Pdu:
    """Return the request for 1 to 125 holding (3) or input (4) registers; its value is a tuple."""
    what = f"read {_plural(count, _REGISTER_NAMES[function])} at {address:#06x}"
    _check(what, address, count, MAX_READ_REGISTERS)
    head = bytes((function, 2 * count))
    layout = f">{count}H"
    data = pack(">BHH", function, address, count)
    return Pdu(data, head, 2 + 2 * count, lambda reply: unpack(layout, reply[2:]), True, what)


def write_coil(address: int, value: bool) -> Pdu:
    """Return the request that writes one coil."""
    what = f"write coil at {address:#06x}"
    _check(what, address, 1, 1)
    data = pack(">BHH", WRITE_COIL, address, 0xFF00 if value else 0)
    return Pdu(data, data, 5, _nothing, False, what)


def write_register(address: int, value: int) -> Pdu:
    """Return the request that writes one register, 0 to 65535."""
    what = f"write register at {address:#06x}"
    _check(what, address, 1, 1)
    _check_words(what, (value,))
    data = pack(">BHH", WRITE_REGISTER, address, value)
    return Pdu(data, data, 5, _nothing, False, what)


def write_coils(address: int, count: int, bits: int) -> Pdu:
    """Return the request that writes 1 to 1968 coils; bit 0 of ``bits`` goes to ``address``."""
    what = f"write {_plural(count, 'coil')} at {address:#06x}"
    _check(what, address, count, MAX_WRITE_BITS)
    if not 0 <= bits < 1 << count:
        raise ValueError(f"{what}: bits are {bits:#x}; 0 to {(1 << count) - 1:#x} is right")
    size = (count + 7) // 8
    head = pack(">BHH", WRITE_COILS, address, count)
    return Pdu(head + bytes((size,)) + bits.to_bytes(size, "little"), head, 5, _nothing, False, what)


def write_registers(address: int, values: Sequence[int]) -> Pdu:
    """Return the request that writes 1 to 123 registers, each 0 to 65535."""
    count = len(values)
    what = f"write {_plural(count, 'register')} at {address:#06x}"
    _check(what, address, count, MAX_WRITE_REGISTERS)
    _check_words(what, values)
    head = pack(">BHH", WRITE_REGISTERS, address, count)
    return Pdu(head + pack(f">B{count}H", 2 * count, *values), head, 5, _nothing, False, what)


def read_write_registers(address: int, count: int, write_address: int, values: Sequence[int]) -> Pdu:
    """Return the request that writes 1 to 121 registers, then reads 1 to 125 in the same transaction."""
    what = f"write {len(values)} registers at {write_address:#06x}, read {count} at {address:#06x}"
    _check(what, address, count, MAX_READ_REGISTERS)
    _check(what, write_address, len(values), MAX_READ_WRITE_REGISTERS)
    _check_words(what, values)
    head = bytes((READ_WRITE_REGISTERS, 2 * count))
    data = pack(">BHHHHB", READ_WRITE_REGISTERS, address, count, write_address, len(values), 2 * len(values))
    data += pack(f">{len(values)}H", *values)
    layout = f">{count}H"
    return Pdu(data, head, 2 + 2 * count, lambda reply: unpack(layout, reply[2:]), False, what)
