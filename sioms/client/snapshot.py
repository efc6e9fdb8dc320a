"""Snapshots: what a read returns. A copy of memory, taken apart only where it is looked at.

A snapshot is immutable and its own copy: threads may share it. All its channels carry one tick and
one time stamp.
"""

from __future__ import annotations

from struct import Struct, unpack_from

from sioms.protocol.flags import NodeClass
from sioms.protocol.page import SLOT_HEADER
from sioms.protocol.records import READ_FIELDS

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence
    from typing import Any

    import numpy as np
    from numpy.typing import NDArray


class Layout:
    """Where the channels of a node lie in a copied snapshot of its block.

    Args:
        node_class: class of the block.
        block_channels: number of channels of the whole block.
        channels: which of them the node shows, in order.
        bit: for a node of one bit the bit of its port, else -1.
        names: of the channels that the node shows.
    """

    __slots__ = ("bit", "block_channels", "channels", "count", "fields", "names", "node_class", "rows")

    def __init__(
        self,
        node_class: NodeClass,
        block_channels: int,
        channels: list[int],
        bit: int,
        names: Sequence[str] = (),
    ) -> None:
        self.names = names
        self.node_class = node_class
        self.block_channels = block_channels
        self.channels = channels
        self.bit = bit
        self.count = len(channels)
        self.fields = READ_FIELDS[node_class]
        contiguous = channels == list(range(channels[0], channels[0] + len(channels)))
        self.rows: list[tuple[Callable[..., tuple[Any, ...]], int, list[int] | None]] = []
        for row, (_, code) in enumerate(self.fields):
            start = SLOT_HEADER + 8 * block_channels * row
            if contiguous:
                self.rows.append((Struct(f"<{self.count}{code}").unpack_from, start + 8 * channels[0], None))
            else:
                self.rows.append((Struct(f"<{block_channels}{code}").unpack_from, start, channels))

    def row(self, raw: bytes, row: int) -> tuple[Any, ...]:
        """Return one field of all channels."""
        unpack, offset, pick = self.rows[row]
        values = unpack(raw, offset)
        return values if pick is None else tuple([values[i] for i in pick])


class Snapshot:
    """All channels of a node at one tick.

    ``len`` is the number of channels, ``snapshot[i]`` or ``snapshot["xaxis"]`` one channel's reading with named
    fields, and each field is also an attribute: a tuple over all channels.
    """

    __slots__ = ("_layout", "_raw")

    def __init__(self, raw: bytes, layout: Layout) -> None:
        self._raw = raw
        self._layout = layout

    @property
    def number(self) -> int:
        """Running number of the snapshot in the driver process's life."""
        return int(unpack_from("<Q", self._raw, 0)[0])

    @property
    def stamp_ns(self) -> int:
        """Time the values hold for [ns, CLOCK_MONOTONIC]."""
        return int(unpack_from("<Q", self._raw, 8)[0])

    @property
    def tick(self) -> int:
        """Tick of the driver."""
        return int(unpack_from("<Q", self._raw, 16)[0])

    def __len__(self) -> int:
        return self._layout.count

    def __getitem__(self, channel: int | str) -> Any:
        count = self._layout.count
        if isinstance(channel, str):
            if channel not in self._layout.names:
                raise KeyError(f"no channel {channel}; the node has: {', '.join(self._layout.names)}")
            channel = self._layout.names.index(channel)
        if not -count <= channel < count:
            raise IndexError(f"channel {channel} of a node of {count}; want {-count} to {count - 1}")
        # Loaded when first used: named tuples are a tenth of the start time of a shell tool.
        from .reading import READING

        return READING[self._layout.node_class](
            *[self._row(row)[channel] for row in range(len(self._layout.fields))]
        )

    def __iter__(self) -> Iterator[Any]:
        return iter([self[i] for i in range(len(self))])

    def __repr__(self) -> str:
        return f"<{type(self).__name__} tick {self.tick} {list(self)}>"

    def array(self, field: str) -> NDArray[np.float64] | NDArray[np.int64]:
        """Return one field of all channels as a numpy array, shape (channels,).

        Args:
            field: name of a field, e.g. ``position`` or ``data``.

        Raises:
            KeyError: the class has no such field.
        """
        import numpy as np

        names = [name for name, _ in self._layout.fields]
        if field not in names:
            raise KeyError(
                f"no field {field} in {self._layout.node_class.name.lower()} readings; there are: {', '.join(names)}"
            )
        return np.array(self._row(names.index(field)))

    def _row(self, row: int) -> tuple[Any, ...]:
        return self._layout.row(self._raw, row)


def _field(row: int, text: str) -> property:
    def get(self: Snapshot) -> tuple[Any, ...]:
        unpack, offset, pick = self._layout.rows[row]
        values = unpack(self._raw, offset)
        return values if pick is None else tuple([values[i] for i in pick])

    return property(get, doc=text)


class AxisSnapshot(Snapshot):
    """Axes: lengths in the channel's unit (m or rad), forces in N or N*m."""

    __slots__ = ()
    position = _field(0, "Measured position.")
    velocity = _field(1, "Filtered measured velocity.")
    force = _field(2, "Force or torque applied by the actuator.")
    commanded_position = _field(7, "Position that the profile asks for now.")
    commanded_velocity = _field(8, "Velocity that the profile asks for now.")
    following_error = _field(9, "Commanded minus measured position.")
    in_motion = _field(10, "1 while a command is being carried out.")
    status = _field(11, "AxisStatus flags.")
    buffered = _field(12, "Commands that wait in the buffer; the running one has left it.")


class AnalogSnapshot(Snapshot):
    """Analog channels in their declared units."""

    __slots__ = ()
    data = _field(0, "Values.")
    flags = _field(1, "AnalogStatus flags, 0 = good.")


class BinarySnapshot(Snapshot):
    """Binary ports, or one bit."""

    __slots__ = ()

    @property
    def data(self) -> tuple[int, ...]:
        """Bits of each port; of a bit node 0 or 1."""
        values = self._layout.row(self._raw, 0)
        bit = self._layout.bit
        return values if bit < 0 else (values[0] >> bit & 1,)

    changed_ns = _field(1, "Time of the port's last edge [ns, CLOCK_MONOTONIC].")
    edges = _field(2, "Edges of the port since the driver started.")

    def _row(self, row: int) -> tuple[Any, ...]:
        return self.data if row == 0 else self._layout.row(self._raw, row)


SNAPSHOT: dict[NodeClass, type[Snapshot]] = {
    NodeClass.AXIS: AxisSnapshot,
    NodeClass.ANALOG: AnalogSnapshot,
    NodeClass.BINARY: BinarySnapshot,
}
