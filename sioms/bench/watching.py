"""Watching axes from outside: which snapshot showed a change first.

All stamps are CLOCK_MONOTONIC, as is the time of the bench's own acts, so latencies are differences.
A snapshot's stamp is the instant of its tick, and its values hold for that instant.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

HISTORY = 1024
"""Snapshots kept by watched devices: at 1 kHz a second."""
SLOWER = 1e-9
LOOK_BACK_NS = 3_000_000
"""A snapshot that far before the act tells the speeds that must fall, of devices at 1 kHz."""


class Watch:
    """The snapshots of a read-only node from now on.

    Args:
        node: the node; its device keeps enough history for as long as the watch lasts.
    """

    def __init__(self, node: Any) -> None:
        self._node = node
        self._after = node.read().number - 8

    def first(self, condition: Callable[[Any], bool], since_ns: int, timeout_s: float, what: str) -> Any:
        """Wait for the first snapshot with a stamp from ``since_ns`` on for which a condition holds.

        Raises:
            TimeoutError: there was none.
        """
        deadline = time.monotonic() + timeout_s
        after = self._after
        while True:
            for snapshot in self._node.history(after, gone=True):
                after = snapshot.number
                if snapshot.stamp_ns >= since_ns and condition(snapshot):
                    return snapshot
            if time.monotonic() > deadline:
                raise TimeoutError(f"watch {self._node.name} for {what}: nothing within {timeout_s:g} s")
            time.sleep(0.002)


def halting_ns(
    watch: Watch, since_ns: int, deceleration: float | None = None, timeout_s: float = 3.0,
    look_back_ns: int = LOOK_BACK_NS,
) -> int:  # fmt: skip
    """Return the stamp of the first snapshot in which every axis was commanded slower than at ``since_ns``.

    Args:
        watch: of the axes.
        since_ns: when it was that they should halt [ns].
        deceleration: known constant deceleration of all axes [m/s^2]: then the instant at which the last
            of them began to brake is returned, instead of the tick that showed it first.
        timeout_s: how long to wait for it [s].
        look_back_ns: some periods of the tick: a snapshot that far before tells the speeds that must fall [ns].

    Raises:
        TimeoutError: an axis went on.
    """
    before = watch.first(lambda s: True, since_ns - look_back_ns, timeout_s, "a first look").commanded_velocity

    def slower(snapshot: Any) -> bool:
        pairs = zip(snapshot.commanded_velocity, before, strict=True)
        return all(abs(now) < abs(was) - SLOWER for now, was in pairs)

    found = watch.first(slower, since_ns, timeout_s, "axes halting")
    if deceleration is None:
        return int(found.stamp_ns)
    lost = min(abs(was) - abs(now) for now, was in zip(found.commanded_velocity, before, strict=True))
    return int(found.stamp_ns) - int(lost / deceleration * 1e9)


def standing_ns(watch: Watch, since_ns: int, timeout_s: float = 3.0) -> int:
    """Return the stamp of the first snapshot in which no axis was commanded to move."""
    snapshot = watch.first(lambda s: not any(s.commanded_velocity), since_ns, timeout_s, "axes at rest")
    return int(snapshot.stamp_ns)
