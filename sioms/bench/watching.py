"""Watching axes from outside: which snapshot showed a change first.

All stamps are CLOCK_MONOTONIC, as is the time of the bench's own acts, so latencies are differences.
A snapshot's stamp is the instant of its tick, and its values hold for that instant.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from .figures import Bar, Report

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

    def before(self, at_ns: int) -> Any:
        """Return the last snapshot with a stamp up to ``at_ns``, the first one of all if there is none: a device that
        got no processor for a while has none of the milliseconds before, and the next one is of what came then.
        """
        seen = self._node.history(self._after, gone=True)
        if not seen:
            raise TimeoutError(f"watch {self._node.name}: it has no snapshots")
        return next((each for each in reversed(seen) if each.stamp_ns <= at_ns), seen[0])


class Counted:
    """Looks of trials whose worst is counted: what never came has come when the look ended, and the run goes on.

    Attributes:
        lost: what has not come, in words.
    """

    def __init__(self) -> None:
        self.lost: list[str] = []

    def look(self, look: Callable[[], int]) -> int:
        """Return an instant, or that of giving up [ns]."""
        try:
            return look()
        except TimeoutError as error:
            self.lost.append(str(error))
            return time.monotonic_ns()

    def tell(self, report: Report, what: str) -> None:
        """Report how many did not come, of which there should be none."""
        report.value(f"{what} not seen", len(self.lost), "", bars=[Bar("value", 0)], notes="; ".join(self.lost[:3]))


def halting_ns(watch: Watch, since_ns: int, timeout_s: float = 3.0, look_back_ns: int = LOOK_BACK_NS) -> int:
    """Return the stamp of the first snapshot in which every axis was commanded slower than at ``since_ns``.

    Args:
        watch: of the axes.
        since_ns: when it was that they should halt [ns].
        timeout_s: how long to wait for it [s].
        look_back_ns: some periods of the tick: a snapshot that far before tells the speeds that must fall [ns].

    Raises:
        TimeoutError: an axis went on.
    """
    before = watch.before(since_ns - look_back_ns).commanded_velocity

    def slower(snapshot: Any) -> bool:
        pairs = zip(snapshot.commanded_velocity, before, strict=True)
        return all(abs(now) < abs(was) - SLOWER for now, was in pairs)

    return int(watch.first(slower, since_ns, timeout_s, "axes halting").stamp_ns)


def slowing_ns(watch: Watch, since_ns: int, timeout_s: float = 3.0, look_back_ns: int = LOOK_BACK_NS) -> int:
    """Return the stamp of the first snapshot in which every axis was measured a hundredth slower than at ``since_ns``.

    Args, Raises: as halting_ns.
    """
    before = watch.before(since_ns - look_back_ns).velocity

    def slower(snapshot: Any) -> bool:
        return all(abs(now) < 0.99 * abs(was) for now, was in zip(snapshot.velocity, before, strict=True))

    return int(watch.first(slower, since_ns, timeout_s, "axes slowing down").stamp_ns)


def standing_ns(watch: Watch, since_ns: int, timeout_s: float = 3.0) -> int:
    """Return the stamp of the first snapshot in which no axis was commanded to move."""
    snapshot = watch.first(lambda s: not any(s.commanded_velocity), since_ns, timeout_s, "axes at rest")
    return int(snapshot.stamp_ns)
