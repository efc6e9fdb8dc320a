"""Records what nodes publish, every snapshot of it, and what happens meanwhile."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import sioms

PERIOD_S = 0.02


@dataclass(slots=True)
class Channel:
    """One recorded number: times [s since the recorder's start] and values; nan where the node was lost."""

    label: str
    times_s: list[float] = field(default_factory=list)
    values: list[float] = field(default_factory=list)


class Recorder:
    """Collects snapshots out of the rings of read-only nodes; never in the way of anybody.

    Concurrency: records in a thread of its own; ``event`` may be called from any thread.
    """

    def __init__(self, cell: sioms.Workcell) -> None:
        self._cell = cell
        self._sources: list[tuple[str, Any, list[tuple[Channel, Callable[[Any], float]]]]] = []
        self._seen: dict[str, int] = {}
        self.events: list[tuple[float, str]] = []
        self.start_ns = time.monotonic_ns()
        self._running = False
        self._thread = threading.Thread(target=self._run, name="recorder")

    def add(self, node: str, **channels: Callable[[Any], float]) -> list[Channel]:
        """Record numbers taken from the snapshots of a node."""
        made = [(Channel(label), take) for label, take in channels.items()]
        self._sources.append((node, self._cell.open(node), made))
        return [channel for channel, _ in made]

    def event(self, text: str, stamp_ns: int | None = None) -> None:
        """Note that something happens, now or at a stamp [ns, CLOCK_MONOTONIC]."""
        self.events.append((((stamp_ns or time.monotonic_ns()) - self.start_ns) / 1e9, text))

    def start(self) -> None:
        """Begin."""
        self._running = True
        self._thread.start()

    def stop(self) -> None:
        """End."""
        self._running = False
        self._thread.join()
        self._collect()

    def _run(self) -> None:
        while self._running:
            self._collect()
            time.sleep(PERIOD_S)

    def _collect(self) -> None:
        for index, (name, node, channels) in enumerate(self._sources):
            try:
                snapshots = node.history(self._seen.get(name, 0))
            except OSError:
                now_s = (time.monotonic_ns() - self.start_ns) / 1e9
                for channel, _ in channels:
                    channel.times_s.append(now_s)
                    channel.values.append(float("nan"))
                self._reopen(index)
                continue
            for snapshot in snapshots:
                at_s = (snapshot.stamp_ns - self.start_ns) / 1e9
                if at_s < 0:
                    continue
                for channel, take in channels:
                    channel.times_s.append(at_s)
                    channel.values.append(take(snapshot))
            if snapshots:
                self._seen[name] = snapshots[-1].number

    def _reopen(self, index: int) -> None:
        """The driver process is another one now: open its node again."""
        name, node, channels = self._sources[index]
        try:
            fresh = self._cell.open(name)
        except OSError:
            return
        node.close()
        self._seen[name] = 0
        self._sources[index] = (name, fresh, channels)
