"""Reads recordings: live or packed, whole or damaged. What is whole is read, what is lost is said.

A file is read in pieces, of some megabytes each, and never as a whole; what is asked for in columns is kept, the rest
is not. It is read and not mapped: a mapped file that is cut off meanwhile would end whoever looks at it.
"""

from __future__ import annotations

import errno
import os
import stat
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from struct import unpack_from
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sioms.documents import json_of
from sioms.protocol.flags import NodeClass
from sioms.protocol.nodeinfo import NodeInfo
from sioms.protocol.records import READ
from sioms.protocol.text import printable

from . import mcap
from .messages import CDR, EVENTS, Event

PIECE = 8 << 20
"""Bytes of a file that are looked at together; a record that is longer is looked at alone."""
_PATTERN = mcap.HEAD + 2
"""Bytes by which a message of a known node is found behind damage."""
MOST_CHANNELS = 1 << 16
"""Of a node, as in a page of one on another machine."""


@dataclass(slots=True)
class Piece:
    """Some messages, in the order of the file.

    Attributes:
        data: their records, one after the other, perhaps with others between them.
        by_channel: where the records of each channel begin.
    """

    data: Any
    by_channel: dict[int, list[int]]

    def rows(self, channel: int, size: int) -> tuple[NDArray[np.int64], NDArray[np.uint8]]:
        """Return the messages of a channel, those of another size left out: log times [ns, UTC], and rows of bytes."""
        offsets = np.array(self.by_channel.get(channel, ()), np.int64)
        places = np.frombuffer(self.data, np.uint8)
        start, whole = mcap.HEAD + mcap.MESSAGE_HEAD, mcap.MESSAGE_HEAD + size
        offsets = (
            offsets[[unpack_from("<Q", self.data, at + 1)[0] == whole for at in offsets.tolist()]]
            if len(offsets)
            else offsets
        )
        if not len(offsets):
            return np.empty(0, np.int64), np.empty((0, size), np.uint8)
        windows = np.lib.stride_tricks.sliding_window_view(places, size)
        return mcap.times(self.data, offsets).astype(np.int64), np.array(windows[offsets + start])

    def messages(self, channel: int) -> Iterator[tuple[int, bytes]]:
        """Yield the messages of a channel with their log times [ns, UTC]."""
        for at in self.by_channel.get(channel, ()):
            (size,) = unpack_from("<Q", self.data, at + 1)
            when = mcap.message_at(self.data, at)[2]
            yield when, bytes(self.data[at + mcap.HEAD + mcap.MESSAGE_HEAD : at + mcap.HEAD + size])


@dataclass(slots=True)
class NodeRecord:
    """A node of a recording.

    Attributes:
        info: what it is.
        bit: for a node of one bit the bit of its port, else -1.
        channel: of the file, of its snapshots.
    """

    info: NodeInfo
    bit: int
    channel: int

    @property
    def size(self) -> int:
        """Bytes of a snapshot."""
        return 32 + 8 * len(READ[self.info.node_class]) * len(self.info.channels)


def node_of(packed: str) -> NodeInfo:
    """Take the description of a node apart.

    Raises:
        mcap.Damaged: it is none.
    """
    try:
        info = NodeInfo(json_of(packed))
        words = [info.name, *[word for each in info.channels for word in (each.name, each.unit)]]
        whole = 0 < len(info.channels) <= MOST_CHANNELS and type(info.bit) is int and -1 <= info.bit < 64
        if not whole or not info.name or not all(type(w) is str and w.isprintable() and len(w) < 256 for w in words):
            raise ValueError("want a name, channels with units, and a bit")
    except (ValueError, TypeError) as problem:
        raise mcap.Damaged(
            f"the description of its node cannot be understood: {printable(str(problem), 120)}"
        ) from None
    return info


def _offset_of(about: Mapping[str, str]) -> int | None:
    """Return UTC minus CLOCK_MONOTONIC [ns], 0 where nothing is said of it; None for what is no such number."""
    text = about.get("offset_ns", "")
    if not text:
        return 0
    return int(text) if len(text) < 20 and text.isascii() and text.isdecimal() and int(text) < 1 << 62 else None


@dataclass(slots=True)
class Table:
    """Readings of a node.

    Attributes:
        stamps_ns: when [ns, CLOCK_MONOTONIC], in ascending order.
        numbers: of the snapshots, as the driver counts them.
        values: by column; shape (snapshots, channels).
    """

    stamps_ns: NDArray[np.int64]
    numbers: NDArray[np.int64]
    values: dict[str, NDArray[Any]] = field(default_factory=dict)


class Recording:
    """A recording.

    Args:
        path: of the file.

    Attributes:
        nodes: by name.
        channels, schemas: of the file, by number.
        metadata: name and values of each, in order.
        is_packed: whether it has been closed in order.
        damage: a sentence for each place that could not be read, of what was read so far.

    Raises:
        OSError: it cannot be read; EINVAL: it is not a recording.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = str(path)
        # A pipe would hold up who opens it.
        try:
            self._fd = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
        except OSError as error:
            raise OSError(
                error.errno, f"read {path}: {(error.strerror or str(error)).lower()}; want a recording"
            ) from None
        try:
            what = os.fstat(self._fd)
            self.size = what.st_size
            if not stat.S_ISREG(what.st_mode):
                kind = "a folder" if stat.S_ISDIR(what.st_mode) else "no ordinary file"
                raise OSError(errno.EINVAL, f"read {path}: it is {kind}; want a recording")
            if self._read(0, len(mcap.MAGIC)) != mcap.MAGIC:
                raise OSError(errno.EINVAL, f"read {path}: it is not a recording: it does not begin as MCAP files do")
        except OSError:
            os.close(self._fd)
            raise
        self.nodes: dict[str, NodeRecord] = {}
        self.schemas: dict[int, mcap.Schema] = {}
        self.channels: dict[int, mcap.Channel] = {}
        self.metadata: list[tuple[str, dict[str, str]]] = []
        self.damage: list[str] = []
        self._odd: list[str] = []
        """Sentences about what the file says of itself."""
        self.is_packed = self.size > 100 and self._read(self.size - 8, 8) == mcap.MAGIC
        self._events = -1
        self._known: dict[bytes, int] = {}
        self._head()

    def close(self) -> None:
        """Let go of the file."""
        if self._fd >= 0:
            os.close(self._fd)
        self._fd = -1

    def __enter__(self) -> Recording:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def about(self) -> dict[str, str]:
        """What the recorder says of the recording: workcell, host, start, clock; of several, the first one's word."""
        return {key: val for name, values in self.metadata[::-1] if name == "sioms" for key, val in values.items()}

    @property
    def offset_ns(self) -> int:
        """UTC minus CLOCK_MONOTONIC of the cell's machine [ns]; 0 where the file does not tell.

        Of a recording that was merged of several, that of the first: instants of the others, whose machine may be
        another, or have been started anew, are told in the same clock by way of UTC.
        """
        return _offset_of(self.about) or 0

    def _head(self) -> None:
        """Take up what stands before the first message; channels may come later, too."""
        at, seen = len(mcap.MAGIC), -1
        while at > seen:
            part, seen, begin = self._part(at), at, at
            try:
                for kind, start, stop in mcap.walk(part, 0, len(part)):
                    if kind in (mcap.MESSAGE, mcap.CHUNK, mcap.DATA_END):
                        return
                    self._take(kind, part[start:stop])
                    at = begin + stop
            except mcap.Damaged:  # the part ends within a record; of a damaged one it is said by who reads the messages
                continue

    def _read(self, at: int, size: int) -> bytes:
        """Return bytes of the file, fewer than asked for where it has been cut off since it was opened."""
        pieces = []
        while size > 0 and (piece := os.pread(self._fd, size, at)):
            pieces.append(piece)
            at, size = at + len(piece), size - len(piece)
        return b"".join(pieces)

    def _part(self, at: int) -> bytes:
        """Return some megabytes of the file from a record on, or that record whole."""
        part = self._read(at, min(PIECE, self.size - at))
        size = mcap.size_of_first(part)
        return self._read(at, size) if PIECE < size <= self.size - at else part

    def _take(self, kind: int, content: bytes) -> None:
        if kind == mcap.SCHEMA:
            schema = mcap.schema_of(content)
            self.schemas[schema.number] = schema
        elif kind == mcap.METADATA:
            entry = mcap.metadata_of(content)
            if entry not in self.metadata:
                self.metadata.append(entry)
                if _offset_of(entry[1]) is None:
                    self._is_odd(
                        f"the offset of its clocks is {printable(entry[1]['offset_ns'], 80)!r}; want nanoseconds"
                    )
        elif kind == mcap.CHANNEL:
            channel = mcap.channel_of(content)
            if channel.number in self.channels:
                return
            self.channels[channel.number] = channel
            if channel.topic == EVENTS:
                self._events = channel.number
            if packed := channel.metadata.get("sioms"):
                try:
                    info = node_of(packed)
                except mcap.Damaged as problem:
                    self._is_odd(f"channel {printable(channel.topic, 80)}: {problem}")
                    return
                node = NodeRecord(info, info.bit, channel.number)
                self.nodes[info.name] = node
                self._known[np.array([node.size + 4 + mcap.MESSAGE_HEAD], "<u8").tobytes()] = channel.number

    def _is_odd(self, text: str) -> None:
        self._odd.append(text)
        self.damage.append(text)

    # --- pieces ----------------------------------------------------------------------------------

    def pieces(self, channels: Iterable[int] | None = None) -> Iterator[Piece]:
        """Yield the messages of the file, piece by piece.

        Args:
            channels: what is wanted; None: all.
        """
        wanted = None if channels is None else frozenset(channels)
        self.damage = list(self._odd)
        at, ended = len(mcap.MAGIC), False
        while at < self.size and not ended:
            part, begin, found = self._part(at), at, dict[int, list[int]]()
            problem: mcap.Damaged | None = None
            try:
                for kind, start, stop in mcap.walk(part, 0, len(part), begin):
                    if kind == mcap.MESSAGE:
                        channel = int.from_bytes(part[start : start + 2], "little")
                        if channel not in self.channels or stop - start < mcap.MESSAGE_HEAD:
                            raise mcap.Damaged(f"a message at {begin + start - mcap.HEAD} is of no channel")
                        if wanted is None or channel in wanted:
                            found.setdefault(channel, []).append(start - mcap.HEAD)
                    elif kind == mcap.CHUNK:
                        if found:
                            yield Piece(part, found)
                            found = {}
                        if (piece := self._chunk(part[start:stop], begin + start, wanted)) and piece.by_channel:
                            yield piece
                    elif kind == mcap.DATA_END:
                        ended = True
                        break
                    elif kind not in (mcap.MESSAGE_INDEX, mcap.HEADER):
                        self._take(kind, part[start:stop])
                    at = begin + stop
            except mcap.Damaged as damaged:
                problem = damaged
            if found:
                yield Piece(part, found)
            if at == begin and not ended:  # not only the end of what was read: this record is none
                next_at = self._resume(at)
                lost = (next_at or self.size) - at
                rest = "" if next_at else ", to the end of the file"
                self.damage.append(
                    f"{problem or 'the file has been cut off'}: {lost} bytes from {at} on are lost{rest}"
                )
                if next_at is None:
                    return
                at = next_at
        if not ended and not self.damage and self.is_packed:
            self.damage.append("the summary is damaged; the messages are whole")

    def _chunk(self, content: bytes, at: int, wanted: frozenset[int] | None) -> Piece | None:
        """Take a chunk apart; one that is damaged is lost, and said."""
        found: dict[int, list[int]] = {}
        try:
            records = mcap.chunk_of(content).records()
            for kind, start, stop in mcap.walk(records, 0, len(records)):
                if kind == mcap.MESSAGE:
                    channel = int.from_bytes(records[start : start + 2], "little")
                    if channel not in self.channels or stop - start < mcap.MESSAGE_HEAD:
                        raise mcap.Damaged("a message in it is of no channel")
                    if wanted is None or channel in wanted:
                        found.setdefault(channel, []).append(start - mcap.HEAD)
                else:
                    self._take(kind, records[start:stop])
        except mcap.Damaged as problem:
            self.damage.append(f"chunk at {at}: {problem}: its messages are lost")
            return None
        return Piece(records, found)

    def _resume(self, at: int) -> int | None:
        """Return where the next message of a known node begins behind a place, None for nowhere."""
        patterns = [
            bytes([mcap.MESSAGE]) + size + channel.to_bytes(2, "little") for size, channel in self._known.items()
        ]
        at += 1
        while patterns and (part := self._read(at, PIECE + _PATTERN)):
            places = [place for pattern in patterns if (place := part.find(pattern)) >= 0]
            if places:
                return at + min(places)
            at += PIECE
        return None

    # --- what is asked for -----------------------------------------------------------------------

    @property
    def events_channel(self) -> int:
        """The channel of what happened; -1: there is none."""
        if self._events < 0:
            list(self.pieces(()))  # it may stand later in the file
        return self._events

    def events(self) -> list[Event]:
        """Return what happened, in the order of stamps."""
        found = []
        for piece in self.pieces([self.events_channel]):
            for when, data in piece.messages(self._events):
                try:
                    event = Event.of(data)
                    found.append(event.moved(when - self.offset_ns - event.stamp_ns))
                except mcap.Damaged as problem:
                    self.damage.append(str(problem))
        return sorted(found, key=lambda event: event.stamp_ns)

    def node(self, name: str) -> NodeRecord:
        """Return a node.

        Raises:
            OSError: ENOENT, it is not in the recording.
        """
        if name not in self.nodes:
            text = f"{self.path}: no node {name} is recorded"
            if (whole := name.rpartition(".")[0]) in self.nodes:
                raise OSError(2, f"{text}; want {whole}, which holds all of its channels")
            raise OSError(2, f"{text}; there are: {', '.join(self.nodes) or 'none'}")
        return self.nodes[name]

    def slots(self, name: str) -> Iterator[NDArray[np.uint64]]:
        """Yield the snapshots of a node in the order of the file: arrays of shape (snapshots, words)."""
        for _, slots in self._timed(name):
            yield slots

    def _timed(self, name: str) -> Iterator[tuple[NDArray[np.int64], NDArray[np.uint64]]]:
        """Yield the snapshots of a node with their times by UTC [ns]."""
        node = self.node(name)
        for piece in self.pieces([node.channel]):
            when, rows = piece.rows(node.channel, 4 + node.size)
            if len(rows):
                yield when, np.ascontiguousarray(rows[:, len(CDR) :]).view("<u8")

    def table(self, name: str, columns: Iterable[str] | None = None, start_ns: int = 0, end_ns: int = 1 << 62) -> Table:
        """Return columns of a node.

        Args:
            name: of the node.
            columns: names, as ``position``; None: all of its class.
            start_ns, end_ns: from when until when [ns, CLOCK_MONOTONIC].

        Raises:
            OSError: no such node; EINVAL, no such column.
        """
        node = self.node(name)
        known = READ[node.info.node_class]
        wanted = list(known) if columns is None else list(columns)
        for column in wanted:
            if column not in known:
                raise OSError(22, f"{self.path}: {name} has no column {column}; there are: {', '.join(known)}")
        count, order = len(node.info.channels), list(known)
        heads: list[NDArray[np.int64]] = []
        kept: dict[str, list[NDArray[np.uint64]]] = {column: [] for column in wanted}
        for when, slots in self._timed(name):
            stamps = when - self.offset_ns
            inside = (stamps >= start_ns) & (stamps < end_ns)
            chosen = slots[inside]
            heads.append(np.stack([chosen[:, 0].view(np.int64), stamps[inside]], axis=1))
            for column in wanted:
                first = 4 + order.index(column) * count
                kept[column].append(chosen[:, first : first + count].copy())
        head = np.concatenate(heads) if heads else np.empty((0, 2), np.int64)
        values: dict[str, NDArray[Any]] = {}
        for column in wanted:
            joined = np.concatenate(kept[column]) if heads else np.empty((0, count), "<u8")
            values[column] = joined.view("<f8" if known[column].code == "d" else "<i8")
        if node.bit >= 0 and "data" in values:
            values["data"] = values["data"] >> node.bit & 1
        if node.info.node_class is NodeClass.BINARY and (np.diff(head[:, 1]) < 0).any():
            order_ns = np.argsort(head[:, 1], kind="stable")
            head, values = head[order_ns], {name: value[order_ns] for name, value in values.items()}
        return Table(head[:, 1], head[:, 0], values)

    def span(self) -> tuple[int, int, dict[int, int]]:
        """Return first and last time [ns, UTC] and the number of messages of each channel."""
        first, last, counts = 0, 0, dict[int, int]()
        for piece in self.pieces():
            for channel, offsets in piece.by_channel.items():
                counts[channel] = counts.get(channel, 0) + len(offsets)
                for at in (offsets[0], offsets[-1]):
                    when = mcap.message_at(piece.data, at)[2]
                    first, last = min(first or when, when), max(last, when)
        return first, last, counts
