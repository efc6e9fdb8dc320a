"""Pages of a driver process: made, published, and told who waits for them.

Concurrency: the one thread of the driver process.
"""

from __future__ import annotations

import mmap
import os
import time
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from sioms.protocol.flags import PageState
from sioms.protocol.page import PageWriter, page_size, slot_size

from .blocks import AnalogBlock, AnyBlock, AxisBlock, BinaryBlock
from .handles import Handle
from .quiet_step import MOST_SUBSCRIBERS, Page

PAGE = 4096


class Pages:
    """One shared page a block.

    Args:
        device: device name, for the names of the memory files.
        blocks: the blocks.
        lease_ns: how old the stamp of life may get.
        generation: of the driver process.
        told: called with blocks, state and reason when the device behind them gets, or loses, a good link.

    Attributes:
        fds: descriptors of the pages in the order of the blocks, until they have been handed over.
        before: called before each publication.
        watch: called with each block that has been published, and its time stamp [ns]; None: nobody watches.
    """

    def __init__(
        self, device: str, blocks: Sequence[AnyBlock], lease_ns: int, generation: int,
        told: Callable[[Sequence[AnyBlock], PageState, str], None],
    ) -> None:  # fmt: skip
        self._told = told
        self.before: Callable[[], None] = lambda: None
        self.watch: Callable[[AnyBlock, int], None] | None = None
        self.fds: list[int] = []
        self._writers: dict[int, PageWriter] = {}
        self._words: dict[int, NDArray[np.int64]] = {}
        self._records: list[tuple[int, Page]] = []
        self._subscribers: dict[int, list[Handle]] = {id(block): [] for block in blocks}
        self._edges: dict[int, int] = {}
        self._links: dict[int, tuple[PageState, str]] = {}
        device_number = int.from_bytes(os.urandom(8), "little") or 1
        for block in blocks:
            spec = block.spec
            size = -(-page_size(spec.node_class, block.n, spec.history) // PAGE) * PAGE
            fd = os.memfd_create(f"sioms:{device}.{spec.name}", os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
            os.ftruncate(fd, size)
            self.fds.append(fd)
            memory = memoryview(mmap.mmap(fd, size))
            writer = PageWriter(memory, spec.node_class, block.n, spec.history, lease_ns, generation, device_number)
            writer.alive(time.monotonic_ns())
            self._writers[id(block)] = writer
            self._words[id(block)] = np.frombuffer(memory, dtype=np.int64)

    def alive(self, now_ns: int) -> None:
        """Stamp all pages as alive [ns, CLOCK_MONOTONIC]."""
        for writer in self._writers.values():
            writer.alive(now_ns)

    def publish(self, block: AnyBlock, stamp_ns: int, tick: int, as_of_ns: int) -> None:
        """Publish a block and wake who subscribed to it."""
        key = id(block)
        self.before()
        self._writers[key].publish(block.payload(), stamp_ns, tick, as_of_ns)
        subscribers = self._subscribers[key]
        if subscribers:
            self._wake(block, subscribers)
        if self.watch is not None:
            self.watch(block, stamp_ns)

    def record(self, block: AnyBlock) -> Page:
        """Return the page of a block for steps that publish it; ``lend`` and ``take_back`` around them."""
        shown = block.bank.fields if isinstance(block, AxisBlock) else block.fields
        if isinstance(block, AnalogBlock):
            shown = block.shown
        spec = block.spec
        page = Page(
            words=self._words[id(block)], payload=shown.reshape(-1).view(np.int64), count=shown.size,
            slot=slot_size(spec.node_class, block.n) // 8, mask=spec.history - 1, number=0, subscribers=0,
            pipes=np.zeros(MOST_SUBSCRIBERS, dtype=np.int64), every=np.zeros(MOST_SUBSCRIBERS, dtype=np.int64),
            countdown=np.zeros(MOST_SUBSCRIBERS, dtype=np.int64),
        )  # fmt: skip
        self._records.append((id(block), page))
        return page

    def lend(self) -> bool:
        """Let steps publish from the present state on; False where there are more subscribers than they can wake."""
        for key, page in self._records:
            subscribers = self._subscribers[key]
            if len(subscribers) > MOST_SUBSCRIBERS:
                return False
            page.number, page.subscribers = self._writers[key].number, len(subscribers)
            for i, handle in enumerate(subscribers):
                page.pipes[i], page.every[i], page.countdown[i] = handle.wakes, handle.every, handle.countdown
        return True

    def take_back(self) -> None:
        """Go on from the state in which steps have left the pages."""
        for key, page in self._records:
            self._writers[key].published(page.number)
            for i, handle in enumerate(self._subscribers[key]):
                handle.countdown = page.countdown[i]

    def number(self, block: AnyBlock) -> int:
        """Return the number of a block's newest snapshot."""
        return self._writers[id(block)].number

    def as_of_ns(self, block: AnyBlock) -> int:
        """Return the instant before which everything shows in a block's newest snapshot, 0 without one."""
        return self._writers[id(block)].as_of_ns

    def subscribers(self, block: AnyBlock) -> list[Handle]:
        """Return who is woken by a block's publications; the list itself, to be changed."""
        return self._subscribers[id(block)]

    def set_link(self, blocks: Sequence[AnyBlock], state: PageState, reason: str) -> None:
        """Say how the device behind some blocks is: in their pages, and to the daemon once a change."""
        changed = False
        for block in blocks:
            if self._links.get(id(block)) != (state, reason):
                self._links[id(block)] = (state, reason)
                self._writers[id(block)].set_state(state, reason)
                changed = True
        if changed:
            self._told(blocks, state, reason)

    def is_good(self, blocks: Sequence[AnyBlock]) -> bool:
        """Whether all these blocks have a good link."""
        return all(self._links.get(id(block), (None,))[0] is PageState.GOOD for block in blocks)

    def why_not(self, block: AnyBlock) -> str:
        """Return why the device behind a block cannot be reached, empty when it can."""
        state, reason = self._links.get(id(block), (PageState.STARTING, "it is starting"))
        return "" if state is PageState.GOOD else reason or state.name.lower()

    def close(self, reason: str) -> None:
        """Mark all pages as closed for good."""
        for writer in self._writers.values():
            writer.set_state(PageState.CLOSED, reason)

    def _wake(self, block: AnyBlock, subscribers: list[Handle]) -> None:
        edge = False
        if isinstance(block, BinaryBlock):
            edges = int(block.edges.sum())
            edge = edges != self._edges.get(id(block))
            self._edges[id(block)] = edges
        for handle in subscribers:
            if handle.every < 0:
                if edge:
                    handle.wake()
                continue
            handle.countdown -= 1
            if handle.countdown <= 0:
                handle.countdown = handle.every
                handle.wake()
