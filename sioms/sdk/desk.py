"""Writes that compiled steps have taken while the process waited: which clients they may serve, and what follows.

Concurrency: the one thread of the driver process.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from .blocks import AnyBlock, AxisBlock
from .serve_step import MOST_KEPT, MOST_WRITERS, REPLY, ROOM, Desk, StopFile

if TYPE_CHECKING:
    from collections.abc import Sequence

    from .attachments import Attachments
    from .handles import Handle
    from .pages import Pages
    from .stops import Stops


GRACE_NS = 250_000
"""How long after a packet the loop leaves its client a processor, where a tick later is soon enough."""
PATIENCE_NS = 3_000_000
"""How long it does so at most for a client that has yet to read the answer: it is waiting for a processor."""
SOON_NS = 1_000_000


class WriteDesk:
    """Lends the writers of a device's first axes to steps.

    Args:
        blocks: of the device.
        clients: its handles.
        stops, pages: of the process.
        request: descriptor of the stop-request file.
        gives_way: whether processes of the same priority may run after every packet.
        period_ns: of its ticks [ns].
        busy: one number, of how many devices of the process writes are kept.
    """

    def __init__(
        self, blocks: Sequence[AnyBlock], clients: Attachments, stops: Stops, pages: Pages, request: int,
        gives_way: bool, period_ns: int, busy: NDArray[np.int64],
    ) -> None:  # fmt: skip
        self._clients, self._stops, self._pages = clients, stops, pages
        self._writers: list[Handle] = []
        self._busy = busy
        self._packets = np.zeros(MOST_KEPT * ROOM, dtype=np.uint8)
        axes = [block for block in blocks if isinstance(block, AxisBlock)]
        plain = axes[0].bank.plain if axes else None
        self._block = axes[0] if plain is not None else None
        self.request = StopFile(there=1, file=request, word=0, changed=0)
        """What is seen of the file."""
        if plain is None:
            self.record = Desk.empty()
            return

        def row(count: int) -> NDArray[np.int64]:
            return np.zeros(count, dtype=np.int64)

        self.record = Desk(
            plain=plain, count=0, fds=row(MOST_WRITERS), first=row(MOST_WRITERS), known=row(MOST_WRITERS),
            axes=row(axes[0].n), heard=row(MOST_WRITERS), reset=row(MOST_WRITERS), request=self.request,
            gives_way=int(gives_way),
            grace_ns=GRACE_NS if period_ns <= SOON_NS else 0,
            patience_ns=PATIENCE_NS if period_ns <= SOON_NS else 0,
            packets=self._packets, busy=busy, kept=0, start=row(MOST_KEPT), size=row(MOST_KEPT), writer=row(MOST_KEPT),
            came=row(MOST_KEPT), effect=row(MOST_KEPT), took=row(MOST_KEPT), sent=row(MOST_KEPT), waiting=0, number=0,
            replace=0, at=0, records=0, reply=np.zeros(REPLY, dtype=np.uint8),
        )  # fmt: skip

    def lend(self) -> None:
        """Let steps serve the writers whose next packet has nothing to wait for."""
        block, record = self._block, self.record
        word, self.request.changed = self._stops.seen_request
        self.request.word = word - (word >> 63 << 64)
        if block is None:
            return
        record.count = record.kept = record.waiting = 0
        if self._stops.stopped or block.admits is not None or not block.bank.defers or self._pages.why_not(block):
            return
        writers = [
            handle
            for handle in self._clients.writers
            if handle.block is block
            and not (
                handle.writing
                or handle.waits
                or handle.ahead[1]
                or handle.halted
                or handle.is_in_doubt
                or handle.cut_short
            )
        ][:MOST_WRITERS]
        if writers != self._writers:
            self._list(writers)
        for i, handle in enumerate(writers):
            record.reset[i] = handle.reset_ns
        record.count = len(writers)

    def _list(self, writers: list[Handle]) -> None:
        record, first = self.record, 0
        self._writers = writers
        for i, handle in enumerate(writers):
            record.fds[i], record.first[i], record.known[i] = handle.sock.fileno(), first, len(handle.axes)
            for axis in handle.axes:
                record.axes[first] = axis
                first += 1

    def close(self) -> None:
        """Make room for other devices: this one has ended, and may have failed before anything was worked in."""
        self._busy[0] -= self.record.kept > 0
        self.record.kept = 0

    def take_back(self, tick: int) -> None:
        """Work in what has been served: writes, whose answers have told ``tick``, and words of gateways."""
        record = self.record
        for i in range(record.count):
            if heard_ns := int(record.heard[i]):
                record.heard[i] = 0
                self._clients.heard(self._writers[i], heard_ns)
        kept, record.kept = record.kept, 0
        self._busy[0] -= kept > 0
        for i in range(kept):
            packet = bytes(self._packets[record.start[i] : record.start[i] + record.size[i]])
            self._clients.served(
                self._writers[record.writer[i]], packet, int(record.came[i]), int(record.effect[i]),
                int(record.took[i]), None if record.sent[i] else tick,
            )  # fmt: skip
