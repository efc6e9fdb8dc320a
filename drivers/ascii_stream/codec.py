"""Lines of numbers as most Arduino-class front ends send them.

Lines end in LF or CR LF; numbers are separated by comma, semicolon, tab or blanks; ``#`` begins a
comment line; ``*hh`` at the end is the exclusive-or of the characters before the star. The first
line after opening is cut somewhere and therefore dropped.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

from sioms.sdk.codec.checksum import xor8

MAX_LINE_BYTES = 4096
_SEPARATORS = re.compile(rb"[,;\t ]+")


@dataclass(slots=True)
class LineCounters:
    """What a receiver saw since it started."""

    lines: int = 0
    bad_columns: int = 0
    bad_number: int = 0
    bad_checksum: int = 0
    oversized: int = 0

    @property
    def dropped(self) -> int:
        """Lines that carried no row although they should have."""
        return self.bad_columns + self.bad_number + self.bad_checksum + self.oversized


class LineReceiver:
    """Turns any cut of the byte stream into rows of ``columns`` finite numbers.

    Args:
        columns: numbers a line must have, a time column included.
        checked: demand a checksum on every line; otherwise it is checked where it is present.
    """

    def __init__(self, columns: int, checked: bool = False) -> None:
        if columns < 1:
            raise ValueError(f"columns is {columns}; want at least 1")
        self.counters = LineCounters()
        self._columns, self._checked = columns, checked
        self._rest = b""
        self._skipping = True

    def restart(self) -> None:
        """Forget a line that has begun: the device was opened again, and the next line may be cut."""
        self._rest, self._skipping = b"", True

    def feed(self, data: bytes) -> list[tuple[float, ...]]:
        """Return the rows that ``data`` completes, in order."""
        lines = (self._rest + data).split(b"\n")
        self._rest = lines.pop()
        rows = []
        for line in lines:
            if self._skipping:
                self._skipping = False
            elif (row := self._parse(line.strip())) is not None:
                rows.append(row)
        if len(self._rest) > MAX_LINE_BYTES:
            self.counters.oversized += not self._skipping
            self._skipping = True
        if self._skipping:
            self._rest = b""
        return rows

    def _parse(self, line: bytes) -> tuple[float, ...] | None:
        if not line or line.startswith(b"#"):
            return None
        if len(line) > MAX_LINE_BYTES:
            self.counters.oversized += 1
            return None
        body, star, digits = line.rpartition(b"*")
        if not star:
            body = line
        if (star or self._checked) and not _checks(body, digits if star else b""):
            self.counters.bad_checksum += 1
            return None
        return self._numbers([word for word in _SEPARATORS.split(body.strip()) if word])

    def _numbers(self, words: list[bytes]) -> tuple[float, ...] | None:
        if len(words) != self._columns:
            self.counters.bad_columns += 1
            return None
        try:
            row = tuple(float(word) for word in words)
        except ValueError:
            row = (math.nan,)
        if not all(map(math.isfinite, row)):
            self.counters.bad_number += 1
            return None
        self.counters.lines += 1
        return row


def _checks(body: bytes, digits: bytes) -> bool:
    return re.fullmatch(rb"[0-9A-Fa-f]{2}", digits) is not None and xor8(body) == int(digits, 16)
