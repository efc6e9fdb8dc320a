"""Writes recordings anew: packs, cuts, merges, repairs."""

from __future__ import annotations

import os
from collections.abc import Collection, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from struct import pack
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from . import mcap
from .reader import Piece, Recording

LIBRARY = "sioms"
CHUNK = 4 << 20
"""Bytes of a chunk before it is packed."""
PACKING = ".packing"
"""Added to the name of a file until it is whole."""


@dataclass(slots=True)
class PackedFile:
    """A packed recording that is being written.

    Attributes:
        file: where it goes.
    """

    file: BinaryIO
    schemas: dict[tuple[str, bytes], mcap.Schema] = field(default_factory=dict)
    channels: list[mcap.Channel] = field(default_factory=list)
    chunks: list[mcap.ChunkPlace] = field(default_factory=list)
    counts: dict[int, int] = field(default_factory=dict)
    metadata: list[tuple[int, int, str]] = field(default_factory=list)
    _at: int = 0
    _parts: list[bytes] = field(default_factory=list)
    _size: int = 0
    _places: dict[int, list[NDArray[np.int64]]] = field(default_factory=dict)

    def begin(self) -> None:
        """Write the header."""
        self._write(mcap.header(LIBRARY))

    def note(self, name: str, values: dict[str, str]) -> None:
        """Write metadata."""
        record = mcap.metadata(name, values)
        self.metadata.append((self._at, len(record), name))
        self._write(record)

    def channel(self, channel: mcap.Channel, schema: mcap.Schema) -> int:
        """Add a channel, unless there is one like it; return its number in this file."""
        key = schema.name, schema.data
        if key not in self.schemas:
            self.schemas[key] = mcap.Schema(len(self.schemas) + 1, schema.name, schema.encoding, schema.data)
            self._write(self.schemas[key].packed())
        number = self.schemas[key].number
        for known in self.channels:
            if (known.topic, known.schema, known.metadata) == (channel.topic, number, channel.metadata):
                return known.number
        new = mcap.Channel(len(self.channels) + 1, number, channel.topic, channel.encoding, channel.metadata)
        self.channels.append(new)
        self._write(new.packed())
        return new.number

    def add(self, piece: Piece, numbers: dict[int, int], start_ns: int = 0, end_ns: int = 1 << 62) -> None:
        """Add messages.

        Args:
            piece: where they are.
            numbers: of the channels of this file, by those of the piece; others are left out.
            start_ns, end_ns: log times that are taken [ns, UTC].
        """
        data = np.frombuffer(piece.data, np.uint8)
        kept: list[tuple[int, NDArray[np.int64]]] = []
        for channel, offsets in piece.by_channel.items():
            if channel not in numbers:
                continue
            places = np.array(offsets, np.int64)
            when = mcap.times(piece.data, places)
            places = places[(when >= start_ns) & (when < end_ns)]
            if len(places):
                kept.append((numbers[channel], places))
        for number, places in kept:
            sizes = data[places[:, None] + np.arange(1, 9)].reshape(-1, 8).copy().view("<u8")[:, 0].astype(np.int64)
            sizes += mcap.HEAD
            if (sizes == sizes[0]).all():
                rows = data[places[:, None] + np.arange(sizes[0])] if sizes[0] < 64 else None
                if rows is None:
                    rows = np.array(np.lib.stride_tricks.sliding_window_view(data, int(sizes[0]))[places])
                rows[:, mcap.HEAD : mcap.HEAD + 2] = np.frombuffer(pack("<H", number), np.uint8)
                packed = rows.tobytes()
            else:
                pieces = []
                for at, size in zip(places.tolist(), sizes.tolist(), strict=True):
                    one = bytearray(piece.data[at : at + size])
                    one[mcap.HEAD : mcap.HEAD + 2] = pack("<H", number)
                    pieces.append(bytes(one))
                packed = b"".join(pieces)
            starts = np.concatenate([[0], np.cumsum(sizes)[:-1]]) + self._size
            self._places.setdefault(number, []).append(starts)
            self._parts.append(packed)
            self._size += len(packed)
        if self._size >= CHUNK:
            self.flush()

    def flush(self) -> None:
        """Write what has been added as a chunk."""
        if not self._size:
            return
        places = {number: np.concatenate(parts) for number, parts in self._places.items()}
        packed, entry, counts = mcap.pack_chunk(b"".join(self._parts), places, self._at)
        self._write(packed)
        self.chunks.append(entry)
        for number, count in counts.items():
            self.counts[number] = self.counts.get(number, 0) + count
        self._parts, self._size, self._places = [], 0, {}

    def end(self) -> None:
        """Write the summary."""
        self.flush()
        self._write(
            mcap.ending(self._at, self.schemas.values(), self.channels, self.chunks, self.counts, self.metadata)
        )

    def _write(self, data: bytes) -> None:
        self.file.write(data)
        self._at += len(data)


def rewrite(
    sources: Sequence[str], target: str, start_ns: int = 0, end_ns: int = 1 << 62, nodes: Collection[str] | None = None
) -> list[str]:
    """Write a packed recording of one or several; the target appears when it is whole.

    Args:
        sources: recordings, in the order of which their messages shall come; the same file may be source and target.
        target: path.
        start_ns, end_ns: log times that are taken [ns, UTC].
        nodes: those that are taken, None for all; events are taken in any case.

    Returns:
        What was lost, a sentence each.

    Raises:
        OSError: a source cannot be read, or the target cannot be written.
    """
    lost: list[str] = []
    half = f"{target}{PACKING}"
    try:
        with open(half, "wb") as file:
            out = PackedFile(file)
            out.begin()
            for path in sources:
                with Recording(path) as recording:
                    _copy(recording, out, start_ns, end_ns, nodes)
                    lost += [f"{path}: {sentence}" for sentence in recording.damage]
            out.end()
            file.flush()
            os.fsync(file.fileno())
        os.replace(half, target)
    except BaseException as error:
        if isinstance(error, OSError) and error.filename == half:
            error.filename = target  # what was asked for
        with suppress(OSError):
            os.unlink(half)
        raise
    return lost


def _copy(recording: Recording, out: PackedFile, start_ns: int, end_ns: int, nodes: Collection[str] | None) -> None:
    for name, values in recording.metadata:
        out.note(name, values)
    told, numbers = len(recording.metadata), dict[int, int]()
    seen: set[int] = set()
    for piece in recording.pieces():
        for name, values in recording.metadata[told:]:
            out.note(name, values)
        told = len(recording.metadata)
        for number, channel in recording.channels.items():
            if number in seen:
                continue
            seen.add(number)
            schema = recording.schemas.get(channel.schema)
            node = channel.metadata.get("node", "")
            if schema is not None and (nodes is None or not node or node in nodes):
                numbers[number] = out.channel(channel, schema)
        out.add(piece, numbers, start_ns, end_ns)
