"""Judges the numbers of records that a network may lose, double or deliver late. Pure."""

from __future__ import annotations

from collections import deque

REMEMBERED = 256
"""So many missing numbers are remembered, to tell what comes late from what comes twice."""
RESTART_AFTER = 8
"""So many records in a row from behind mean that the sender began to count anew."""


class SequenceWatch:
    """Counts what a stream of numbered records has lost.

    Args:
        modulus: at which the numbers start again from 0.

    Attributes:
        lost: numbers that never came, so far.
        late: numbers that came after a later one; they are no longer lost, but not fresh either.
        doubled: records that had come before.
        restarts: times the sender began to count anew.

    Example:
        >>> watch = SequenceWatch(1 << 32)
        >>> [watch.accept(number) for number in (1, 2, 5, 4, 5, 6)]
        [0, 0, 2, None, None, 0]
        >>> watch.lost, watch.late, watch.doubled
        (1, 1, 1)
    """

    def __init__(self, modulus: int) -> None:
        self.lost = self.late = self.doubled = self.restarts = 0
        self._modulus = modulus
        self._last: int | None = None
        self._behind = 0
        self._missing: deque[int] = deque(maxlen=REMEMBERED)

    def expect_anew(self) -> None:
        """Take any number next: the stream is started again."""
        self._last = None
        self._behind = 0
        self._missing.clear()

    def accept(self, number: int) -> int | None:
        """Return how many records were lost just before this one, None for one that is late or doubled."""
        last = self._last
        if last is None:
            self._last = number
            return 0
        step = (number - last) % self._modulus
        if step == 1:
            self._last, self._behind = number, 0
            return 0
        if 0 < step < self._modulus // 2:
            self._note_gap(last, step)
            self._last, self._behind = number, 0
            return step - 1
        return self._from_behind(number)

    def _note_gap(self, last: int, step: int) -> None:
        self.lost += step - 1
        first = max(1, step - REMEMBERED)
        self._missing.extend((last + i) % self._modulus for i in range(first, step))

    def _from_behind(self, number: int) -> int | None:
        self._behind += 1
        if self._behind >= RESTART_AFTER:
            self.restarts += 1
            self.expect_anew()
            self._last = number
            return 0
        if number in self._missing:
            self._missing.remove(number)
            self.lost -= 1
            self.late += 1
        else:
            self.doubled += 1
        return None
