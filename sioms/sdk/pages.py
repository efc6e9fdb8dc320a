"""Pages of a driver process: made, published, and told who waits for them.

Concurrency: the one thread of the driver process.
"""

from __future__ import annotations

import mmap
import os
import time
from collections.abc import Callable, Sequence

from sioms.protocol.flags import PageState
from sioms.protocol.page import PageWriter, page_size

from .blocks import AnyBlock, BinaryBlock
from .handles import Handle

PAGE = 4096


class Pages:
    """One shared page a block.

    Args:
        device: device name, for the names of the memory files.
        blocks: the blocks.
        lease_ns: how old the stamp of life may get.
        generation: of the driver process.
        told: called with state and reason when the device behind blocks gets, or loses, a good link.

    Attributes:
        fds: descriptors of the pages in the order of the blocks, until they have been handed over.
    """

    def __init__(
        self, device: str, blocks: Sequence[AnyBlock], lease_ns: int, generation: int,
        told: Callable[[PageState, str], None],
    ) -> None:  # fmt: skip
        self._told = told
        self.fds: list[int] = []
        self._writers: dict[int, PageWriter] = {}
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

    def alive(self, now_ns: int) -> None:
        """Stamp all pages as alive [ns, CLOCK_MONOTONIC]."""
        for writer in self._writers.values():
            writer.alive(now_ns)

    def publish(self, block: AnyBlock, stamp_ns: int, tick: int, as_of_ns: int) -> None:
        """Publish a block and wake who subscribed to it."""
        key = id(block)
        self._writers[key].publish(block.payload(), stamp_ns, tick, as_of_ns)
        subscribers = self._subscribers[key]
        if subscribers:
            self._wake(block, subscribers)

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
            self._told(state, reason)

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
