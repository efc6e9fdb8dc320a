"""How old the word of a bridge's client may be when the bridge comes to it: one that is held up passes on later what
was said meanwhile, and the kernel does not tell when that was.

A thread beats while nodes are held. What is served while it does so in time has come just now; what is served within a
moment after a beat that was late may have come since the one before. Drivers refuse what is older than a reset of what
it is for: docs/decisions/1009-a-bridge-tells-how-old-a-word-may-be.md
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any

BEAT_S = 0.005
LATE_NS = 20_000_000
"""A beat that comes so long after the last one shows that all has been held up [ns]."""
SETTLE_NS = 200_000_000
"""So long after that what came meanwhile may still be waiting for its turn [ns]."""


class Prompt:
    """Tells since when what is served may have waited.

    Args:
        clock: the time [ns, CLOCK_MONOTONIC].
        beats: whether a thread beats; else who has made it calls ``beat``.

    Concurrency: any number of threads.
    """

    _word: ContextVar[int] = ContextVar("when what is being done was said")

    def __init__(self, clock: Callable[[], int] = time.monotonic_ns, *, beats: bool = True) -> None:
        self._clock = clock
        now_ns = clock()
        self._seen = now_ns, now_ns, now_ns
        """The last beat, and from when until when all was held up last."""
        if beats:
            threading.Thread(target=self._run, name="beats", daemon=True).start()

    def _run(self) -> None:
        while True:
            time.sleep(BEAT_S)
            self.beat()

    def beat(self) -> None:
        """Note that this process is not held up now."""
        now_ns, (last_ns, since_ns, until_ns) = self._clock(), self._seen
        if now_ns - last_ns > LATE_NS:
            since_ns, until_ns = since_ns if last_ns - until_ns < SETTLE_NS else last_ns, now_ns
        self._seen = now_ns, since_ns, until_ns

    def came_ns(self) -> int:
        """Return when what is served now came at the earliest [ns, CLOCK_MONOTONIC]."""
        self.beat()
        now_ns, since_ns, until_ns = self._seen
        return since_ns if now_ns - until_ns < SETTLE_NS else now_ns

    @contextmanager
    def word(self, came_ns: int | None = None) -> Iterator[None]:
        """Do in this context what a client has asked for now, or as of an earlier ``came_ns``."""
        token = self._word.set(self.came_ns() if came_ns is None else came_ns)
        try:
            yield
        finally:
            self._word.reset(token)

    def date(self, node: Any, *, asked_before: bool) -> Any:
        """Have all that is sent on a node's handle carry when its client said it; return the node.

        Args:
            node: it has just been opened.
            asked_before: whether something may be for it that was said before it was open.
        """
        channel = node._channel
        open_ns = 0 if asked_before else self._clock()
        if channel.carrier is None:  # a gateway tells by itself how old it is
            channel.said_ns = lambda: max(self._word.get(0) or self._clock(), open_ns)
        return node
