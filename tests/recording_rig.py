"""Recordings made without a daemon, of nodes whose values are known."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sioms.protocol.flags import NodeClass
from sioms.protocol.nodeinfo import ChannelInfo, NodeInfo
from sioms.recording import mcap
from sioms.recording.messages import EVENT, EVENTS, Event, NodeFormat

OFFSET_NS = 1_700_000_000_000_000_000
START_NS = 5_000_000_000


def info(name: str, node_class: NodeClass, units: list[str], names: str = "abcdefgh") -> NodeInfo:
    """Return what a node is."""
    width = 8 if node_class is NodeClass.BINARY else 0
    channels = [ChannelInfo(names[i], unit, width=width).pack() for i, unit in enumerate(units)]
    return NodeInfo([name, int(node_class), False, channels, -1, 1000.0, 16, "dev", "sim-axes", 2])


NODES = [
    info("mod0", NodeClass.AXIS, ["m", "m", "rad"]),
    info("force0", NodeClass.ANALOG, ["N"] * 3 + ["N*m"] * 3),
    info("io0.in", NodeClass.BINARY, [""]),
]


def slots(node: NodeInfo, first: int, count: int) -> NDArray[np.uint64]:
    """Return snapshots of a node, one a millisecond, whose values tell their place."""
    columns = {NodeClass.AXIS: 13, NodeClass.ANALOG: 2, NodeClass.BINARY: 3}[node.node_class]
    found = np.zeros((count, 4 + columns * len(node.channels)), "<u8")
    number = np.arange(first, first + count)
    found[:, 0], found[:, 2] = number, number + 7
    found[:, 1] = START_NS + number * 1_000_000
    values = number[:, None] + np.arange(found.shape[1] - 4) / 64
    whole = node.node_class is NodeClass.BINARY
    found[:, 4:] = values.astype("<i8").view("<u8") if whole else np.ascontiguousarray(values).view("<u8")
    return found


def events(count: int) -> list[Event]:
    """Return things that happened."""
    return [
        Event(START_NS + i * 10_000_000, i, "dev", "command", "mod0", "eva", 0, "Größe", {"i": i}, b"raw" * i)
        for i in range(count)
    ]


def write(path: Path, count: int = 200, first: int = 1, nodes: list[NodeInfo] = NODES) -> Path:
    """Write a live recording of some snapshots of each node and a few events."""
    return write_slots(path, nodes, [slots(node, first, count) for node in nodes])


def write_slots(path: Path, nodes: list[NodeInfo], told: list[NDArray[np.uint64]]) -> Path:
    """Write a live recording of what each node told and a few events."""
    schemas: dict[str, int] = {}
    defined: list[bytes] = []

    def schema(name: str, text: str) -> int:
        if name not in schemas:
            schemas[name] = len(schemas) + 1
            defined.append(mcap.Schema(schemas[name], name, "ros2msg", text.encode()).packed())
        return schemas[name]

    data: list[Any] = [mcap.header("test"), mcap.metadata("sioms", {"offset_ns": str(OFFSET_NS), "workcell": "test"})]
    defined.append(mcap.Channel(1, schema(*EVENT), EVENTS, "cdr").packed())
    forms = [NodeFormat(node, -1, 2 + 2 * i, schema, OFFSET_NS) for i, node in enumerate(nodes)]
    defined += [channel.packed() for form in forms for channel in form.channels]
    data += sorted(defined, key=lambda record: record[0])
    for at in range(0, max(map(len, told)), 20):
        data += [form.messages(one[at : at + 20]) for form, one in zip(forms, told, strict=True)]
    for event in events(5):
        data.append(mcap.message(1, event.number, event.stamp_ns + OFFSET_NS, event.packed()))
    path.write_bytes(b"".join(data))
    return path
