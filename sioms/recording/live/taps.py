"""Takes everything out of the rings: the snapshots of nodes, and the events of journals."""

from __future__ import annotations

import mmap
import os
from select import POLLIN, poll
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sioms.client.workcell import Workcell
from sioms.protocol.flags import PageState
from sioms.protocol.journal import JournalReader
from sioms.protocol.nodeinfo import NodeInfo
from sioms.recording.messages import Event
from sioms.recording.notes import told


class PageTap:
    """The snapshots of one node, each once.

    Args:
        readings: a page reader, or what has the same methods (``client.transport.Readings``).
        channels: those of the block that are recorded, in order.
        columns: how many each channel has.
        last: number of the last snapshot that was taken; None: begin with the next one.

    Attributes:
        last: number of the last snapshot that was taken.
        lost: how many were overwritten before they were taken.
    """

    def __init__(self, readings: Any, channels: list[int], columns: int, last: int | None) -> None:
        self.last, self.lost = readings.head if last is None else last, 0
        self._readings = readings
        words = 4 + columns * readings.channels
        self._ring: NDArray[np.uint64] | None = None
        if hasattr(readings, "slots_view"):
            self._ring = np.frombuffer(readings.slots_view(), "<u8").reshape(readings.slots, words)
        self._pick: NDArray[np.intp] | None = None
        if channels != list(range(readings.channels)):
            rows = np.arange(columns)[:, None] * readings.channels + np.array(channels)
            self._pick = np.concatenate([np.arange(4), 4 + rows.ravel()])

    def take(self) -> NDArray[np.uint64] | None:
        """Return the snapshots since the last look, one a row, None when there is none."""
        head = self._readings.head
        if head == self.last:
            return None
        # The one behind the oldest is being written, perhaps.
        first = max(self.last + 1, head - self._readings.slots + 2)
        wanted = np.arange(first, head + 1)
        if self._ring is not None:
            places = wanted & (self._readings.slots - 1)
            slots = self._ring[places]
            good = (slots[:, 0] == wanted) & (self._ring[places, 0] == wanted)
            if not good.all():
                slots = slots[good]
        else:
            copies = [raw for number in wanted.tolist() if (raw := self._readings.numbered(number)) is not None]
            slots = np.frombuffer(b"".join(copies), "<u8").reshape(len(copies), -1)
        self.lost += head - self.last - len(slots)
        self.last = head
        chosen: NDArray[np.uint64] = slots if self._pick is None else slots[:, self._pick]
        return chosen

    def release(self) -> None:
        """Let go of the memory."""
        self._ring = None


class NodeTap:
    """A node that is recorded, through all driver processes behind it.

    Attributes:
        info: what it is; bit: of its port, -1 for none.
        lost: snapshots that were overwritten before they were taken.
        renew: whether it is to be opened again in any case.
    """

    def __init__(self, cell: Workcell, name: str, opened_as: str) -> None:
        self.name, self._opened_as = name, opened_as
        self.lost, self.renew = 0, False
        self._tap: PageTap | None = None
        self._node: Any = None
        self._device = 0
        self._last: int | None = None
        self.info: NodeInfo = cell.info(name)
        self.bit = -1
        self.open(cell)

    @property
    def is_over(self) -> bool:
        """Whether the driver process behind it has ended, so that it must be opened again."""
        if self._node is None or self.renew:
            return True
        readings = self._node.readings
        if hasattr(readings, "states"):
            driver, daemon = readings.states
            return driver is PageState.CLOSED or daemon is not PageState.GOOD
        return bool(readings.closed)

    def open(self, cell: Workcell) -> None:
        """Open the node, or open it again after its driver has ended.

        Raises:
            OSError: it cannot be opened (yet).
        """
        node = cell.open(self._opened_as)
        self.release()
        if self._device not in (0, node.readings.device):  # else the daemon is another one, the driver is not
            self._last = 0
        self.renew = False
        self._node, self._device, self.bit = node, node.readings.device, node.layout.bit
        self._tap = PageTap(node.readings, node.layout.channels, len(node.layout.columns), self._last)

    def take(self) -> tuple[NDArray[np.uint64] | None, int]:
        """Return the snapshots since the last look, and how many were lost before them."""
        if self._tap is None:
            return None, 0
        before = self._tap.lost
        slots = self._tap.take()
        self._last = self._tap.last
        lost = self._tap.lost - before
        self.lost += lost
        return slots, lost

    @property
    def ring_s(self) -> float:
        """How long a snapshot stays in the ring [s]."""
        return float(self._node.readings.slots / max(self.info.tick_hz, 1e-3))

    def release(self) -> None:
        """Let go of the node."""
        if self._tap is not None:
            self._tap.release()
            self._tap = None
        if self._node is not None:
            self._node.close()
            self._node = None


class JournalTap:
    """The events of one journal.

    Args:
        fd: of the journal; it is closed.
        leash: descriptor that becomes readable when the right to it ends; it is closed with the tap.
        source: whose it is, as events tell it.
    """

    def __init__(self, fd: int, leash: int, source: str) -> None:
        self.source = source
        self._leash, self._poll = leash, poll()
        self._poll.register(leash, POLLIN)
        try:
            self._map = mmap.mmap(fd, os.fstat(fd).st_size, prot=mmap.PROT_READ)
        finally:
            os.close(fd)
        self._reader = JournalReader(self._map, from_start=False)
        self._lost = 0

    def take(self) -> tuple[list[Event], int]:
        """Return the events since the last look, and how many were lost before them."""
        events = [told(self.source, noted) for noted in self._reader.read()]
        lost, self._lost = self._reader.lost - self._lost, self._reader.lost
        return events, lost

    @property
    def is_over(self) -> bool:
        """Whether the right to it has ended, or the session."""
        return bool(self._poll.poll(0))

    def release(self) -> None:
        """Let go of the memory."""
        os.close(self._leash)
        self._reader.release()
        self._map.close()
