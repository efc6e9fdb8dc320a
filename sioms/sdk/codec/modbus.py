"""Modbus masters without I/O: RTU on a serial line and TCP, both giving :class:`Exchange` values.

On a serial line the gap between frames cannot be measured by a host, so the length of the reply is
computed from the request and everything else is a :class:`LinkError`; the caller then drains the
line. On TCP the transaction number tells a late reply from the awaited one: replies with an
older number are skipped. Sources: Modbus over serial line V1.02, section 2.5.1; Modbus messaging on
TCP/IP V1.0b, section 3.1.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from struct import pack, unpack_from
from typing import Any

from sioms.sdk.exchange import Exchange, LinkError

from . import modbus_pdu as pdus
from .checksum import crc16_modbus
from .modbus_pdu import Pdu

MAX_MBAP_BYTES = 260
UNIT_IN_HEADER = 6
"""Place of the unit in a message on TCP: behind transaction, protocol and length."""
_MAX_STALE_BYTES = 16 * MAX_MBAP_BYTES
"""More old replies than this in front of the awaited one mean that the stream is not Modbus."""


@dataclass(frozen=True, slots=True)
class SerialLine:
    """Arithmetic of a serial line.

    Args:
        baud: bits per second.
        bits: bits of one character with start, parity and stop (8N1: 10; 8E1, 8N2: 11).
    """

    baud: int
    bits: int = 10

    def duration_s(self, characters: float) -> float:
        """Return the time that so many characters take [s]."""
        return characters * self.bits / self.baud

    @property
    def frame_gap_s(self) -> float:
        """Silence between RTU frames [s]: 3.5 characters, fixed 1.75 ms above 19200 baud."""
        return 0.00175 if self.baud > 19200 else self.duration_s(3.5)


class Unit:
    """Requests to one Modbus unit, as :class:`Exchange` values. The framing is a subclass's.

    Not safe to share between threads (TCP counts its transactions).
    """

    def __init__(self, unit: int, turnaround_s: float) -> None:
        self.unit = unit
        self.turnaround_s = turnaround_s

    def exchange(self, pdu: Pdu, turnaround_s: float | None = None) -> Exchange:
        """Return the framed request; ``turnaround_s`` is the device's longest time to answer it [s]."""
        raise NotImplementedError

    def read_coils(self, address: int, count: int) -> Exchange:
        """Return the exchange whose value is an integer, bit 0 the coil at ``address``."""
        return self.exchange(pdus.read_bits(pdus.READ_COILS, address, count))

    def read_discrete(self, address: int, count: int) -> Exchange:
        """Return the exchange whose value is an integer, bit 0 the input at ``address``."""
        return self.exchange(pdus.read_bits(pdus.READ_DISCRETE, address, count))

    def read_holding(self, address: int, count: int) -> Exchange:
        """Return the exchange whose value is a tuple of ``count`` registers, 0 to 65535 each."""
        return self.exchange(pdus.read_registers(pdus.READ_HOLDING, address, count))

    def read_input(self, address: int, count: int) -> Exchange:
        """Return the exchange whose value is a tuple of ``count`` input registers, 0 to 65535 each."""
        return self.exchange(pdus.read_registers(pdus.READ_INPUT, address, count))

    def write_coil(self, address: int, value: bool) -> Exchange:
        """Return the exchange that writes one coil (function 05)."""
        return self.exchange(pdus.write_coil(address, value))

    def write_register(self, address: int, value: int) -> Exchange:
        """Return the exchange that writes one register (function 06)."""
        return self.exchange(pdus.write_register(address, value))

    def write_coils(self, address: int, count: int, bits: int) -> Exchange:
        """Return the exchange that writes coils (function 0F)."""
        return self.exchange(pdus.write_coils(address, count, bits))

    def write_registers(self, address: int, values: Sequence[int]) -> Exchange:
        """Return the exchange that writes registers (function 10)."""
        return self.exchange(pdus.write_registers(address, values))


class RtuUnit(Unit):
    """A unit on a serial line, address 1 to 247.

    Args:
        unit: address; 0 (broadcast) draws no reply and is refused.
        line: speed and format, for the time-out.
        turnaround_s: longest time that the device needs before it answers [s].
    """

    def __init__(self, unit: int, line: SerialLine, turnaround_s: float = 0.1) -> None:
        if not 1 <= unit <= 247:
            raise ValueError(f"address of a unit is {unit}; 1 to 247 is right")
        super().__init__(unit, turnaround_s)
        self.line = line

    def exchange(self, pdu: Pdu, turnaround_s: float | None = None) -> Exchange:
        """Return the request with address and CRC."""
        unit = self.unit
        what = f"{pdu.what} of unit {unit}"

        def want(reply: bytes) -> int | None:
            if reply and reply[0] != unit:
                raise LinkError(f"{what}: the reply comes from unit {reply[0]}")
            size = pdus.reply_size(pdu, reply[1:])
            return None if size is None else size + 3

        def decode(reply: bytes) -> Any:
            if want(reply) != len(reply):
                raise LinkError(f"{what}: reply of {len(reply)} bytes; {pdu.size + 3} are right")
            crc = crc16_modbus(reply[:-2])
            if crc != unpack_from("<H", reply, len(reply) - 2)[0]:
                raise LinkError(f"{what}: CRC of the reply is wrong ({reply.hex(' ')})")
            return pdus.decode_reply(pdu, reply[1:-2])

        wait_s = self.turnaround_s if turnaround_s is None else turnaround_s
        timeout_s = wait_s + self.line.duration_s(pdu.size + 3)
        request = frame_rtu(unit, pdu.data)
        return Exchange(request, want, decode, timeout_s, pdu.repeatable, what, has_checksum=True)


class TcpUnit(Unit):
    """A unit behind a TCP connection. A repeated exchange keeps its transaction number."""

    def __init__(self, unit: int = 1, timeout_s: float = 0.5) -> None:
        if not 0 <= unit <= 255:
            raise ValueError(f"unit is {unit}; 0 to 255 is right")
        super().__init__(unit, timeout_s)
        self._last = 0

    def exchange(self, pdu: Pdu, turnaround_s: float | None = None) -> Exchange:
        """Return the request with its MBAP header and the next transaction number."""
        self._last = number = self._last + 1 & 0xFFFF
        unit = self.unit
        what = f"{pdu.what} of unit {unit}"

        def want(reply: bytes) -> int | None:
            start, size = _find_reply(reply, number, what)
            if size is None:
                return None
            if reply[start + 6] != unit:
                raise LinkError(f"{what}: the reply comes from unit {reply[start + 6]}")
            expected = pdus.reply_size(pdu, reply[start + 7 : start + size])
            if expected is not None and expected + 7 != size:
                raise LinkError(f"{what}: the header announces {size - 7} bytes; {expected} are right")
            return start + size

        def decode(reply: bytes) -> Any:
            if want(reply) != len(reply):
                raise LinkError(f"{what}: reply of {len(reply)} bytes is cut or too long")
            start, _ = _find_reply(reply, number, what)
            return pdus.decode_reply(pdu, reply[start + 7 :])

        wait_s = self.turnaround_s if turnaround_s is None else turnaround_s
        return Exchange(frame_tcp(number, unit, pdu.data), want, decode, wait_s, pdu.repeatable, what)


def frame_rtu(unit: int, pdu: bytes) -> bytes:
    """Return address, PDU and CRC.

    Example:
        >>> frame_rtu(1, bytes.fromhex("03 0000 000a")).hex(" ")
        '01 03 00 00 00 0a c5 cd'
    """
    body = bytes((unit,)) + pdu
    return body + pack("<H", crc16_modbus(body))


def frame_tcp(number: int, unit: int, pdu: bytes) -> bytes:
    """Return MBAP header and PDU.

    Example:
        >>> frame_tcp(7, 1, bytes.fromhex("03 0000 000a")).hex(" ")
        '00 07 00 00 00 06 01 03 00 00 00 0a'
    """
    return pack(">HHHB", number, 0, len(pdu) + 1, unit) + pdu


def _mbap_size(data: bytes, start: int, what: str) -> int | None:
    """Return the length of the frame at ``start``, or None while its header is incomplete."""
    if len(data) < start + 7:
        return None
    _, protocol, length = unpack_from(">HHH", data, start)
    if protocol != 0 or not 3 <= length <= MAX_MBAP_BYTES - 6:
        raise LinkError(f"{what}: not a Modbus TCP header: {data[start : start + 7].hex(' ')}")
    return int(length) + 6


def _find_reply(data: bytes, number: int, what: str) -> tuple[int, int | None]:
    """Return start and length of the frame with this transaction number, past older frames.

    The length is None while the frame, or an older one before it, is incomplete.
    """
    start = 0
    while (size := _mbap_size(data, start, what)) is not None:
        got = unpack_from(">H", data, start)[0]
        if got == number:
            return start, size
        if (number - got & 0xFFFF) >= 0x8000:
            raise LinkError(f"{what}: reply to transaction {got}, which is newer than {number}")
        if start + size > len(data):
            break
        start += size
        if start > _MAX_STALE_BYTES:
            raise LinkError(f"{what}: more than {_MAX_STALE_BYTES} bytes of old replies")
    return start, None
