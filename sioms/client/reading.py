"""Readings: one channel of a snapshot, with named fields."""

from __future__ import annotations

from collections import namedtuple

from sioms.protocol.flags import NodeClass
from sioms.protocol.records import READ_FIELDS

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Callable
    from typing import Any

AxisReading = namedtuple("AxisReading", [name for name, _ in READ_FIELDS[NodeClass.AXIS]])  # type: ignore[misc]
"""One axis: the fields of table F.3 and beyond it; units of the channel."""
AnalogReading = namedtuple("AnalogReading", ["data", "flags"])
BinaryReading = namedtuple("BinaryReading", ["data", "changed_ns", "edges"])
READING: dict[NodeClass, Callable[..., Any]] = {
    NodeClass.AXIS: AxisReading,
    NodeClass.ANALOG: AnalogReading,
    NodeClass.BINARY: BinaryReading,
}
