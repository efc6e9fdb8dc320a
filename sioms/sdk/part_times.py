"""When parts of a device were stopped, and when they were reset: what was sent before that is not carried out after it.

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


class PartTimes:
    """Times of stops or of resets, of the whole device and of parts of it.

    Attributes:
        count: how many have been noted.
    """

    def __init__(self) -> None:
        self.count = 0
        self._whole_ns = 0
        self._parts: dict[int, dict[Part, tuple[int, int]]] = {}

    def note_all(self, at_ns: int) -> None:
        """Note one of the whole device [ns, CLOCK_MONOTONIC]."""
        self.count += 1
        self._whole_ns = max(self._whole_ns, at_ns)

    def note(self, block: AnyBlock, parts: Iterable[Part], at_ns: int, by: int = 0) -> None:
        """Note one of parts of a block.

        Args:
            block, parts: which.
            at_ns: when that was asked for [ns, CLOCK_MONOTONIC].
            by: number of the handle that asked for it; 0: none.
        """
        self.count += 1
        times = self._parts.setdefault(id(block), {})
        for part in parts:
            times[part] = max(times.get(part, (0, 0)), (at_ns, by))

    def latest_ns(self, block: AnyBlock, masks: Masks, asker: int) -> int:
        """Return the latest time for one of these parts of a block that is not a handle's own [ns]; 0: there is none.

        What a handle says after it has stopped or reset something itself was sent after that, and after all before.
        """
        latest_ns = self._whole_ns
        for (channel, bit), (at_ns, by) in self._parts.get(id(block), {}).items():
            if by != asker and masks.get(channel, 0) >> bit & 1:
                latest_ns = max(latest_ns, at_ns)
        return latest_ns
