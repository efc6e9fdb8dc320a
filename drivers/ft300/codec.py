"""Robotiq FT 300 on its serial line, without I/O: the registers, and the records that it sends at 100 Hz when told to.

A record is ``20 4E``, six little-endian i16 (0.01 N, 0.001 N m) and CRC-16/MODBUS over these 14 bytes. The two bytes of
the head occur in data too, so a record is what has the head and the right CRC. While it streams the sensor takes no
Modbus request;
0xFF, sent for half a second, ends the stream. Source: Robotiq FT 300 instruction manual, chapter on serial
    communication.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from struct import Struct

from sioms.sdk.codec.checksum import crc16_modbus

BAUD = 19200
SLAVE = 9
RATE_HZ = 100.0
FORCE_N, TORQUE_NM = 0.01, 0.001
"""A count of a force and of a torque."""
ACCELERATION_MS2 = 0.001 * 9.80665
"""A count of an acceleration: a thousandth of the standard gravity."""
FORCES_AT, ACCELERATION_AT, STREAM_AT, FIRMWARE_AT, SERIAL_AT = 180, 190, 410, 500, 510
"""First registers; from SERIAL_AT on: two unused, serial number low and high word, year of production."""
START_STREAM = 0x0200
STOP_BYTE = b"\xff"
STOP_S = 0.5
"""How long the manual has 0xFF sent to end the stream [s]."""
QUIET_S = 0.1
"""Time that the sensor then needs until it takes requests [s]."""
FROZEN_AFTER = 12
"""So many equal records in a row are no measurement: see :class:`Standstill`."""
HEAD = b"\x20\x4e"
RECORD_BYTES = 16
_RECORD = Struct("<2x6hH")


@dataclass(slots=True)
class Counters:
    """What the receiver has seen.

    Attributes:
        records: good ones.
        bad_crc: heads without a record behind them, damaged or a coincidence in data.
        skipped_bytes: bytes in no record.
        lost: records that skipped bytes must have been, estimated by their number.
    """

    records: int = 0
    bad_crc: int = 0
    skipped_bytes: int = 0
    lost: int = 0


class RecordReceiver:
    """Finds the records in a stream of bytes, however it is cut.

    Example:
        >>> RecordReceiver().feed(bytes.fromhex("ff204ed8fe2efb2e16640038ff2c017daf"))
        [((-296, -1234, 5678, 100, -200, 300), False)]
    """

    def __init__(self) -> None:
        self.counters = Counters()
        self.restart()

    def restart(self) -> None:
        """Forget what has come: the stream begins anew."""
        self._rest = b""
        self._skipped = 0
        self._synchronised = False

    def feed(self, data: bytes) -> list[tuple[tuple[int, ...], bool]]:
        """Take bytes; return the records in them, each with whether others were lost right before it."""
        data, at, found = self._rest + data, 0, []
        counters = self.counters
        while (head := data.find(HEAD, at)) >= 0:
            self._skip(head - at)
            at = head
            if len(data) - at < RECORD_BYTES:
                break
            *values, crc = _RECORD.unpack_from(data, at)
            if crc16_modbus(data[at : at + RECORD_BYTES - 2]) == crc:
                found.append((tuple(values), self._count_lost()))
                counters.records += 1
                at += RECORD_BYTES
            else:
                counters.bad_crc += 1
                self._skip(1)
                at += 1
        else:
            keep = 1 if data.endswith(HEAD[:1]) and at < len(data) else 0
            self._skip(len(data) - keep - at)
            at = len(data) - keep
        self._rest = data[at:]
        return found

    def _skip(self, count: int) -> None:
        self._skipped += count
        self.counters.skipped_bytes += count

    def _count_lost(self) -> bool:
        """Return whether records were lost before this one; what comes before the first one is no loss."""
        lost = -(-self._skipped // RECORD_BYTES) if self._synchronised else 0
        self.counters.lost += lost
        self._skipped, self._synchronised = 0, True
        return lost > 0


class Standstill:
    """Tells a sensor that measures from one that repeats itself. The records carry neither number nor time.

    What can be known: the data sheet gives a noise of 0.1 N and 0.005 N m or more, some counts in each of the six
    channels, so two records are equal once in 10**6 at the most, and twelve in a row never. A converter at its end may
    stand still in one channel, not in all six. **A sensor that repeats the last hundred records cannot be told from a
    load that repeats itself.**

    Attributes:
        equal: records like the last one, in a row.

    Example:
        >>> still = Standstill()
        >>> [still.is_fresh((1, 2, 3, 4, 5, 6)) for _ in range(14)].count(True)
        12
        >>> still.is_fresh((1, 2, 3, 4, 5, 7))
        True
    """

    def __init__(self) -> None:
        self.equal = 0
        self._last: tuple[int, ...] | None = None

    def is_fresh(self, counts: tuple[int, ...]) -> bool:
        """Take a record; return whether it may be a new measurement. A new opening changes nothing of what was seen."""
        self.equal = self.equal + 1 if counts == self._last else 0
        self._last = counts
        return self.equal < FROZEN_AFTER

    @property
    def text(self) -> str:
        """What to say of it."""
        return f"the last {self.equal + 1} records were all the same, which no measurement is: the sensor is frozen"


def build_record(counts: Sequence[int]) -> bytes:
    """Return the record of six counts from -32768 to 32767.

    Example:
        >>> build_record((-296, -1234, 5678, 100, -200, 300)).hex(" ")
        '20 4e d8 fe 2e fb 2e 16 64 00 38 ff 2c 01 7d af'
    """
    body = HEAD + _RECORD.pack(*counts, 0)[2:-2]
    return body + crc16_modbus(body).to_bytes(2, "little")
