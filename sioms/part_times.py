"""When parts of devices were stopped, and when they were reset: what was sent before that is not carried out after it.

See docs/decisions/0950-what-was-sent-before-a-reset-is-not-taken-after-it.md.

Concurrency: one thread.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable, Mapping
from typing import TypeAlias

Part: TypeAlias = tuple[int, int]
"""A channel, and a bit of it; bit 0 for channels without bits."""
Masks: TypeAlias = Mapping[int, int]
"""Channels, and which bits of each; -1: all."""
_Latest: TypeAlias = tuple[tuple[int, int], ...]
"""The latest time, and the latest of somebody else: each with who asked."""


class PartTimes:
    """Times of stops or of resets, of all and of parts of blocks, each with who asked for it.

    Who asks is known by a number, 0: nobody whose requests are judged. What somebody says after he has stopped or reset
    something himself was sent after that; of the requests of others it says nothing, so theirs are remembered beside.

    Attributes:
        count: how many have been noted.
    """

    def __init__(self) -> None:
        self.count = 0
        self._whole: _Latest = ()
        self._parts: dict[Hashable, dict[Part, _Latest]] = {}

    def note_all(self, at_ns: int, by: int = 0) -> None:
        """Note one of all blocks [ns, CLOCK_MONOTONIC]."""
        self.count += 1
        self._whole = _with(self._whole, at_ns, by)

    def note(self, block: Hashable, parts: Iterable[Part], at_ns: int, by: int = 0) -> None:
        """Note one of parts of a block.

        Args:
            block, parts: which.
            at_ns: when that was asked for [ns, CLOCK_MONOTONIC].
            by: who asked for it.
        """
        self.count += 1
        times = self._parts.setdefault(block, {})
        for part in parts:
            times[part] = _with(times.get(part, ()), at_ns, by)

    def latest_ns(self, block: Hashable, masks: Masks, asker: int) -> int:
        """Return the latest time for these parts of a block that is not the asker's own [ns]; 0: there is none."""
        return self._latest_ns(block, masks, lambda by: by != asker or not by)

    def own_ns(self, block: Hashable, masks: Masks, asker: int) -> int:
        """Return the latest time of the asker's own [ns]; 0: there is none."""
        return self._latest_ns(block, masks, lambda by: by == asker != 0)

    def latest_of_any_ns(self, asker: int) -> int:
        """Return the latest time for anything that is not the asker's own [ns]; 0: there is none."""
        return max((at_ns for at_ns, by in self._all() if by != asker or not by), default=0)

    def own_of_any_ns(self, asker: int) -> int:
        """Return the latest time of the asker's own for anything [ns]; 0: there is none."""
        return max((at_ns for at_ns, by in self._all() if by == asker != 0), default=0)

    def _all(self) -> Iterable[tuple[int, int]]:
        yield from self._whole
        for times in self._parts.values():
            for latest in times.values():
                yield from latest

    def since(self, block: Hashable, instant_ns: int) -> set[Part]:
        """Return the parts of a block for which there is a time after an instant."""
        return {part for part, latest in self._parts.get(block, {}).items() if latest[0][0] > instant_ns}

    def _latest_ns(self, block: Hashable, masks: Masks, counts: Callable[[int], bool]) -> int:
        found = [self._whole]
        found += [
            latest
            for (channel, bit), latest in self._parts.get(block, {}).items()
            if masks.get(channel, 0) >> bit & 1
        ]  # fmt: skip
        return max((at_ns for latest in found for at_ns, by in latest if counts(by)), default=0)


def _with(latest: _Latest, at_ns: int, by: int) -> _Latest:
    """Return the latest times when there is another one."""
    own_ns = max((each_ns for each_ns, who in latest if who == by), default=0)
    others = [each for each in latest if each[1] != by]
    return tuple(sorted([*others, (max(own_ns, at_ns), by)], reverse=True)[:2])
