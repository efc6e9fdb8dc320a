"""Snapshots: what a read returns. A copy of memory, taken apart only where it is looked at.

A snapshot is immutable and its own copy: threads may share it. All its channels carry one tick and
one time stamp.
"""

from __future__ import annotations

from errno import EIO
from struct import Struct, unpack_from

from sioms.protocol.flags import AnalogStatus, NodeClass
from sioms.protocol.page import SLOT_HEADER
from sioms.protocol.records import READ

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence
    from typing import Any

    import numpy as np
    from numpy.typing import NDArray

    from sioms.protocol.clock import Clock, Utc
    from sioms.protocol.records import Column

_INVALID, _NAN = int(AnalogStatus.INVALID), float("nan")
_UNFIT = int(AnalogStatus.INVALID | AnalogStatus.SATURATED)
_INSTANT = "changed_ns"
"""The column that is an instant by the clock of the cell."""


class Layout:
    """Where the channels of a node lie in a copied snapshot of its block.

    Args:
        node_class: class of the block.
        block_channels: number of channels of the whole block.
        channels: which of them the node shows, in order.
        bit: for a node of one bit the bit of its port, else -1.
        names: of the channels that the node shows.
        clock: of the cell, where that is another machine's; None: it is ours.
    """

    __slots__ = ("bit", "block_channels", "channels", "clock", "columns", "count", "names", "node_class", "rows")

    def __init__(
        self,
        node_class: NodeClass,
        block_channels: int,
        channels: list[int],
        bit: int,
        names: Sequence[str] = (),
        clock: Clock | None = None,
    ) -> None:
        self.names = names
        self.clock = clock
        self.node_class = node_class
        self.block_channels = block_channels
        self.channels = channels
        self.bit = bit
        self.count = len(channels)
        self.columns = READ[node_class]
        self.rows: dict[str, Callable[[bytes], tuple[Any, ...]]] = {
            name: self._row(row, column.code, name == _INSTANT)
            for row, (name, column) in enumerate(self.columns.items())
        }
        """By column: what takes the values of the channels that the node shows out of a snapshot."""
        if bit >= 0:
            port = self.rows["data"]
            self.rows["data"] = lambda raw: (port(raw)[0] >> bit & 1,)

    def _row(self, row: int, code: str, instant: bool) -> Callable[[bytes], tuple[Any, ...]]:
        first, count, channels, clock = self.channels[0], self.count, self.channels, self.clock
        start = SLOT_HEADER + 8 * self.block_channels * row
        unpack: Callable[[bytes], tuple[Any, ...]]
        if channels == list(range(first, first + count)):
            # One call of C, in the end: its reader is a control loop, and whatever else it touches is in no cache.
            unpack = Struct(f"<{start + 8 * first}x{count}{code}").unpack_from
        else:
            whole = Struct(f"<{start}x{self.block_channels}{code}").unpack_from

            def unpack(raw: bytes) -> tuple[Any, ...]:
                values = whole(raw)
                return tuple([values[i] for i in channels])

        if clock is None or not instant:
            return unpack
        return lambda raw: tuple([value and clock.here(value) for value in unpack(raw)])


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
        """Time the values hold for [ns, CLOCK_MONOTONIC of this machine]."""
        clock = self._layout.clock
        return self.cell_stamp_ns if clock is None else clock.here(self.cell_stamp_ns)

    @property
    def cell_stamp_ns(self) -> int:
        """The same by the clock of the cell's machine [ns, CLOCK_MONOTONIC there]."""
        return int(unpack_from("<Q", self._raw, 8)[0])

    @property
    def stamp_error_ns(self) -> int:
        """How wrong ``stamp_ns`` is at most by what is known of both clocks [ns]; 0 of a cell on this machine."""
        clock = self._layout.clock
        return 0 if clock is None else clock.error_ns

    @property
    def utc(self) -> Utc:
        """Time the values hold for by UTC, with its error and what keeps the clock of the cell's machine right."""
        if self._layout.clock is not None:
            return self._layout.clock.utc(self.cell_stamp_ns)
        from sioms.protocol.clock import Clock

        from .wall import wall

        here = Clock()
        here.wall = wall()
        return here.utc(self.cell_stamp_ns)

    @property
    def tick(self) -> int:
        """Tick of the driver."""
        return int(unpack_from("<Q", self._raw, 16)[0])

    def __len__(self) -> int:
        return self._layout.count

    def _index(self, channel: int | str) -> int:
        """Return the index of a channel; raises KeyError or IndexError for what is none."""
        count = self._layout.count
        if isinstance(channel, str):
            if channel not in self._layout.names:
                raise KeyError(f"no channel {channel}; the node has: {', '.join(self._layout.names)}")
            channel = self._layout.names.index(channel)
        if not -count <= channel < count:
            raise IndexError(f"channel {channel} of a node of {count}; want {-count} to {count - 1}")
        return channel

    def __getitem__(self, channel: int | str) -> Any:
        index = self._index(channel)
        # Loaded when first used: named tuples are a tenth of the start time of a shell tool.
        from .reading import READING

        return READING[self._layout.node_class](*[row(self._raw)[index] for row in self._layout.rows.values()])

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

        if field not in self._layout.columns:
            raise KeyError(
                f"no field {field} in {self._layout.node_class.name.lower()} readings; "
                f"there are: {', '.join(self._layout.columns)}"
            )
        return np.array(self._layout.rows[field](self._raw))

    if TYPE_CHECKING:

        def __getattr__(self, name: str) -> tuple[Any, ...]:
            """Stand for the columns, which are made below."""


def _column(column: Column) -> property:
    name = column.name

    def get(self: Snapshot) -> tuple[Any, ...]:
        return self._layout.rows[name](self._raw)

    unit = column.unit.format(u="unit of the channel", f="N or N*m")
    return property(get, doc=f"Of each channel: {column.text}{unit and f' [{unit}]'}.")


class AxisSnapshot(Snapshot):
    """Axes: lengths in the channel's unit (m or rad), forces in N or N*m."""

    __slots__ = ()


class AnalogSnapshot(Snapshot):
    """Analog channels in their declared units."""

    __slots__ = ()

    @property
    def known(self) -> tuple[float, ...]:
        """Of each channel: its value, nan where it is flagged INVALID, for whoever passes on values without flags."""
        return tuple([_NAN if flags & _INVALID else value for value, flags in zip(self.data, self.flags, strict=True)])

    def measured(self, channel: int | str = 0) -> float:
        """Return the value of a channel, for a program that acts on it: a guard, a control law.

        Args:
            channel: its index or name.

        Raises:
            OSError: EIO, it is no measurement: flagged INVALID or SATURATED, or not finite.
        """
        index = self._index(channel)
        value, flags = float(self.data[index]), int(self.flags[index])
        if flags & _UNFIT or value - value != 0.0:
            names = self._layout.names
            name = names[index] if names else f"channel {index}"
            words = [flag.name.lower() for flag in AnalogStatus if flag & flags and flag.name]
            raise OSError(
                EIO,
                f"read {name}: {value:g}, {' and '.join(words) or 'flagged good'}; want a finite value that is "
                "neither invalid nor saturated",
            )
        return value


class BinarySnapshot(Snapshot):
    """Binary ports, or one bit."""

    __slots__ = ()


SNAPSHOT: dict[NodeClass, type[Snapshot]] = {
    NodeClass.AXIS: AxisSnapshot,
    NodeClass.ANALOG: AnalogSnapshot,
    NodeClass.BINARY: BinarySnapshot,
}
for _class, _columns in READ.items():
    for _name in _columns:
        setattr(SNAPSHOT[_class], _name, _column(_columns[_name]))
