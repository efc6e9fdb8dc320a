"""Records of MCAP (https://mcap.dev/spec), packed and taken apart. Pure.

A file is a magic, records, and the magic again. While it is being written it has no end and no chunks: each message is
a record by itself, whole as soon as the system has taken it. A packed file has its messages in compressed chunks, each
with its checksum and indices, and a summary at the end.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from struct import Struct, error, pack, unpack_from
from typing import Any
from zlib import crc32

import numpy as np
from numpy.typing import NDArray

from sioms.protocol.text import printable

MAGIC = b"\x89MCAP0\r\n"
HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX, CHUNK_INDEX = range(1, 9)
STATISTICS, METADATA, METADATA_INDEX, SUMMARY_OFFSET, DATA_END = 0x0B, 0x0C, 0x0D, 0x0E, 0x0F
HEAD = 9
"""Bytes before the content of a record: its kind and its length."""
MESSAGE_HEAD = 22
"""Bytes before the data in the content of a message."""
LONGEST = 1 << 26
"""Bytes of one record, or of an unpacked chunk, that are believed."""
_RECORD = Struct("<BQ")
_MESSAGE = Struct("<BQHIQQ")
_CHUNK = Struct("<QQQI")
_Q = Struct("<Q")


class Damaged(ValueError):
    """Bytes that are no record."""


@dataclass(frozen=True, slots=True)
class Schema:
    """Type of the messages of a channel."""

    number: int
    name: str
    encoding: str
    data: bytes

    def packed(self) -> bytes:
        """Return the record."""
        return record(SCHEMA, pack("<H", self.number) + text(self.name) + text(self.encoding) + block(self.data))


@dataclass(frozen=True, slots=True)
class Channel:
    """A stream of messages of one type."""

    number: int
    schema: int
    topic: str
    encoding: str
    metadata: Mapping[str, str] = field(default_factory=dict)

    def packed(self) -> bytes:
        """Return the record."""
        head = pack("<HH", self.number, self.schema)
        return record(CHANNEL, head + text(self.topic) + text(self.encoding) + table(self.metadata))


@dataclass(frozen=True, slots=True)
class Chunk:
    """A chunk as it lies in a file, its records packed."""

    start_ns: int
    end_ns: int
    size: int
    checksum: int
    compression: str
    data: bytes

    def records(self) -> bytes:
        """Return its records.

        Raises:
            Damaged: they are not what they were, or cannot be unpacked.
            ModuleNotFoundError: zstandard is not installed.
        """
        data = self.data
        if self.size > LONGEST:
            raise Damaged(f"a chunk of {self.size} bytes; want at most {LONGEST}")
        if self.compression == "zstd":
            import zstandard

            try:
                if zstandard.frame_content_size(data) not in (-1, self.size):  # it says what will be allocated
                    raise Damaged("a chunk is not as long as it says")
                data = zstandard.ZstdDecompressor().decompress(data, max_output_size=self.size)
            except zstandard.ZstdError as problem:
                raise Damaged(f"a chunk cannot be unpacked: {problem}") from None
        elif self.compression:
            raise Damaged(f"a chunk is compressed by {self.compression!r}; want zstd, or none")
        if len(data) != self.size or (self.checksum and crc32(data) != self.checksum):
            raise Damaged("a chunk is not what it was when it was written: its checksum differs")
        return data


def record(kind: int, content: bytes) -> bytes:
    """Return a record."""
    return _RECORD.pack(kind, len(content)) + content


def text(value: str) -> bytes:
    """Return a string as it is in records."""
    return block(value.encode())


def block(value: bytes) -> bytes:
    """Return bytes as they are in records."""
    return pack("<I", len(value)) + value


def table(values: Mapping[str, str]) -> bytes:
    """Return a map of strings."""
    return block(b"".join([text(key) + text(value) for key, value in values.items()]))


def header(library: str) -> bytes:
    """Return the beginning of a file: the magic and the header."""
    return MAGIC + record(HEADER, text("ros2") + text(library))


def metadata(name: str, values: Mapping[str, str]) -> bytes:
    """Return a record of metadata."""
    return record(METADATA, text(name) + table(values))


def message(channel: int, sequence: int, time_ns: int, data: bytes) -> bytes:
    """Return a message; time [ns, UTC]."""
    size = MESSAGE_HEAD + len(data)
    return _MESSAGE.pack(MESSAGE, size, channel, sequence & 0xFFFFFFFF, time_ns, time_ns) + data


class Parts:
    """Takes the content of a record apart; too short a content is Damaged."""

    def __init__(self, content: bytes) -> None:
        self._content = content
        self._at = 0

    def take(self, layout: Struct) -> tuple[Any, ...]:
        """Return the next numbers."""
        try:
            values = layout.unpack_from(self._content, self._at)
        except error:
            raise Damaged("a record is too short for what it shall hold") from None
        self._at += layout.size
        return values

    def block(self, length: Struct = Struct("<I")) -> bytes:  # noqa: B008  # a constant
        """Return the next bytes."""
        (size,) = self.take(length)
        value = self._content[self._at : self._at + size]
        if len(value) != size:
            raise Damaged("a record is too short for what it shall hold")
        self._at += size
        return value

    def text(self) -> str:
        """Return the next string, made fit to be shown."""
        return printable(self.block().decode("utf-8", "replace"), LONGEST)

    def table(self) -> dict[str, str]:
        """Return the next map of strings."""
        inner, values = Parts(self.block()), {}
        while inner._at < len(inner._content):
            key = inner.text()
            values[key] = inner.text()
        return values


_HH, _H = Struct("<HH"), Struct("<H")


def schema_of(content: bytes) -> Schema:
    """Take a schema apart."""
    parts = Parts(content)
    return Schema(parts.take(_H)[0], parts.text(), parts.text(), parts.block())


def channel_of(content: bytes) -> Channel:
    """Take a channel apart."""
    parts = Parts(content)
    number, schema = parts.take(_HH)
    return Channel(number, schema, parts.text(), parts.text(), parts.table())


def metadata_of(content: bytes) -> tuple[str, dict[str, str]]:
    """Take metadata apart: name, values."""
    parts = Parts(content)
    return parts.text(), parts.table()


def chunk_of(content: bytes) -> Chunk:
    """Take a chunk apart."""
    parts = Parts(content)
    start, end, size, checksum = parts.take(_CHUNK)
    return Chunk(start, end, size, checksum, parts.text(), parts.block(_Q))


def walk(data: Any, at: int, end: int, base: int = 0) -> Iterator[tuple[int, int, int]]:
    """Yield the records between two places: kind, where the content begins and ends.

    Args:
        data: bytes of a file, or what a chunk holds.
        at, end: places in it.
        base: where it lies in the file, for the error.

    Raises:
        Damaged: what comes is no whole record.
    """
    unpack = _RECORD.unpack_from
    while at < end:
        if at + HEAD > end:
            raise Damaged(f"{end - at} bytes at {base + at} are no whole record")
        kind, size = unpack(data, at)
        stop = at + HEAD + size
        if not 1 <= kind <= DATA_END or size > LONGEST or stop > end:
            raise Damaged(f"what is at {base + at} is no whole record")
        yield kind, at + HEAD, stop
        at = stop


def size_of_first(data: bytes) -> int:
    """Return the bytes of the record at the beginning, 0 where there is none that is believed."""
    if len(data) < HEAD:
        return 0
    kind, size = _RECORD.unpack_from(data)
    return HEAD + int(size) if 1 <= kind <= DATA_END and size <= LONGEST else 0


def times(data: Any, offsets: NDArray[np.int64]) -> NDArray[np.uint64]:
    """Return the log times of the messages whose records begin at some places [ns]."""
    places = np.frombuffer(data, np.uint8)
    found: NDArray[np.uint64] = places[offsets[:, None] + np.arange(HEAD + 6, HEAD + 14)].view("<u8")[:, 0]
    return found


@dataclass(slots=True)
class ChunkPlace:
    """Where a chunk is in a file, for the summary."""

    start_ns: int
    end_ns: int
    offset: int
    length: int
    indices: dict[int, int]
    index_length: int
    compression: str
    packed_size: int
    size: int

    def packed(self) -> bytes:
        """Return the record of the summary."""
        places = b"".join([pack("<HQ", *each) for each in self.indices.items()])
        content = pack("<QQQQ", self.start_ns, self.end_ns, self.offset, self.length) + block(places)
        content += pack("<Q", self.index_length) + text(self.compression) + pack("<QQ", self.packed_size, self.size)
        return record(CHUNK_INDEX, content)


def pack_chunk(
    data: bytes, by_channel: Mapping[int, Iterable[int]], at: int, level: int = 3
) -> tuple[bytes, ChunkPlace, dict[int, int]]:
    """Pack messages to a chunk and its indices.

    Args:
        data: their records, one after the other.
        by_channel: where the records of each channel begin.
        at: where the chunk will lie in the file.
        level: of the compression.

    Returns:
        The bytes, the entry of the summary, and how many messages each channel has.
    """
    compression, packed = "", data
    try:
        import zstandard

        compression, packed = "zstd", zstandard.ZstdCompressor(level=level).compress(data)
    except ModuleNotFoundError:
        pass
    first_ns, last_ns, indices, counts = (1 << 64) - 1, 0, [], {}
    for channel, offsets in by_channel.items():
        places = np.asarray(offsets, np.int64)
        if not len(places):
            continue
        when = times(data, places)
        first_ns, last_ns = min(first_ns, int(when.min())), max(last_ns, int(when.max()))
        entries = np.empty((len(places), 2), "<u8")
        entries[:, 0], entries[:, 1] = when, places
        indices.append((channel, record(MESSAGE_INDEX, pack("<H", channel) + block(entries.tobytes()))))
        counts[channel] = len(places)
    first_ns = min(first_ns, last_ns)
    content = _CHUNK.pack(first_ns, last_ns, len(data), crc32(data)) + text(compression) + pack("<Q", len(packed))
    chunk = record(CHUNK, content + packed)
    place, where = at + len(chunk), {}
    for channel, index in indices:
        where[channel] = place
        place += len(index)
    entry = ChunkPlace(
        first_ns, last_ns, at, len(chunk), where, place - at - len(chunk), compression, len(packed), len(data)
    )
    return chunk + b"".join([index for _, index in indices]), entry, counts


def ending(
    at: int, schemas: Iterable[Schema], channels: Iterable[Channel], chunks: list[ChunkPlace],
    counts: Mapping[int, int], metadata_places: list[tuple[int, int, str]],
) -> bytes:  # fmt: skip
    """Return the end of a packed file: end of the data, summary, footer, magic.

    Args:
        at: where it will lie in the file.
        schemas, channels, chunks: of the file.
        counts: messages by channel.
        metadata_places: offset, length and name of each record of metadata.
    """
    end = record(DATA_END, pack("<I", 0))
    start = at + len(end)
    schemas, channels = list(schemas), list(channels)
    first_ns = min((c.start_ns for c in chunks), default=0)
    last_ns = max((c.end_ns for c in chunks), default=0)
    statistics = pack(
        "<QHIIIIQQ", sum(counts.values()), len(schemas), len(channels), 0, len(metadata_places), len(chunks), first_ns,
        last_ns,
    )  # fmt: skip
    statistics += block(b"".join([pack("<HQ", *each) for each in counts.items()]))
    groups = [
        (SCHEMA, b"".join([each.packed() for each in schemas])),
        (CHANNEL, b"".join([each.packed() for each in channels])),
        (STATISTICS, record(STATISTICS, statistics)),
        (CHUNK_INDEX, b"".join([each.packed() for each in chunks])),
        (METADATA_INDEX, b"".join([record(METADATA_INDEX, pack("<QQ", *m[:2]) + text(m[2])) for m in metadata_places])),
    ]
    summary, offsets = b"", b""
    for kind, group in groups:
        if group:
            offsets += record(SUMMARY_OFFSET, pack("<BQQ", kind, start + len(summary), len(group)))
            summary += group
    footer = _RECORD.pack(FOOTER, 20) + pack("<QQ", start, start + len(summary))
    checksum = crc32(summary + offsets + footer)
    return end + summary + offsets + footer + pack("<I", checksum) + MAGIC


def message_at(data: Any, at: int) -> tuple[int, int, int]:
    """Return channel, sequence and log time [ns] of the message whose record begins at a place."""
    channel, sequence, when = unpack_from("<HIQ", data, at + HEAD)
    return channel, sequence, when
