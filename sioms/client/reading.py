"""Readings: one channel of a snapshot, with named fields."""

from __future__ import annotations

from sioms.protocol import records
from sioms.protocol.flags import AnalogStatus, AxisStatus, NodeClass

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Callable
    from typing import Any


def _shown(reading: Any, word: str, kind: type[AxisStatus] | type[AnalogStatus]) -> str:
    """Show a reading with the names of what its status word says."""
    columns = {name: repr(getattr(reading, name)) for name in reading._fields}
    columns[word] = kind(int(getattr(reading, word))).name or "0"
    return f"{type(reading).__name__}({', '.join(f'{name}={text}' for name, text in columns.items())})"


class AxisReading(records.tuple_of("AxisReading", records.READ[NodeClass.AXIS]), records.AxisRead):  # type: ignore[misc]
    """One axis; units of the channel. ``status`` holds bits of AxisStatus."""

    __slots__ = ()

    @property
    def severity(self) -> int:
        """How bad the status is, from 0, good, to 2, major; see ``AxisStatus.severity``."""
        return AxisStatus(int(self.status)).severity

    def __repr__(self) -> str:
        return _shown(self, "status", AxisStatus)


class AnalogReading(records.tuple_of("AnalogReading", records.READ[NodeClass.ANALOG]), records.AnalogRead):  # type: ignore[misc]
    """One analog channel. ``flags`` holds bits of AnalogStatus."""

    __slots__ = ()

    @property
    def severity(self) -> int:
        """How bad the flags are, from 0, good, to 2, major; see ``AnalogStatus.severity``."""
        return AnalogStatus(int(self.flags)).severity

    def __repr__(self) -> str:
        return _shown(self, "flags", AnalogStatus)


class BinaryReading(records.tuple_of("BinaryReading", records.READ[NodeClass.BINARY]), records.BinaryRead):  # type: ignore[misc]
    """One binary port, or one bit of it."""

    __slots__ = ()


READING: dict[NodeClass, Callable[..., Any]] = {
    NodeClass.AXIS: AxisReading,
    NodeClass.ANALOG: AnalogReading,
    NodeClass.BINARY: BinaryReading,
}
