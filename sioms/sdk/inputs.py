"""Nodes of other devices that a driver reads."""

from __future__ import annotations

import mmap
import os
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sioms.protocol.flags import AxisStatus
from sioms.protocol.page import SLOT_HEADER, NotReadable, PageReader, as_of_ns, slot_header
from sioms.protocol.records import VALUE, read_rows

from .blocks import unfit

_LOST = int(AxisStatus.POSITION_LOST)


class NotMeasuredError(ValueError):
    """A node has no reading that may be relied on; the text names it and says why."""


class Input:
    """A node of another device; empty until the daemon hands its page over, and again after every restart.

    Concurrency: one thread.
    """

    def __init__(self, name: str) -> None:
        self.name = name
        self.stamp_ns = self.as_of_ns = self.missed = 0
        self._number = 0
        self._reader: PageReader | None = None
        self._map: mmap.mmap | None = None

    def attach(self, fd: int, channels: Sequence[int], bit: int) -> None:
        """Take the page of the present driver process; closes the descriptor."""
        self.detach()
        size = os.fstat(fd).st_size
        self._map = mmap.mmap(fd, size, prot=mmap.PROT_READ)
        os.close(fd)
        self._reader = PageReader(self._map)
        self._channels = np.array(channels, dtype=np.intp)
        self._all = list(channels) == list(range(self._reader.channels))
        self._bit = bit
        self._number = 0

    def detach(self) -> None:
        """Let the page go."""
        if self._reader is not None and self._map is not None:
            self._reader.release()
            self._map.close()
        self._reader, self._map = None, None

    def read(self, now_ns: int) -> Mapping[str, NDArray[Any]] | None:
        """Return the readings, shape (channels,) each, by name; None while the device is not there.

        ``value`` is the position of axes and the data of all others; the columns of the record are there, too.
        """
        reader = self._reader
        if reader is None:
            return None
        try:
            raw = reader.latest(now_ns)
        except NotReadable:
            return None
        self._number, self.stamp_ns, _ = slot_header(raw)
        self.as_of_ns = as_of_ns(raw)
        return self._readings(reader, raw)

    def measured(self, now_ns: int, since_ns: int = 0) -> NDArray[np.float64]:
        """Return the values, shape (channels,), for who acts on them: forces, loads, positions.

        Args:
            now_ns: instant of the tick [ns].
            since_ns: the oldest time stamp that will do [ns].

        Raises:
            NotMeasuredError: its device is not there, a reading is flagged INVALID or SATURATED, is not finite, is too
                old, or is the position of an axis that has lost its place.
        """
        reading = self.read(now_ns)
        if reading is None:
            raise NotMeasuredError(f"{self.name}: it cannot be read; want its device up")
        value = np.asarray(reading["value"], dtype=np.float64)
        why = ""
        if "flags" in reading and unfit(reading["flags"], value).any():
            why = f"it reads {_first(value)}, flagged {int(np.bitwise_or.reduce(reading['flags'])):#x}"
            why += "; want a value that is finite, neither INVALID nor SATURATED"
        elif not np.isfinite(value).all():
            why = f"it reads {_first(value)}; want a finite value"
        elif "status" in reading and int(np.bitwise_or.reduce(reading["status"])) & _LOST:
            why = "its place is not known; want it homed or calibrated"
        elif self.stamp_ns < since_ns:
            why = f"its last reading is {(now_ns - self.stamp_ns) / 1e9:.3f} s old"
            why += f"; want at most {(now_ns - since_ns) / 1e9:.3f} s"
        if why:
            raise NotMeasuredError(f"{self.name}: {why}")
        return value

    def fresh(self, now_ns: int) -> list[tuple[int, Mapping[str, NDArray[Any]]]]:
        """Return all snapshots since the last look, oldest first, as (stamp_ns, readings as of ``read``).

        None is lost as long as the looks are no further apart than what the page keeps; ``missed`` is how many were.
        Nothing comes while the device is not there.
        """
        self.missed = 0
        if self._reader is None:
            return []
        try:
            self._reader.check(now_ns)
        except NotReadable:
            return []
        reader, head = self._reader, self._reader.head
        first = max(self._number + 1, head - reader.slots + 2, 1) if self._number else max(head, 1)
        self.missed = first - self._number - 1 if self._number else 0
        found = []
        for number in range(first, head + 1):
            raw = reader.numbered(number)
            if raw is None:
                self.missed += 1  # overwritten meanwhile
            else:
                self._number, self.stamp_ns, _ = slot_header(raw)
                self.as_of_ns = as_of_ns(raw)
                found.append((self.stamp_ns, self._readings(reader, raw)))
        return found

    def _readings(self, reader: PageReader, raw: bytes) -> Mapping[str, NDArray[Any]]:
        fields = np.frombuffer(raw, np.float64, offset=SLOT_HEADER).reshape(-1, reader.channels)
        if not self._all:
            fields = fields[:, self._channels]
        readings = read_rows(reader.node_class, fields)
        if self._bit >= 0:
            readings["data"] = readings["data"] >> self._bit & 1
        readings["value"] = readings[VALUE[reader.node_class]]
        return readings


def _first(values: NDArray[np.float64]) -> str:
    """Return a value for a message: the first that is not finite, if there is one."""
    odd = values[~np.isfinite(values)]
    return f"{(odd if odd.size else values)[0]:g}"
