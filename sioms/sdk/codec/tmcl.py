"""Trinamic TMCL in its binary form, without I/O: nine bytes each way, closed by the sum of the first eight.

There is nothing to resynchronise on, so after a bad or missing reply the line has to fall silent before the next request
(``LineDriver.recovery_s``). Source: TMCL firmware manuals (TMCM-1140, TMCM-1276), chapter "TMCL and the TMCL-IDE".
"""

from __future__ import annotations

import errno
from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from struct import pack, unpack

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
        raise ValueError(f"value {value} does not fit; {-(2**31)} to {2**31 - 1} is right")
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
        of_motor = "" if op in (Op.VERSION, Op.GGP, Op.SGP) else f"motor {motor} of "
        what = f"{op.name} {kind} of {of_motor}module {self.address}"
        repeatable = op in _READS or (op is Op.RFS and kind == 2)
        data = request(self.address, op, kind, motor, value)
        return Exchange(data, _size, self._decoder(op, value, what), self.turnaround_s, repeatable, what)

    def get(self, parameter: int, motor: int) -> Exchange:
        """Read an axis parameter."""
        return self.exchange(Op.GAP, parameter, motor)

    def set(self, parameter: int, motor: int, value: int) -> Exchange:
        """Write an axis parameter, in the module's memory alone."""
        return self.exchange(Op.SAP, parameter, motor, value)

    def _decoder(self, op: Op, sent: int, what: str) -> Callable[[bytes], int]:
        def decode(reply: bytes) -> int:
            if len(reply) != SIZE or checksum(reply[:-1]) != reply[-1]:
                raise LinkError(f"{what}: the checksum of the reply is wrong ({reply.hex(' ')})")
            host, module, status, command, value = unpack(">BBBBi", reply[:-1])
            if (host, module) != (self.host, self.address):
                text = (
                    f"{what}: the reply goes from {module} to {host}; {self.address} to {self.host} is right"
                )
                raise LinkError(text)
            if status == 1:  # the command byte of such a reply is stale: the status comes first
                raise LinkError(f"{what}: the module received a wrong checksum")
            if command != op:
                raise LinkError(f"{what}: the reply answers command {command}; {int(op)} is right")
            if status not in EXECUTED:
                errno_, text = STATUS.get(status, (errno.EIO, "unknown"))
                raise DeviceError(errno_, f"{what}, value {sent}: refused with status {status}, {text}")
            return int(value)

        return decode


def _size(reply: bytes) -> int:
    return SIZE
