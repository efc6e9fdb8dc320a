"""The text of files: lines of numbers and words in, records out; a snapshot in, lines out. Pure.

A line that is written is either a number for each channel, its position, value or bits::

    0.1 0.2

or a command for one channel, which a node of several names or counts::

    xaxis position=0.1 time=0.5

by the words of ``sioms.command``, with ``relative``, ``synch`` and ``replace`` (instead of what the node does) beside
them. What stands behind ``#`` is left out. All lines of one write are taken, or none.

Programs that fill a buffer write whole blocks, wherever a line ends: the last line of a block waits for its end.
"""

from __future__ import annotations

import errno
from struct import Struct
from typing import Any

from sioms.client.command import command
from sioms.protocol.flags import NodeClass
from sioms.protocol.nodeinfo import NodeInfo
from sioms.protocol.records import ANALOG_WRITE, BINARY_WRITE, READ, VALUE, WRITE_STRUCT

SHOWN = {
    NodeClass.AXIS: ("in_motion", "position", "velocity", "force"),
    NodeClass.ANALOG: ("known",),
    NodeClass.BINARY: ("data",),
}
"""Columns of a line that is read, behind the index of the channel; those of ``devin``."""
BLOCK, LARGE = 512, 4096
"""Programs write what they have buffered in multiples of so many bytes; the kernel cuts what is large anywhere."""
LONGEST = 65536
"""Bytes of a line that may wait for its end."""
_PLAIN = ("relative", "synch")
_WHOLE = ("wait", "signal")


def bad(info: NodeInfo, what: str) -> OSError:
    """Return a refusal of what was written."""
    return OSError(errno.EINVAL, f"write {info.name}: {what}")


def ended(rest: bytes, data: bytes) -> tuple[bytes, bytes]:
    """Return the lines that are complete, and the beginning of one that waits for the next write.

    Args:
        rest: what has waited.
        data: as it was written. A last line without its end is complete unless this may be a block of a longer text.

    Example:
        >>> ended(b"", b"0.1"), ended(b"0.0", b"5\\n")
        ((b'0.1', b''), (b'0.05\\n', b''))
        >>> ended(b"", b"0.1\\n" * 127 + b"0.05")[1]
        b'0.05'
    """
    text = rest + data
    if len(data) < LARGE and len(data) % BLOCK:
        return text, b""
    head, newline, tail = text.rpartition(b"\n")
    return head + newline, tail


def records(text: str, info: NodeInfo) -> tuple[bytes, bool]:
    """Return the records that lines of text mean, and whether they replace what the node does.

    Args:
        text: as it was written.
        info: of the node.

    Raises:
        OSError: EINVAL, with a sentence that names the line.
    """
    out, replace = [], False
    for number, line in enumerate(text.split("\n"), 1):
        words = line.partition("#")[0].replace(",", " ").split()
        if not words:
            continue
        try:
            numbers = _numbers(words)
            if numbers is not None:
                out.append(_values(numbers, info))
            else:
                replace |= "replace" in words
                out.append(_command([word for word in words if word != "replace"], info))
        except (ValueError, TypeError) as error:
            raise bad(info, f"line {number}: {error}") from None
    if not out:
        raise bad(info, f"no numbers; want {_wanted(info)}")
    return b"".join(out), replace


def whole_records(data: bytes, info: NodeInfo) -> bytes:
    """Return binary records as they were written.

    Raises:
        OSError: EINVAL, a part of one.
    """
    size = WRITE_STRUCT[info.node_class].size
    if not data or len(data) % size:
        raise bad(info, f"{len(data)} bytes; want whole records of {size} bytes")
    return data


def shown(snapshot: Any, info: NodeInfo) -> str:
    """Return the lines of a snapshot, one a channel: its index, then the columns of ``SHOWN``; nan where an analog
    value is INVALID.
    """
    columns = [getattr(snapshot, name) for name in SHOWN[info.node_class]]
    rows = zip(range(len(info.channels)), *columns, strict=True)
    return "".join([" ".join([f"{value:.9g}" for value in row]) + "\n" for row in rows])


def packed(snapshot: Any, info: NodeInfo) -> bytes:
    """Return the readings of a snapshot as records: each channel's columns one after the other, 8 bytes each."""
    table = READ[info.node_class]
    one = Struct("<" + "".join(column.code for column in table.values()))
    columns = [getattr(snapshot, name) for name in table]
    return b"".join([one.pack(*row) for row in zip(*columns, strict=True)])


def _numbers(words: list[str]) -> list[float] | None:
    try:
        return [float(word) for word in words]
    except ValueError:
        return None


def _values(numbers: list[float], info: NodeInfo) -> bytes:
    if len(numbers) != len(info.channels):
        raise ValueError(f"{len(numbers)} numbers; want {_wanted(info)}")
    match info.node_class:
        case NodeClass.AXIS:
            return b"".join([command(axis, position=value) for axis, value in enumerate(numbers)])
        case NodeClass.ANALOG:
            return b"".join([ANALOG_WRITE.pack(channel, 0, value) for channel, value in enumerate(numbers)])
        case NodeClass.BINARY:
            return b"".join([BINARY_WRITE.pack(i, 0, _whole(value), 0) for i, value in enumerate(numbers)])


def _command(words: list[str], info: NodeInfo) -> bytes:
    if info.node_class is not NodeClass.AXIS:
        raise ValueError(f"{words[0][:40]!r} is not a number; want {_wanted(info)}")
    axis = 0
    if not words:
        raise ValueError(f"'replace' and nothing to do instead; want WORD=NUMBER with it, or {_wanted(info)}")
    if "=" not in words[0] and words[0] not in _PLAIN:
        axis = _axis(words.pop(0), info)
    elif len(info.channels) > 1:
        raise ValueError(f"no axis is named; begin with one of {', '.join(c.name for c in info.channels)}")
    given: dict[str, Any] = {}
    for word in words:
        name, equals, value = word.partition("=")
        if name in given:
            raise ValueError(f"{name[:40]!r} is given twice")
        if not equals and name in _PLAIN:
            given[name] = True
        elif equals:
            given[name] = int(value, 10) if name in _WHOLE else float(value)
        else:
            raise ValueError(f"{word[:40]!r}; want WORD=NUMBER, as position=0.1, or {' or '.join(_PLAIN)}")
    return command(axis, **given)


def _axis(word: str, info: NodeInfo) -> int:
    names = [channel.name for channel in info.channels]
    if word in names:
        return names.index(word)
    if word.isdecimal() and int(word) < len(names):
        return int(word)
    raise ValueError(f"no axis {word[:40]!r}; there are: {', '.join(names)}")


def _whole(value: float) -> int:
    if not -(1 << 53) <= value <= 1 << 53 or value != int(value):
        raise ValueError(f"{value:g}; want integers for bits")
    return int(value)


def _wanted(info: NodeInfo) -> str:
    value = VALUE[info.node_class]
    names = [channel.name for channel in info.channels]
    if len(names) == 1:
        return f"one number, the {value} of {names[0]}"
    return f"{len(names)} numbers, the {value} of {', '.join(names)}"
