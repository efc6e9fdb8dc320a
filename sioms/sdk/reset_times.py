"""When what was stopped was reset, to tell requests that were sent before that: they are not carried out after it.

See docs/decisions/0950-what-was-sent-before-a-reset-is-not-taken-after-it.md.

Concurrency: one thread.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from .blocks import AnyBlock

Part = tuple[int, int]
"""A channel, and a bit of it; bit 0 for channels without bits."""
Masks = Mapping[int, int]
"""Channels, and which bits of each; -1: all."""


class ResetTimes:
    """Times of resets, of the whole device and of parts of it.

    Attributes:
        count: how many resets have been seen.
    """

    def __init__(self) -> None:
        self.count = 0
        self._whole_ns = 0
        self._parts: dict[int, dict[Part, tuple[int, int]]] = {}

    def note_all(self, at_ns: int) -> None:
        """Note a reset of the whole device [ns, CLOCK_MONOTONIC]."""
        self.count += 1
        self._whole_ns = max(self._whole_ns, at_ns)

    def note(self, block: AnyBlock, parts: Iterable[Part], at_ns: int, by: int = 0) -> None:
        """Note a reset of parts of a block.

        Args:
            block, parts: what was stopped and is not any more.
            at_ns: when that was asked for [ns, CLOCK_MONOTONIC].
            by: number of the handle that asked for it; 0: none.
        """
        self.count += 1
        times = self._parts.setdefault(id(block), {})
        for part in parts:
            times[part] = max(times.get(part, (0, 0)), (at_ns, by))

    def latest_ns(self, block: AnyBlock, masks: Masks, asker: int) -> int:
        """Return when one of these parts of a block was last reset by another than a handle [ns]; 0: never.

        What a handle says after it has reset something itself was sent after that, and after all resets before.
        """
        latest_ns = self._whole_ns
        for (channel, bit), (at_ns, by) in self._parts.get(id(block), {}).items():
            if by != asker and masks.get(channel, 0) >> bit & 1:
                latest_ns = max(latest_ns, at_ns)
        return latest_ns
