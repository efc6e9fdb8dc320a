"""MessagePack in plain Python, for processes that start too often to load the extension module.

Loading the package ``msgpack`` takes 6 ms, a quarter of what a shell tool takes from start to answer;
such a tool packs a handful of small messages. Only what the messages are made of is known: None,
booleans, 64-bit integers, doubles, text, bytes, arrays, and maps with text or bytes as keys. Tests hold
it against the package. Processes that do load the package let ``check`` see first what it is to unpack,
because the package knows no bound of nesting.
"""

from __future__ import annotations

from struct import Struct

TYPE_CHECKING = False
if TYPE_CHECKING:
    from typing import Any

_DOUBLE = Struct(">d")
_FLOAT = Struct(">f")
MAX_DEPTH = 16
"""Arrays and maps within each other at most; the deepest that messages need is 8."""
_HEADS = bytes([*range(0x80, 0xA0), 0xDC, 0xDD, 0xDE, 0xDF])
"""Kinds that begin an array or a map."""
_FIXED = (
    [0] * 0x80
    + [-1] * 0x20
    + [*range(32)]
    + [0, -1, 0, 0]
    + [-1] * 6
    + [4, 8, 1, 2, 4, 8, 1, 2, 4, 8]
    + [-1] * 12
    + [0] * 0x20
)
"""Bytes that follow a kind; -1: a length does, or it is none of ours."""


def pack(value: object) -> bytes:
    """Pack a value.

    Raises:
        TypeError: of a type that messages do not hold.
        OverflowError: an integer beyond 64 bits.
    """
    out = bytearray()
    _put(out, value)
    return bytes(out)


def unpack(data: bytes) -> Any:
    """Unpack exactly one value.

    Raises:
        ValueError: not one whole value of the known kinds.
    """
    try:
        value, end = _take(data, 0, 0)
    except IndexError:
        raise ValueError(f"{len(data)} bytes end within a value") from None
    if end != len(data):
        raise ValueError(f"{len(data) - end} bytes follow the value")
    return value


def check(data: bytes, most: int) -> None:
    """Check that what data begins with is no deeper than MAX_DEPTH, without building any value.

    The rest is left to who unpacks it: the package spends no more memory on a promise than there are bytes.

    Args:
        data: what is to be unpacked.
        most: values that arrays and maps may hold altogether; it bounds the time of the check itself.

    Raises:
        ValueError: it is deeper, holds more, or ends within a value.
    """
    if len(data) - len(data.translate(None, _HEADS)) <= MAX_DEPTH:
        return  # the usual message: whatever its bytes mean, they cannot nest deeper
    above: list[int] = []
    at, left, end = 0, 1, len(data)
    while True:
        while not left:
            if not above:
                return  # what follows the value is refused by who unpacks it
            left = above.pop()
        left -= 1
        if at >= end:
            raise ValueError(f"{end} bytes end within a value")
        kind = data[at]
        at += 1
        if (size := _FIXED[kind]) >= 0:
            at += size
        elif kind < 0xA0 or 0xDC <= kind <= 0xDF:
            if len(above) >= MAX_DEPTH:
                raise ValueError(f"values nested more than {MAX_DEPTH} deep")
            above.append(left)
            if kind < 0xA0:
                left = kind & 15
            else:
                left, at = _take_integer(data, at, 4 if kind & 1 else 2)
            if kind < 0x90 or kind >= 0xDE:
                left *= 2
            most -= left
            if most < 0:
                raise ValueError("too many values")
        elif 0xC4 <= kind <= 0xC6 or 0xD9 <= kind <= 0xDB:
            size, at = _take_integer(data, at, 1 << kind - (0xC4 if kind < 0xC7 else 0xD9))
            at += size
        else:
            raise ValueError(f"type {kind:#x}; messages do not contain this type")


def _put(out: bytearray, value: Any) -> None:
    if value is None:
        out.append(0xC0)
    elif value is True or value is False:
        out.append(0xC3 if value else 0xC2)
    elif isinstance(value, int):
        _put_integer(out, value)
    elif isinstance(value, float):
        out.append(0xCB)
        out += _DOUBLE.pack(value)
    elif isinstance(value, str):
        data = value.encode()
        _put_head(out, len(data), 0xA0, 32, 0xD9)
        out += data
    elif isinstance(value, bytes | bytearray | memoryview):
        _put_head(out, len(value), 0, 0, 0xC4)
        out += value
    elif isinstance(value, list | tuple):
        _put_head(out, len(value), 0x90, 16, 0xDB)
        for each in value:
            _put(out, each)
    elif isinstance(value, dict):
        _put_head(out, len(value), 0x80, 16, 0xDD)
        for key, each in value.items():
            _put(out, key)
            _put(out, each)
    else:
        raise TypeError(f"can not serialize '{type(value).__name__}' object")


def _put_integer(out: bytearray, value: int) -> None:
    if 0 <= value < 0x80:
        out.append(value)
    elif -0x20 <= value < 0:
        out.append(value & 0xFF)
    elif value >= 0:
        size = 1 if value < 1 << 8 else 2 if value < 1 << 16 else 4 if value < 1 << 32 else 8
        out.append(0xCC + size.bit_length() - 1)
        out += value.to_bytes(size, "big")
    else:
        size = 1 if value >= -1 << 7 else 2 if value >= -1 << 15 else 4 if value >= -1 << 31 else 8
        out.append(0xD0 + size.bit_length() - 1)
        out += value.to_bytes(size, "big", signed=True)


def _put_head(out: bytearray, length: int, short: int, most: int, first: int) -> None:
    """Put type and length: the short form below ``most``, else a length of 8 (text and bytes only), 16 or 32 bits."""
    if length < most:
        out.append(short | length)
    elif length < 1 << 8 and first in (0xD9, 0xC4):
        out += bytes((first, length))
    elif length < 1 << 16:
        out.append(first + 1)
        out += length.to_bytes(2, "big")
    else:
        out.append(first + 2)
        out += length.to_bytes(4, "big")


def _take(data: bytes, at: int, depth: int) -> tuple[Any, int]:
    """Return the value that begins at a place, and where the next one begins."""
    kind = data[at]
    at += 1
    if kind < 0x80:
        return kind, at
    if kind >= 0xE0:
        return kind - 0x100, at
    if kind < 0x90:
        return _take_map(data, at, kind & 15, depth)
    if kind < 0xA0:
        return _take_array(data, at, kind & 15, depth)
    if kind < 0xC0:
        return _take_text(data, at, kind & 31)
    match kind:
        case 0xC0:
            return None, at
        case 0xC2 | 0xC3:
            return kind == 0xC3, at
        case 0xC4 | 0xC5 | 0xC6:
            length, at = _take_integer(data, at, 1 << kind - 0xC4)
            return _cut(data, at, length), at + length
        case 0xCA:
            return _FLOAT.unpack(_cut(data, at, 4))[0], at + 4
        case 0xCB:
            return _DOUBLE.unpack(_cut(data, at, 8))[0], at + 8
        case 0xCC | 0xCD | 0xCE | 0xCF:
            return _take_integer(data, at, 1 << kind - 0xCC)
        case 0xD0 | 0xD1 | 0xD2 | 0xD3:
            return _take_integer(data, at, 1 << kind - 0xD0, True)
        case 0xD9 | 0xDA | 0xDB:
            length, at = _take_integer(data, at, 1 << kind - 0xD9)
            return _take_text(data, at, length)
        case 0xDC | 0xDD:
            length, at = _take_integer(data, at, 2 << kind - 0xDC)
            return _take_array(data, at, length, depth)
        case 0xDE | 0xDF:
            length, at = _take_integer(data, at, 2 << kind - 0xDE)
            return _take_map(data, at, length, depth)
    raise ValueError(f"type {kind:#x}; messages do not contain this type")


def _cut(data: bytes, at: int, length: int) -> bytes:
    if at + length > len(data):
        raise ValueError(f"{length} bytes announced, {len(data) - at} present")
    return data[at : at + length]


def _take_integer(data: bytes, at: int, size: int, signed: bool = False) -> tuple[int, int]:
    return int.from_bytes(_cut(data, at, size), "big", signed=signed), at + size


def _take_text(data: bytes, at: int, length: int) -> tuple[str, int]:
    return _cut(data, at, length).decode("utf-8"), at + length


def _take_array(data: bytes, at: int, length: int, depth: int) -> tuple[list[Any], int]:
    _check(data, at, length, depth)
    values = []
    for _ in range(length):
        value, at = _take(data, at, depth + 1)
        values.append(value)
    return values, at


def _take_map(data: bytes, at: int, length: int, depth: int) -> tuple[dict[Any, Any], int]:
    _check(data, at, 2 * length, depth)
    values = {}
    for _ in range(length):
        key, at = _take(data, at, depth + 1)
        if not isinstance(key, str | bytes):
            raise ValueError(f"{type(key).__name__} as key of a map; want text or bytes")
        values[key], at = _take(data, at, depth + 1)
    return values, at


def _check(data: bytes, at: int, values: int, depth: int) -> None:
    """Refuse what promises more than there is, before memory or stack are spent on it."""
    if values > len(data) - at:
        raise ValueError(f"{values} values announced, {len(data) - at} bytes present")
    if depth >= MAX_DEPTH:
        raise ValueError(f"values nested more than {MAX_DEPTH} deep")
