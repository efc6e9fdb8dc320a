"""What the messages of a recording are: ROS 2 types, in CDR, with their definitions in the file. Pure.

A node has one channel that loses nothing, ``/mod0/snapshot``: its message is a snapshot as it is in the node's page,
whose columns are arrays of fixed length, so that the bytes are taken as they are. Axes have beside it
``/mod0/joint_states`` (sensor_msgs/msg/JointState) and force/torque sensors ``/force/wrench``
(geometry_msgs/msg/WrenchStamped), for programs that know these types. What happens is on ``/sioms/events``.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from struct import pack, unpack_from
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sioms.documents import json_of
from sioms.protocol.flags import NodeClass
from sioms.protocol.nodeinfo import NodeInfo
from sioms.protocol.records import READ
from sioms.protocol.text import printable

from . import mcap

EVENTS = "/sioms/events"
CDR = b"\x00\x01\x00\x00"
"""Encapsulation of little-endian CDR."""
SLOT_WORDS = ("number", "stamp_ns", "tick", "as_of_ns")
_RULE = "=" * 80 + "\nMSG: "
_TIME = _RULE + "builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
_HEADER = _RULE + "std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n"
_VECTOR = _RULE + "geometry_msgs/Vector3\nfloat64 x\nfloat64 y\nfloat64 z\n"
_WRENCH = _RULE + "geometry_msgs/Wrench\ngeometry_msgs/Vector3 force\ngeometry_msgs/Vector3 torque\n"
JOINT_STATE = (
    "sensor_msgs/msg/JointState",
    "std_msgs/Header header\nstring[] name\nfloat64[] position\nfloat64[] velocity\nfloat64[] effort\n"
    + _HEADER
    + _TIME,
)
WRENCH_STAMPED = (
    "geometry_msgs/msg/WrenchStamped",
    "std_msgs/Header header\ngeometry_msgs/Wrench wrench\n" + _HEADER + _TIME + _WRENCH + _VECTOR,
)
EVENT = (
    "sioms_msgs/msg/Event",
    "int64 stamp_ns  # CLOCK_MONOTONIC\nuint64 number  # running number at its source\nstring source  # a device, "
    "'daemon' or 'recorder'\nstring kind  # command, refusal, stop, fault, link, reset, log, request, marker, closed, "
    "lost, ...\nstring node\nstring who\nint32 error  # errno, 0: done\nstring text\nstring data  # JSON\n"
    "uint8[] raw  # the message, or the records, as they came\n",
)


@dataclass(frozen=True, slots=True)
class Event:
    """Something that happened.

    Attributes:
        stamp_ns: when [ns, CLOCK_MONOTONIC].
        number: running number at its source, 0 for none.
        source: a device, "daemon" or "recorder".
        kind: a word: that of a ``journal.Note`` in small letters, or what the recorder says of itself.
        node, who: of whom it tells; empty where that has no meaning.
        error: errno of a refusal, 0: none.
        text: a sentence or a part of one.
        data: more of it, by name.
        raw: a message or records as they came.
    """

    stamp_ns: int
    number: int
    source: str
    kind: str
    node: str = ""
    who: str = ""
    error: int = 0
    text: str = ""
    data: dict[str, Any] | None = None
    raw: bytes = b""

    def moved(self, shift_ns: int) -> Event:
        """Return the same event at another time [ns]."""
        return self if not shift_ns else replace(self, stamp_ns=self.stamp_ns + shift_ns)

    def packed(self) -> bytes:
        """Return the CDR message."""
        out = Cdr()
        out.align(8)
        out.body += pack("<qQ", self.stamp_ns, self.number)
        for word in (self.source, self.kind, self.node, self.who):
            out.text(word)
        out.align(4)
        out.body += pack("<i", self.error)
        out.text(self.text)
        out.text(json.dumps(self.data, default=str) if self.data else "")
        out.align(4)
        out.body += pack("<I", len(self.raw)) + self.raw
        return CDR + bytes(out.body)

    @classmethod
    def of(cls, data: bytes) -> Event:
        """Take a CDR message apart.

        Raises:
            mcap.Damaged: it is none.
        """
        try:
            stamp_ns, number = unpack_from("<qQ", data, 4)
            at, words = 20, []
            for _ in range(4):
                word, at = _text_at(data, at)
                words.append(word)
            at += -(at - 4) % 4
            (error_,) = unpack_from("<i", data, at)
            sentence, at = _text_at(data, at + 4)
            more, at = _text_at(data, at)
            at += -(at - 4) % 4
            (size,) = unpack_from("<I", data, at)
            values = json_of(more) if more else None
            if not isinstance(values, dict | None):
                raise ValueError("its data is no object")
        except Exception as problem:
            raise mcap.Damaged(f"an event cannot be taken apart: {problem}") from None
        source, kind, node, who = words
        raw = data[at + 4 : at + 4 + size]
        return cls(stamp_ns, number, source, kind, node, who, error_, sentence, values, raw)


def _text_at(data: bytes, at: int) -> tuple[str, int]:
    at += -(at - 4) % 4
    (size,) = unpack_from("<I", data, at)
    end = at + 4 + size
    if size < 1 or end > len(data):
        raise ValueError(f"a string of {size} bytes at {at}")
    return printable(data[at + 4 : end - 1].decode("utf-8", "replace"), mcap.LONGEST), end


class Cdr:
    """Builds a CDR message; offsets are counted behind the encapsulation."""

    def __init__(self) -> None:
        self.body = bytearray()

    def align(self, size: int) -> None:
        """Fill up to a multiple."""
        self.body += bytes(-len(self.body) % size)

    def text(self, value: str) -> None:
        """Append a string."""
        self.align(4)
        data = value.encode() + b"\0"
        self.body += pack("<I", len(data)) + data

    def doubles(self, count: int) -> int:
        """Append a sequence of numbers, 0 as yet; return where they lie."""
        self.align(4)
        self.body += pack("<I", count)
        self.align(8)
        at = len(self.body)
        self.body += bytes(8 * count)
        return at

    def place(self, form: str) -> int:
        """Append something that is 0 as yet; return where it lies."""
        at = len(self.body)
        self.body += bytes(np.dtype(form).itemsize)
        return at


def snapshot_type(node_class: NodeClass, count: int) -> tuple[str, str]:
    """Return name and definition of the type of snapshots of a node of so many channels."""
    kinds = {"d": "float64", "q": "int64"}
    lines = [f"{'int64' if word.endswith('ns') else 'uint64'} {word}" for word in SLOT_WORDS]
    for column in READ[node_class].values():
        unit = column.unit.format(u="unit of the channel", f="N or N*m")
        lines.append(f"{kinds[column.code]}[{count}] {column.name}  # {column.text}{f' [{unit}]' if unit else ''}")
    return f"sioms_msgs/msg/{node_class.name.capitalize()}{count}", "\n".join(lines) + "\n"


def topic_of(node: str) -> str:
    """Return the topic of a node: its name as ROS 2 takes it."""
    return "/" + "/".join("".join(c if c.isalnum() and c.isascii() else "_" for c in w) for w in node.split("."))


def is_wrench(info: NodeInfo) -> bool:
    """Tell whether a node is a force/torque sensor: three forces and three torques."""
    return info.node_class is NodeClass.ANALOG and [c.unit for c in info.channels] == ["N"] * 3 + ["N*m"] * 3


class NodeFormat:
    """How the snapshots of a node become messages.

    Args:
        info: of the node.
        bit: for a node of one bit the bit of its port, else -1.
        first: number of its first channel in the file; the second, if it has one, is the next.
        schema: gives the number of a type, by name and definition.
        offset_ns: UTC minus CLOCK_MONOTONIC.

    Attributes:
        channels: of the file.
        size: bytes of a snapshot.
    """

    def __init__(self, info: NodeInfo, bit: int, first: int, schema: Any, offset_ns: int) -> None:
        self.info = info
        self._offset = np.uint64(offset_ns)
        count = len(info.channels)
        self.size = 32 + 8 * len(READ[info.node_class]) * count
        topic = topic_of(info.name)
        packed = [
            info.name, int(info.node_class), info.read_only, [c.pack() for c in info.channels], bit, info.tick_hz,
            info.buffer_capacity, info.device, info.driver, info.protocol_version,
        ]  # fmt: skip
        number = schema(*snapshot_type(info.node_class, count))
        told = {"sioms": json.dumps(packed), "node": info.name}
        self.channels = [mcap.Channel(first, number, f"{topic}/snapshot", "cdr", told)]
        head = [
            ("op", "u1"),
            ("size", "<u8"),
            ("channel", "<u2"),
            ("sequence", "<u4"),
            ("log", "<u8"),
            ("published", "<u8"),
        ]
        self._dtype: Any = np.dtype([*head, ("cdr", "u1", 4), ("slot", "u1", self.size)])
        template = mcap.message(first, 0, 0, CDR + bytes(self.size))
        self._rows: list[tuple[str, int]] = []
        body = Cdr()
        if info.node_class is NodeClass.AXIS:
            second, parts = self._joint_state(body)
        elif is_wrench(info):
            second, parts = self._wrench(body)
        else:
            second, parts = None, []
        if second is not None:
            name, type_ = second
            self.channels.append(mcap.Channel(first + 1, schema(*type_), f"{topic}/{name}", "cdr", {"node": info.name}))
            start = self._dtype.itemsize
            whole = mcap.message(first + 1, 0, 0, CDR + bytes(body.body))
            inner = start + mcap.HEAD + mcap.MESSAGE_HEAD + 4
            plain: Any = self._dtype
            fields = {key: (plain[key], plain.fields[key][1]) for key in plain.names}
            for place, form in (("log2", 15), ("published2", 23)):
                fields[place] = (np.dtype("<u8"), start + form)
            fields["sequence2"] = (np.dtype("<u4"), start + 11)
            for place, kind, offset in parts:
                fields[place] = (np.dtype(kind), inner + offset)
            names = list(fields)
            self._dtype = np.dtype({
                "names": names, "formats": [fields[n][0] for n in names], "offsets": [fields[n][1] for n in names],
                "itemsize": start + len(whole),
            })  # fmt: skip
            template += whole
        self._template = np.frombuffer(template, self._dtype)
        self._second = second is not None

    def _shifted(self, slots: NDArray[np.uint64], shift_ns: int) -> NDArray[np.uint64]:
        """Return snapshots whose instants are later."""
        moved = slots.copy()
        count = len(self.info.channels)
        words = [SLOT_WORDS.index("stamp_ns"), SLOT_WORDS.index("as_of_ns")]
        for row, name in enumerate(READ[self.info.node_class]):
            if name.endswith("_ns"):
                words += range(len(SLOT_WORDS) + row * count, len(SLOT_WORDS) + (row + 1) * count)
        for word in words:
            known = moved[:, word] != 0  # 0: there was none
            moved[known, word] += np.uint64(shift_ns % (1 << 64))
        return moved

    def _joint_state(self, body: Cdr) -> tuple[Any, list[tuple[str, Any, int]]]:
        parts = self._stamp(body)
        body.align(4)
        body.body += pack("<I", len(self.info.channels))
        for channel in self.info.channels:
            body.text(channel.name)
        count = len(self.info.channels)
        for title in ("position", "velocity", "force"):
            parts.append((f"row {title}", ("<u8", (count,)), body.doubles(count)))
            self._rows.append((f"row {title}", list(READ[NodeClass.AXIS]).index(title)))
        return ("joint_states", JOINT_STATE), parts

    def _wrench(self, body: Cdr) -> tuple[Any, list[tuple[str, Any, int]]]:
        parts = self._stamp(body)
        body.align(8)
        at = len(body.body)
        body.body += bytes(48)
        parts.append(("row data", ("<u8", (6,)), at))
        self._rows.append(("row data", 0))
        return ("wrench", WRENCH_STAMPED), parts

    def _stamp(self, body: Cdr) -> list[tuple[str, Any, int]]:
        parts: list[tuple[str, Any, int]] = [("sec", "<i4", body.place("<i4")), ("nanosec", "<u4", body.place("<u4"))]
        body.text("" if self.info.node_class is NodeClass.AXIS else self.info.name)
        return parts

    def messages(self, slots: NDArray[np.uint64], shift_ns: int = 0) -> bytes:
        """Return the records of snapshots.

        Args:
            slots: shape (snapshots, size / 8): each as it is in the page, of the node's channels alone.
            shift_ns: what is added to their instants [ns].
        """
        if shift_ns:
            slots = self._shifted(slots, shift_ns)
        out: Any = np.empty(len(slots), self._dtype)
        raw = out.view(np.uint8).reshape(len(slots), -1)
        raw[:] = np.frombuffer(self._template, np.uint8)
        when = slots[:, 1] + self._offset
        out["sequence"] = slots[:, 0]
        out["log"] = out["published"] = when
        out["slot"] = np.ascontiguousarray(slots).view(np.uint8)
        if self._second:
            out["sequence2"] = slots[:, 0]
            out["log2"] = out["published2"] = when
            out["sec"], out["nanosec"] = when // 1_000_000_000, when % 1_000_000_000
            count = len(self.info.channels)
            for place, row in self._rows:
                out[place] = slots[:, 4 + row * count : 4 + (row + 1) * count]
        return bytes(raw.data)
