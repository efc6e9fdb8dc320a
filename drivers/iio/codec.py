"""Scans of Linux IIO buffers, without I/O: what an element's type says, where it lies in a scan, what its bits mean.

The kernel describes each element of a scan as ``[be|le]:[s|u]bits/storagebits[Xrepeat][>>shift]``. Elements are stored
in the order of their index, each aligned to its own storage; the scan is padded to the largest of them. An element's
value is its word shifted right, cut to its bits, and sign-extended (kernel documents ``sysfs-bus-iio``,
``iio_compute_scan_bytes``).
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

_TYPE = re.compile(r"(be|le):([su])(\d+)/(\d+)(?:X(\d+))?(?:>>(\d+))?")
STORAGE_BITS = (8, 16, 32, 64)
UNITS = {
    "voltage": ("V", 1e-3), "current": ("A", 1e-3), "power": ("W", 1e-3), "resistance": ("Ohm", 1.0),
    "capacitance": ("F", 1e-9), "temp": ("degC", 1e-3), "accel": ("m/s^2", 1.0), "anglvel": ("rad/s", 1.0),
    "angl": ("rad", 1.0), "incli": ("rad", math.pi / 180), "magn": ("T", 1e-4), "pressure": ("Pa", 1e3),
    "humidityrelative": ("%", 1e-3), "illuminance": ("lx", 1.0), "distance": ("m", 1.0), "proximity": ("", 1.0),
}  # fmt: skip
"""Kind of a channel to its SI unit and the factor from what the kernel gives after scale and offset (mV, mA, nF, kPa,
gauss ...).
"""


def unit_of(name: str) -> tuple[str, float]:
    """Return the SI unit of a channel and the factor to it; unknown kinds have none and keep the kernel's number.

    Example:
        >>> unit_of("voltage0-voltage1"), unit_of("accel_x"), unit_of("tilt3")
        (('V', 0.001), ('m/s^2', 1.0), ('', 1.0))
    """
    return UNITS.get(kind_of(name), ("", 1.0))


def kind_of(name: str) -> str:
    """Return the kind of a channel: its name up to number, modifier or difference.

    Example:
        >>> kind_of("voltage0-voltage1"), kind_of("accel_x"), kind_of("temp")
        ('voltage', 'accel', 'temp')
    """
    return re.split(r"[\d_-]", name, maxsplit=1)[0]


@dataclass(frozen=True, slots=True)
class ElementType:
    """How an element is stored.

    Args:
        big: big-endian.
        signed: two's complement in its bits.
        bits: that carry the value.
        storage: bits of the word.
        repeat: words of the element.
        shift: places to shift right first.
    """

    big: bool
    signed: bool
    bits: int
    storage: int
    repeat: int = 1
    shift: int = 0

    @property
    def size(self) -> int:
        """Bytes of the element, which are also its alignment."""
        return self.storage // 8 * self.repeat


def parse_type(text: str) -> ElementType:
    """Return an element's type.

    Raises:
        ValueError: it is none, or its bits do not fit its word.

    Example:
        >>> parse_type("be:s12/16>>4")
        ElementType(big=True, signed=True, bits=12, storage=16, repeat=1, shift=4)
    """
    match = _TYPE.fullmatch(text.strip())
    if match is None:
        raise ValueError(f"read a scan type: {text.strip()!r} is not one; want e.g. le:s12/16>>4")
    order, sign = match[1], match[2]
    bits, storage, repeat, shift = (int(match[i] or default) for i, default in ((3, 0), (4, 0), (5, 1), (6, 0)))
    if storage not in STORAGE_BITS or not 0 < bits + shift <= storage or bits < 1 or repeat < 1:
        raise ValueError(
            f"read a scan type: {text.strip()!r} holds {bits} bits shifted by {shift} in {storage}; "
            "want 8, 16, 32 or 64 that take them"
        )
    return ElementType(order == "be", sign == "s", bits, storage, repeat, shift)


@dataclass(frozen=True, slots=True)
class Element:
    """A channel in a scan: its name, its place in the order, its type."""

    name: str
    index: int
    type: ElementType


class Layout:
    """Where the elements of a scan lie.

    Args:
        elements: those that are switched on, in any order.

    Attributes:
        elements: in the order of their index.
        offsets: of each [bytes].
        size: of a scan [bytes].

    Example:
        >>> dummy = ["le:u13/16>>0", "le:s12/16>>0", "le:s11/16>>0", "le:s16/16>>0", "le:s64/64>>0"]
        >>> layout = Layout([Element(str(i), i, parse_type(text)) for i, text in enumerate(dummy)])
        >>> layout.offsets, layout.size
        ([0, 2, 4, 6, 8], 16)
    """

    def __init__(self, elements: Sequence[Element]) -> None:
        if not elements:
            raise ValueError("lay out a scan: it has no element; want at least one channel")
        self.elements = sorted(elements, key=lambda element: element.index)
        self.offsets: list[int] = []
        at = 0
        for element in self.elements:
            size = element.type.size
            at = -(-at // size) * size
            self.offsets.append(at)
            at += size
        largest = max(element.type.size for element in self.elements)
        self.size = -(-at // largest) * largest

    def decode(self, data: bytes) -> dict[str, NDArray[np.int64]]:
        """Return element to raw values, shape (scans,), or (scans, repeat) of repeated ones; whole scans only.

        Unsigned words of 64 bits beyond the range of int64 are not told apart from negative ones.
        """
        scans = len(data) // self.size
        return {
            element.name: _decode(data, scans, self.size, offset, element.type)
            for element, offset in zip(self.elements, self.offsets, strict=True)
        }


def _decode(data: bytes, scans: int, size: int, offset: int, kind: ElementType) -> NDArray[np.int64]:
    width = kind.storage // 8
    order = ">" if kind.big else "<"
    words = np.empty((0, kind.repeat), np.uint64)
    if scans:
        words = np.ndarray((scans, kind.repeat), f"{order}u{width}", data, offset, (size, width))
    values = words.astype(np.uint64) >> np.uint64(kind.shift)
    values &= np.uint64((1 << kind.bits) - 1)
    signed = values.astype(np.int64)
    if kind.signed and kind.bits < 64:
        sign = np.int64(1 << kind.bits - 1)
        signed = (signed ^ sign) - sign
    return signed if kind.repeat > 1 else signed[:, 0]


class ScanReceiver:
    """Turns any cut of a buffer's bytes into whole scans."""

    def __init__(self, size: int) -> None:
        self._size = size
        self._rest = b""

    def feed(self, data: bytes) -> bytes:
        """Return the whole scans that ``data`` completes."""
        data = self._rest + data
        whole = len(data) // self._size * self._size
        self._rest = data[whole:]
        return data[:whole]
