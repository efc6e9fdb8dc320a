"""A selector with timers: the daemon's one loop.

asyncio would double the daemon's start time and memory for what is one select call.
"""

from __future__ import annotations

import heapq
import itertools
import select
import time
from collections.abc import Callable
from typing import Any

from sioms.turns import Turns

from .precedence import Precedence

SHARE = 0.7
"""Of its time, what the daemon spends at most on requests."""
TIDY = 1024
"""Pending calls from which on cancelled ones are looked for."""
RESTLESS_NS, REST_NS, PAUSE_S = 20_000_000, 100_000, 0.005
"""After so long without a wait of at least REST_NS the loop pauses."""
NEVER_NS = 2**63
Callback = Callable[[], Any]


class Timer:
    """A pending call; ``cancel`` makes it void."""

    __slots__ = ("callback",)

    def __init__(self, callback: Callback) -> None:
        self.callback: Callback | None = callback

    def cancel(self) -> None:
        """Make the call void."""
        self.callback = None


class Loop:
    """Runs callbacks when descriptors become readable and when times are reached.

    Attributes:
        turns: serves clients, one packet after all else that there is to do.
        precedence: where the loop stands among real-time processes; None: it may not be one of them.

    Concurrency: one thread.
    """

    def __init__(self) -> None:
        self._epoll = select.epoll()
        self.precedence: Precedence | None = None
        self._callbacks: dict[int, Callback] = {}
        self.turns = Turns(self._epoll, (SHARE,))
        self._timers: list[tuple[int, int, Timer]] = []
        self._order = itertools.count()
        self._tidy_at = TIDY
        self._restless_ns = time.monotonic_ns()
        self.running = True

    def watch(self, fd: int, callback: Callback) -> None:
        """Call back whenever the descriptor is readable or hung up."""
        self._epoll.register(fd, select.EPOLLIN)
        self._callbacks[fd] = callback

    def unwatch(self, fd: int) -> None:
        """Stop watching a descriptor; call before closing it."""
        self._epoll.unregister(fd)
        del self._callbacks[fd]

    def at(self, when_ns: int, callback: Callback) -> Timer:
        """Call back once at a time [ns, CLOCK_MONOTONIC]."""
        if len(self._timers) > self._tidy_at:
            # Cancelled calls lie here until they are due, and that may be next week.
            self._timers = [entry for entry in self._timers if entry[2].callback is not None]
            heapq.heapify(self._timers)
            self._tidy_at = max(TIDY, 2 * len(self._timers))
        timer = Timer(callback)
        heapq.heappush(self._timers, (when_ns, next(self._order), timer))
        return timer

    def after(self, delay_s: float, callback: Callback) -> Timer:
        """Call back once after a delay [s]."""
        return self.at(time.monotonic_ns() + int(delay_s * 1e9), callback)

    def be_prompt(self, ahead: int) -> None:
        """Work ahead of all drivers, which this thread does under SCHED_FIFO, with this priority."""
        self.precedence = Precedence(self._epoll.fileno(), ahead)

    def run(self) -> None:
        """Run until ``running`` is cleared."""
        while self.running:
            self.step()

    def step(self) -> None:
        """Wait for the next event or timer and serve it."""
        while self._timers and self._timers[0][2].callback is None:
            heapq.heappop(self._timers)
        pause_s = self.turns.pause_s
        timeout = -1.0 if pause_s is None else pause_s
        if self._timers:
            due_s = max(0.0, (self._timers[0][0] - time.monotonic_ns()) / 1e9)
            timeout = due_s if pause_s is None else min(pause_s, due_s)
        events = self._wait(timeout)
        for fd, _ in events:
            # An earlier callback of this round may have closed this descriptor.
            callback = self._callbacks.get(fd)
            if callback is not None:
                callback()
            else:
                self.turns.mark(fd)
            self._serve_timers()  # a crowd at the door must not delay the stamp that drivers look at
        self.turns.serve()
        self._serve_timers()
        if time.monotonic_ns() - self._restless_ns > RESTLESS_NS:
            self._pause()

    def _wait(self, timeout_s: float) -> list[tuple[int, int]]:
        """Wait for events, at most for so long, for ever where it is negative."""
        began_ns = time.monotonic_ns()
        if self.precedence is not None:
            self.precedence.wait(began_ns + int(timeout_s * 1e9) if timeout_s >= 0.0 else NEVER_NS)
        events = self._epoll.poll(timeout_s)
        if self.precedence is not None:
            self.precedence.work()
        rested_ns = time.monotonic_ns()
        if rested_ns - began_ns > REST_NS:
            self._restless_ns = rested_ns
        return events

    def _pause(self) -> None:
        """Leave the processor to others: who runs before all of them must not take the machine along in a flood."""
        if self.precedence is not None:
            self.precedence.wait(time.monotonic_ns() + int(PAUSE_S * 1e9))
        time.sleep(PAUSE_S)
        if self.precedence is not None:
            self.precedence.work()
        self._restless_ns = time.monotonic_ns()

    def _serve_timers(self) -> None:
        now = time.monotonic_ns()
        while self._timers and self._timers[0][0] <= now:
            callback = heapq.heappop(self._timers)[2].callback
            if callback is not None:
                callback()

    def close(self) -> None:
        """Release the descriptor."""
        self._epoll.close()
