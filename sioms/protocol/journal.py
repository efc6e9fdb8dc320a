"""The journal of a process: a ring of events in shared memory, written by one process and read by any number.

The daemon and every driver process keep one: commands with who gave them, refusals, markers, stops, faults, log lines.
Writing takes no system call and waits for nobody, so no reader can slow a driver. A ring is bounded: who reads
too late has lost the oldest events, and the numbers of the others tell how many. The memory outlives the process
that writes it; what it noted last is there after its death, and its successor goes on where it ended.

Layout (little endian)::

    0   magic "SIOMSjn1"           24  tail: where the oldest whole event begins
    8   version u64                32  head: where the next one will begin
    16  bytes of the ring          40  number of the newest event, 0 = none yet
    64  the ring

    event: bytes of its payload u32, Note u32, number u64, stamp_ns u64 (CLOCK_MONOTONIC), then its payload, a
    msgpack array (see ``Note``), padded to 8 bytes

Positions only grow; an event lies at its position modulo the size of the ring, and may go round its end. The tail
moves on before what lies there is overwritten, and the head when an event is whole: a reader copies from
where it was up to the head, and what the tail has not passed meanwhile is good.

Concurrency: one writer thread; readers anywhere; stores must not be reordered, see ``page``.
"""

from __future__ import annotations

from struct import Struct

from .enumeration import IntEnum
from .messages import MalformedMessage, decode_payload, encode
from .page import fence

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Sequence
    from typing import Any

MAGIC = b"SIOMSjn1"
VERSION = 1
HEADER = 64
JOURNAL_SIZE = 1 << 19
"""Bytes of a journal: seconds of commands at a kilohertz."""
MOST = JOURNAL_SIZE // 4
"""Bytes of one payload at most."""
_TAIL, _HEAD, _NUMBER = 3, 4, 5
_EVENT = Struct("<IIQQ")
_HEADER = Struct("<8sQQ")


class Note(IntEnum):
    """What an event is, and what its payload holds."""

    COMMAND = 1
    """A driver has served a client: [node, who, message as it came, errno (0: taken), why it was refused]; records that
    come ahead of their write are an event of their own.
    """
    REFUSAL = 2
    """A driver has refused later what it had begun to serve: [node, who, message number, errno, why]."""
    STOP = 3
    """A driver stops: [kind of stop, why, [[block, channels, bit], ...]; none of them: the whole device]."""
    FAULT = 4
    """Axes are in fault: [names of the first, why]."""
    LINK = 5
    """The link to the device has changed: [name of the PageState, why]."""
    RESET = 6
    """Stops and faults are cleared: [block, channels]; '' and none: of the workcell."""
    LOG = 7
    """A line of the daemon's log: [level, event, {key: value as text}]."""
    REQUEST = 8
    """The daemon has served a client: [who, name of the verb, arguments, errno (0: done), why it was refused]."""
    MARKER = 9
    """A command of a driver has signalled a marker: [device, number of the marker]."""
    CLOSED = 10
    """A handle has ended: [node, who]."""


class Event:
    """An event that was read.

    Attributes:
        kind: a Note, or a number that this version does not know.
        number: running number in its journal.
        stamp_ns: when it was noted, or happened [ns, CLOCK_MONOTONIC].
        payload: packed.
    """

    __slots__ = ("kind", "number", "payload", "stamp_ns")

    def __init__(self, kind: int, number: int, stamp_ns: int, payload: bytes) -> None:
        self.kind = kind
        self.number = number
        self.stamp_ns = stamp_ns
        self.payload = payload

    def values(self) -> list[Any]:
        """Return what the payload holds.

        Raises:
            MalformedMessage: it is no payload.
        """
        values = decode_payload(self.payload)
        if not isinstance(values, list):
            raise MalformedMessage(f"event {self.number}: {type(values).__name__} as payload; want an array")
        return values


class JournalWriter:
    """The writing end of a journal.

    Args:
        buffer: zeroed memory, or a journal that is gone on with; HEADER and a multiple of 8 bytes, mapped writable.
    """

    def __init__(self, buffer: memoryview) -> None:
        self._bytes = buffer.cast("B")
        self._words = self._bytes[:HEADER].cast("Q")
        self._size = len(self._bytes) - HEADER
        if self._words[0] == 0:
            _HEADER.pack_into(self._bytes, 0, MAGIC, VERSION, self._size)

    def note(self, kind: int, stamp_ns: int, *values: object) -> None:
        """Note an event.

        Args:
            kind: a Note.
            stamp_ns: when it happened [ns, CLOCK_MONOTONIC].
            values: its payload, see there; what is longer than MOST is left out.
        """
        payload = encode(*values)
        if len(payload) > MOST:
            payload = encode(*[value if not isinstance(value, bytes) else value[: MOST // 2] for value in values])
        if len(payload) > MOST:
            payload = encode(*[value if isinstance(value, int) else str(value)[:200] for value in values[:8]])
        self.append(kind, payload, stamp_ns)

    def put(self, event: Event) -> None:
        """Append an event of another journal, of which this one is a copy, with its number."""
        self.append(event.kind, event.payload, event.stamp_ns, event.number)

    def append(self, kind: int, payload: bytes, stamp_ns: int, number: int = 0) -> None:
        """Append an event whose payload is packed, of at most MOST bytes; ``number`` 0: the next one."""
        words, size = self._words, self._size
        number, head = number or words[_NUMBER] + 1, words[_HEAD]
        event = _EVENT.pack(len(payload), kind, number, stamp_ns) + payload
        event += bytes(-len(event) % 8)
        end = head + len(event)
        tail = words[_TAIL]
        if end - tail > size:
            while end - tail > size:
                at = HEADER + tail % size
                tail += _EVENT.size + -(-int.from_bytes(self._bytes[at : at + 4], "little") // 8) * 8
            words[_TAIL] = tail
            fence()
        at = head % size
        first = min(len(event), size - at)
        self._bytes[HEADER + at : HEADER + at + first] = event[:first]
        if first < len(event):
            self._bytes[HEADER : HEADER + len(event) - first] = event[first:]
        words[_NUMBER] = number
        fence()
        words[_HEAD] = end

    def release(self) -> None:
        """Drop the views, so that the mapping can be closed."""
        self._words.release()
        self._bytes.release()


class JournalReader:
    """A reader of a journal, which goes through it once.

    Args:
        buffer: the mapping; slices of it copy.
        from_start: whether it begins with the oldest event that is kept, instead of the next one.

    Attributes:
        lost: events that were overwritten before they were read.

    Raises:
        MalformedMessage: no journal of this version.
    """

    def __init__(self, buffer, *, from_start: bool = True) -> None:  # type: ignore[no-untyped-def]  # mmap or bytes
        magic, version, size = _HEADER.unpack_from(buffer, 0)
        if magic != MAGIC or version != VERSION or size != len(buffer) - HEADER:
            raise MalformedMessage(f"map journal: magic {magic!r}, version {version}; want {MAGIC!r}, {VERSION}")
        self._buffer = buffer
        self._words = memoryview(buffer)[:HEADER].cast("Q")
        self._size = size
        self.lost = 0
        self._at = self._words[_TAIL] if from_start else self._words[_HEAD]
        self._last = 0

    def read(self, most_bytes: int = JOURNAL_SIZE) -> list[Event]:
        """Return the events since the last look, oldest first; those beyond so many bytes with the next look."""
        words = self._words
        head = words[_HEAD]
        if head == self._at:
            return []
        begin = max(self._at, words[_TAIL])
        data = self._copy(begin, head)
        good = words[_TAIL]  # what lies before it may have been overwritten while it was copied
        events, at = [], max(begin, good)
        while at < head and at - begin < most_bytes:
            length, kind, number, stamp_ns = _EVENT.unpack_from(data, at - begin)
            place = at - begin + _EVENT.size
            events.append(Event(kind, number, stamp_ns, data[place : place + length]))
            at += _EVENT.size + -(-length // 8) * 8
        self._at = at
        if events:
            last = self._last or events[0].number - 1
            self.lost += events[-1].number - last - len(events)
            self._last = events[-1].number
        return events

    def _copy(self, begin: int, end: int) -> bytes:
        first, last = begin % self._size, end % self._size
        if begin == end:
            return b""
        if first < last:
            return bytes(self._buffer[HEADER + first : HEADER + last])
        return bytes(self._buffer[HEADER + first : HEADER + self._size]) + bytes(self._buffer[HEADER : HEADER + last])

    def release(self) -> None:
        """Drop the view, so that the mapping can be closed."""
        self._words.release()


def pack_events(events: Sequence[Event]) -> bytes:
    """Return events as one piece of bytes."""
    return b"".join(
        _EVENT.pack(len(event.payload), event.kind, event.number, event.stamp_ns) + event.payload for event in events
    )


def take_events(data: bytes) -> list[Event]:
    """Take such a piece apart.

    Raises:
        MalformedMessage: it is none.
    """
    events, at = [], 0
    while at < len(data):
        if len(data) - at < _EVENT.size:
            raise MalformedMessage(f"{len(data) - at} bytes behind the last event")
        length, kind, number, stamp_ns = _EVENT.unpack_from(data, at)
        at += _EVENT.size
        if length > min(MOST, len(data) - at) or not number:
            raise MalformedMessage(f"event {number} of {length} bytes")
        events.append(Event(kind, number, stamp_ns, data[at : at + length]))
        at += length
    return events
