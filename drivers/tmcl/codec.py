"""Trinamic TMCL in its binary form, without I/O: nine bytes each way, closed by the sum of the first eight.

There is nothing to resynchronise on: the vendor's receiver waits for nine bytes for ever (TMC-EvalSystem
``tmc/TMCL.c``, ``rx``), so one byte too many or too few and it cuts every telegram that follows at the wrong place.
:class:`Framing` gets it back into step. After a bad or missing reply the line has to fall silent before the next
request (``LineDriver.recovery_s``), because a reply does not say which
parameter it is of. Source of the telegrams: TMCL firmware manuals (TMCM-1140, TMCM-1276), chapter "TMCL and the
    TMCL-IDE".
"""

from __future__ import annotations

import errno
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from enum import IntEnum
from struct import pack, unpack
from typing import Any

from sioms.sdk.exchange import DeviceError, Exchange, LinkError

SIZE = 9
FIRMWARE_VERSION = 136
"""Type 1: module number in the upper, firmware in the lower half of the value."""


class Op(IntEnum):
    """Command numbers."""

    ROR = 1
    ROL = 2
    MST = 3
    MVP = 4
    SAP = 5
    GAP = 6
    SGP = 9
    GGP = 10
    RFS = 13
    END_PROGRAM = 128
    VERSION = FIRMWARE_VERSION


class Axis(IntEnum):
    """Axis parameters."""

    TARGET_POSITION = 0
    ACTUAL_POSITION = 1
    TARGET_SPEED = 2
    ACTUAL_SPEED = 3
    MAX_SPEED = 4
    MAX_ACCELERATION = 5
    POSITION_REACHED = 8
    HOME_SWITCH = 9
    RIGHT_LIMIT = 10
    LEFT_LIMIT = 11
    MICROSTEPS = 140
    EXTENDED_ERRORS = 207
    DRIVER_ERRORS = 208


SERIAL_HEARTBEAT = 68
"""Global parameter of bank 0 [ms], 0 = off."""
TICKS = 132
"""Global parameter of bank 0: milliseconds since the module started."""
LONGEST = 3 * SIZE
"""Bytes in which a reply must be found: a local echo, the reply, and what a disturbed line adds."""
EXECUTED = (100, 101)
STATUS = {
    1: (errno.EIO, "wrong checksum"),
    2: (errno.EOPNOTSUPP, "invalid command"),
    3: (errno.EINVAL, "wrong type"),
    4: (errno.EINVAL, "invalid value"),
    5: (errno.EPERM, "the configuration EEPROM is locked"),
    6: (errno.EOPNOTSUPP, "the command is not available"),
}
_READS = (Op.GAP, Op.GGP, Op.VERSION, Op.MST)
"""What may be sent again: reads, and the stop, which does no more the second time than the first."""


def checksum(data: bytes) -> int:
    """Return the sum of bytes modulo 256."""
    return sum(data) & 0xFF


def request(address: int, op: int, kind: int, motor: int, value: int) -> bytes:
    """Return a request.

    Raises:
        ValueError: a value outside 32 bits.

    Example:
        >>> request(1, Op.MVP, 0, 0, 10000).hex(" ")
        '01 04 00 00 00 00 27 10 3c'
    """
    if not -(2**31) <= value < 2**31:
        raise ValueError(f"value {value} does not fit; want {-(2**31)} to {2**31 - 1}")
    head = pack(">BBBBi", address, op, kind, motor, value)
    return head + bytes((checksum(head),))


@dataclass(frozen=True, slots=True)
class Module:
    """Requests to one module, as exchanges whose value is the reply's value.

    Args:
        address: of the module, 1 to 255.
        host: address that replies carry.
        turnaround_s: longest time that it needs to answer, the line's time included [s].
    """

    address: int
    host: int
    turnaround_s: float

    def exchange(self, op: Op, kind: int = 0, motor: int = 0, value: int = 0) -> Exchange:
        """Return a request and the check of its reply."""
        what = f"{op.name} {kind} of {_of(op, motor, self.address)}"
        repeatable = op in _READS or (op is Op.RFS and kind == 2)
        data = request(self.address, op, kind, motor, value)
        find, decode = self._finder(data, what), self._decoder(op, value, what)
        return Exchange(data, find, decode, self.turnaround_s, repeatable, what)

    def get(self, parameter: int, motor: int) -> Exchange:
        """Read an axis parameter."""
        return self.exchange(Op.GAP, parameter, motor)

    def set(self, parameter: int, motor: int, value: int) -> Exchange:
        """Write an axis parameter, in the module's memory alone."""
        return self.exchange(Op.SAP, parameter, motor, value)

    def _finder(self, sent: bytes, what: str) -> Callable[[bytes], int | None]:
        """Return what tells where the reply ends, behind a local echo of the request or stray bytes.

        Raises:
            LinkError: what came is damaged, or of another module.
        """

        def want(reply: bytes) -> int | None:
            for end in range(SIZE, len(reply) + 1):
                telegram = reply[end - SIZE : end]
                of_us = telegram[0] == self.host and (telegram[1] == self.address or telegram[2] == 1)
                if of_us and telegram != sent and is_telegram(telegram):
                    return end
            first = reply[:SIZE]
            if len(first) < SIZE or (first == sent and len(reply) < LONGEST):
                return None
            if first[:2] == bytes((self.host, self.address)):
                raise LinkError(f"{what}: the checksum of the reply is wrong ({first.hex(' ')})")
            if first != sent and is_telegram(first):
                raise LinkError(
                    f"{what}: the reply goes from {first[1]} to {first[0]}; want {self.address} to {self.host}"
                )
            if len(reply) >= LONGEST:
                raise LinkError(f"{what}: no reply in {len(reply)} bytes ({reply[:LONGEST].hex(' ')})")
            return None

        return want

    def _decoder(self, op: Op, sent: int, what: str) -> Callable[[bytes], int]:
        def decode(found: bytes) -> int:
            reply = found[-SIZE:]
            if not is_telegram(reply):
                raise LinkError(f"{what}: the checksum of the reply is wrong ({reply.hex(' ')})")
            host, module, status, command, value = unpack(">BBBBi", reply[:-1])
            if status == 1 and host == self.host:  # module and command are those of the last good telegram
                raise LinkError(f"{what}: the module received a wrong checksum")
            if (host, module) != (self.host, self.address):
                text = f"{what}: the reply goes from {module} to {host}; want {self.address} to {self.host}"
                raise LinkError(text)
            if command != op:
                raise LinkError(f"{what}: the reply answers command {command}; want {int(op)}")
            if status not in EXECUTED:
                errno_, text = STATUS.get(status, (errno.EIO, "unknown"))
                raise DeviceError(errno_, f"{what}, value {sent}: refused with status {status}, {text}")
            return int(value)

        return decode


def is_telegram(data: bytes) -> bool:
    """Tell whether these are nine bytes that a receiver takes for a telegram."""
    return len(data) == SIZE and checksum(data[:-1]) == data[-1]


# --- into step ------------------------------------------------------------------------------------
#
# A receiver out of step holds 0 to 8 bytes. Single bytes complete them, and the module answers: nine bytes with a wrong
# checksum draw status 1 at once, and with that reply it is in step. What it holds may be a motion command short of a
# byte, so the single bytes
# must complete no valid telegram. Zeros may: of "rotate right 1019" (01 01 00 00 00 00 03 fb 00) with one 00 lost, one
# more 00 makes
# 260864. What is held is a piece of what was sent last; of each piece of 9 - k bytes the k-th byte may not be the
# checksum: ten values at most that the k-th byte must avoid, of 256.


def remnants(telegram: bytes) -> set[bytes]:
    """Return what a receiver may hold of a telegram that lost one run of bytes, or part of which went to the telegram
    before.
    """
    return {telegram[:i] + telegram[j:] for i in range(SIZE) for j in range(i + 1, SIZE + 1)}


def padding(module: int, suspects: Iterable[bytes]) -> bytes:
    """Return nine single bytes none of which completes a valid telegram of what is left of the suspects.

    None of them is the module's address, or 0, so nothing that begins with them is for this module either.

    Example:
        >>> padding(1, [request(1, Op.ROR, 0, 0, 1019)]).hex(" ")
        'fe ff fe ff ff ff ff ff ff'
    """
    held = [piece for suspect in suspects for piece in remnants(suspect)]
    found = b""
    for count in range(1, SIZE + 1):
        avoid = {checksum(piece + found) for piece in held if len(piece) == SIZE - count} | {0, module}
        found += bytes((next(value for value in range(255, 0, -1) if value not in avoid),))
    return found


def separator(telegram: bytes) -> int:
    """Return a byte that, sent between repetitions of a telegram, makes no valid telegram wherever a receiver cuts
    them.
    """

    def is_safe(value: int) -> bool:
        row = telegram + bytes((value,)) + telegram
        return not any(is_telegram(row[start : start + SIZE]) for start in range(1, SIZE + 1))

    return next(value for value in range(255, 0, -1) if is_safe(value) and value != telegram[0])


class Framing:
    """Whether a module is in step, and the single bytes that bring it back.

    Concurrency: one thread; several jobs of one line may share it, for a stop may come between any two exchanges of
        another.

    Attributes:
        unanswered: the telegram that drew no right answer, b"" when the module is in step.
        refused: the answer was that the module received a wrong checksum.
    """

    def __init__(self, address: int) -> None:
        self.unanswered = b""
        self.refused = False
        self._address = address
        self._pads = self._heard = b""
        self._asks = False

    def watched(self, exchange: Exchange) -> Exchange:
        """Return an exchange that tells here how it went, and that the line does not repeat by itself."""

        def decode(reply: bytes) -> Any:
            try:
                value = exchange.decode(reply)
            except LinkError:
                self.refused = True
                raise
            except DeviceError:
                self.unanswered = b""
                raise
            self.unanswered = b""
            return value

        self.unanswered, self.refused, self._pads, self._asks = exchange.data, False, b"", False
        return replace(exchange, decode=decode, repeatable=False)

    def next_pad(self) -> bytes:
        """Return the next single byte to be sent."""
        if not self._pads:
            self._pads, self._heard = padding(self._address, [self.unanswered]), b""
        pad, self._pads, self._asks = self._pads[:1], self._pads[1:], True
        return pad

    def overheard(self, data: bytes, now_ns: int) -> None:
        """Take what came while no reply was awaited: status 1 says that the module is in step."""
        self._heard = (self._heard + data)[-LONGEST:]
        telegrams = (self._heard[end - SIZE : end] for end in range(SIZE, len(self._heard) + 1))
        if self._asks and any(is_telegram(each) and each[2] == 1 for each in telegrams):
            self.unanswered, self._heard, self._asks = b"", b"", False


def _of(op: Op, motor: int, address: int) -> str:
    motors = "" if op in (Op.VERSION, Op.GGP, Op.SGP, Op.END_PROGRAM) else f"motor {motor} of "
    return f"{motors}module {address}"
