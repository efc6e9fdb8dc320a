"""Readings: one channel of a snapshot, with named fields."""

from __future__ import annotations

from sioms.protocol import records
from sioms.protocol.flags import NodeClass

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Callable
    from typing import Any


class AxisReading(records.tuple_of("AxisReading", records.READ[NodeClass.AXIS]), records.AxisRead):  # type: ignore[misc]
    """One axis; units of the channel."""

    __slots__ = ()


class AnalogReading(records.tuple_of("AnalogReading", records.READ[NodeClass.ANALOG]), records.AnalogRead):  # type: ignore[misc]
    """One analog channel."""

    __slots__ = ()


class BinaryReading(records.tuple_of("BinaryReading", records.READ[NodeClass.BINARY]), records.BinaryRead):  # type: ignore[misc]
    """One binary port, or one bit of it."""

    __slots__ = ()


READING: dict[NodeClass, Callable[..., Any]] = {
    NodeClass.AXIS: AxisReading,
    NodeClass.ANALOG: AnalogReading,
    NodeClass.BINARY: BinaryReading,
}
