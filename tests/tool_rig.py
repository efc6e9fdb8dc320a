"""Rig for tests of the tools: snapshots and node information made by hand, out of the real classes."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import Any

from sioms.client.snapshot import SNAPSHOT, Layout
from sioms.protocol.flags import NodeClass
from sioms.protocol.nodeinfo import ChannelInfo, NodeInfo
from sioms.protocol.records import READ

AXES = ("xaxis", "yaxis", "zaxis", "taxis")


def node_info(
    node_class: NodeClass, names: Sequence[str], *, name: str = "mod0", unit: str = "m", width: int = 0
) -> NodeInfo:
    """Return the information of a node with these channels."""
    channels = [ChannelInfo(each, unit, -1.0, 1.0, width, 0x3F, {"velocity": 0.5}).pack() for each in names]
    return NodeInfo([name, int(node_class), False, channels, -1, 1000.0, 64, "mod0", "sim-axes", 1])


def snapshot(node_class: NodeClass, count: int, **fields: Sequence[float]) -> Any:
    """Return a snapshot of all channels; fields that are not given are 0."""
    raw = struct.pack("<QQQQ", 7, 1_000_000_000, 42, 0)
    for name, column in READ[node_class].items():
        raw += struct.pack(f"<{count}{column.code}", *fields.get(name, [0] * count))
    return SNAPSHOT[node_class](raw, Layout(node_class, count, list(range(count)), -1))
