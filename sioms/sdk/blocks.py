"""Blocks: the arrays of channels that a device shows, and the memory their readings live in.

A block is published whole, so all its channels carry one tick and one time stamp. Nodes are views
of blocks. The driver fills ``data``; the kit publishes.

Concurrency: owned by the one thread of the driver process.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from sioms.protocol.flags import AnalogStatus, NodeClass
from sioms.protocol.nodeinfo import ChannelInfo
from sioms.protocol.records import READ, read_rows

from .alarms import Alarms

if TYPE_CHECKING:
    from sioms.motion import Bank


@dataclass(frozen=True, slots=True)
class BlockSpec:
    """What a block is, told before any process runs.

    Args:
        name: '' for the node that bears the device's own name, else the suffix: ``tactile0.strain``.
        node_class: class of its channels.
        channels: the channels in order; their names make the nodes of single channels.
        writable: whether clients may write (axis blocks always are).
        history: snapshots kept in the page, a power of two of at least 4.
        capacity: commands an axis buffers.
        safe: for a writable binary or analog block the value each channel takes when its writer
            goes away or the workcell stops; None keeps the last value.
    """

    name: str
    node_class: NodeClass
    channels: tuple[ChannelInfo, ...]
    writable: bool = False
    history: int = 64
    capacity: int = 0
    safe: tuple[float | None, ...] = ()


@dataclass(frozen=True, slots=True)
class Description:
    """What a device is: the answer to ``describe``.

    Args:
        blocks: its blocks.
        tick_hz: rate of its tick, poll or frames [Hz].
        inputs: names of nodes of other devices that the driver reads (simulated coupling, load
            information); the kit opens them and reopens them when their device comes back.
        lease_s: a reader calls the driver hung when it has not ticked for this long [s].
        holds: names of axis nodes of other devices that are this device's own: it reads and commands them, and nobody
            else can open them. They halt when this device ends, hangs or is lost.
    """

    blocks: tuple[BlockSpec, ...]
    tick_hz: float
    inputs: tuple[str, ...] = ()
    lease_s: float = 0.1
    holds: tuple[str, ...] = ()

    @property
    def reads(self) -> tuple[str, ...]:
        """The nodes that it reads, those that it holds among them."""
        return tuple(dict.fromkeys((*self.inputs, *self.holds)))


class Block:
    """A block and the memory of its present readings.

    Attributes:
        spec: what it is.
        n: number of channels.
        fields: shape (columns, n) float64, one row a column of the record.
        rows: its rows by the name of their column, whole numbers as int64: the same memory.
        stamp_ns: time the readings hold for [ns, CLOCK_MONOTONIC]; set by the driver when it knows
            better than "now", e.g. for samples that travelled.
    """

    def __init__(self, spec: BlockSpec, fields: NDArray[np.float64] | None = None) -> None:
        self.spec = spec
        self.n = len(spec.channels)
        shape = (len(READ[spec.node_class]), self.n)
        self.fields = np.zeros(shape) if fields is None else fields
        if self.fields.shape != shape or not self.fields.flags.c_contiguous:
            raise ValueError(f"make block {spec.name!r}: fields of shape {self.fields.shape}; want {shape}, contiguous")
        self.rows = read_rows(spec.node_class, self.fields)
        self.stamp_ns = 0

    def payload(self) -> memoryview:
        """Return the readings as bytes in page order, without copying."""
        return self.fields.data.cast("B")


_NO_MEASUREMENT = int(AnalogStatus.INVALID | AnalogStatus.SATURATED)


def unfit(flags: NDArray[np.int64], data: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return which readings are no measurement."""
    return np.asarray((flags & _NO_MEASUREMENT != 0) | ~np.isfinite(data))


class AnalogBlock(Block):
    """Analog channels: ``data`` (n,) in declared units and ``flags`` (n,) of AnalogStatus.

    What is published is ``gains @ (data - offset)``: zero and gain matrix are the same for all analog
    devices, so no driver does them, unless they act deeper in the driver than on what it publishes.

    Attributes:
        offset: shape (n,), subtracted; set by ZERO_DEVICE.
        gains: shape (n, n), or None for the unit matrix; set by SET_GAINS.
        alarms: limits of what is published, whose bits join ``flags``; None when there are none.
        shown: what is published, in the shape of ``fields``; ``shown_data`` and ``shown_flags`` are rows of it.
        corrected_by_driver: the driver's ``ioctl`` answers ZERO_DEVICE, SET_GAINS and GET_GAINS; nothing is done here.
    """

    def __init__(self, spec: BlockSpec) -> None:
        super().__init__(spec)
        self.corrected_by_driver = False
        self.data: NDArray[np.float64] = self.rows["data"]
        self.flags: NDArray[np.int64] = self.rows["flags"]
        self.offset: NDArray[np.float64] = np.zeros(self.n)
        self.gains: NDArray[np.float64] | None = None
        self.alarms: Alarms | None = None
        self.shown = np.zeros_like(self.fields)
        rows = read_rows(spec.node_class, self.shown)
        self.shown_data: NDArray[np.float64] = rows["data"]
        self.shown_flags: NDArray[np.int64] = rows["flags"]
        self._bytes = self.shown.data.cast("B")

    def unfit(self) -> NDArray[np.bool_]:
        """Return which readings are no measurement, so that no offset may come from them, shape (n,)."""
        return unfit(self.flags, self.data)

    def set_offset(self, channels: NDArray[np.intp], offset: NDArray[np.float64]) -> None:
        """Take readings of some channels for their zero from now on."""
        self.offset[channels] = offset

    @property
    def is_plain(self) -> bool:
        """Whether what is published is the readings less an offset, and nothing else."""
        return self.gains is None and self.alarms is None

    def payload(self) -> memoryview:
        """Return the readings, corrected, as bytes in page order."""
        shown = self.shown_data
        np.subtract(self.data, self.offset, out=shown)
        if self.gains is not None:
            shown[:] = self.gains @ shown
        self.shown_flags[:] = self.flags
        if self.alarms is not None:
            self.shown_flags |= self.alarms.look(shown)
        return self._bytes


class BinaryBlock(Block):
    """Binary ports: ``data`` (n,) int64, one port of up to 62 bits a channel, and ``edges`` (n,) of each."""

    def __init__(self, spec: BlockSpec) -> None:
        super().__init__(spec)
        self.data: NDArray[np.int64] = self.rows["data"]
        self.edges: NDArray[np.int64] = self.rows["edges"]
        self._changed_ns = self.rows["changed_ns"]

    def set(self, port: int, value: int, stamp_ns: int) -> bool:
        """Set a port; count and stamp the edge if it is one.

        Args:
            port: index of the port.
            value: its new bits.
            stamp_ns: time of the edge, as exact as the device gives it [ns, CLOCK_MONOTONIC].

        Returns:
            Whether the value changed.
        """
        if int(self.data[port]) == value:
            return False
        self.data[port] = value
        self._changed_ns[port] = stamp_ns
        self.edges[port] += 1
        return True

    def count_lost(self, port: int, edges: int) -> None:
        """Count edges that happened and that nobody can tell any more: who compares ``edges`` sees that he missed
        them.
        """
        self.edges[port] += edges


@dataclass(slots=True)
class AxisBlock:
    """Axes: the bank that commands them; its ``fields`` are what is published.

    Attributes:
        stamp_ns: time the readings hold for [ns, CLOCK_MONOTONIC].
        asked_ns: when the poll began that brought them, 0: not known.
        admits: asked before a write is taken, with its records and the bank axis of each node-local index; raises
            CommandError. None: the bank alone judges.
    """

    spec: BlockSpec
    bank: Bank
    stamp_ns: int = 0
    asked_ns: int = 0
    admits: Callable[[Sequence[tuple[Any, ...]], Sequence[int]], None] | None = None
    n: int = field(init=False)

    def __post_init__(self) -> None:
        self.n = len(self.spec.channels)

    def payload(self) -> memoryview:
        """Return the readings as bytes in page order, without copying."""
        return self.bank.fields.data.cast("B")


AnyBlock = AxisBlock | AnalogBlock | BinaryBlock
