"""Judges the numbers of records that a network may lose, double or deliver late. Pure.

A record is fresh when its number is ahead of all before it, by no more than can have been sent meanwhile. A number that
stands still, or a window of old records that is sent again and again, is never fresh: the stream behind it is frozen.
    Numbers
that begin anew are never fresh either, for a sender that restarted may have lost its settings: ``SequenceRestart`` is
    raised.
"""

from __future__ import annotations

from collections import deque
from typing import NoReturn

from sioms.sdk.exchange import LinkError

REMEMBERED = 256
"""So many missing numbers are remembered, to tell what comes late from what comes twice."""
RESTART_AFTER = 8
"""So many records in a row that follow each other, but nothing before them, mean that the sender began to count anew.
"""
SLACK_S = 1.0
"""A record's number may be ahead by this much more than its sender can have counted since the last one, or by SLACK
records.
"""
SLACK = 16
RATE_TOLERANCE = 1.05


class SequenceRestart(LinkError):
    """The sender began to count anew."""


class SequenceWatch:
    """Counts what a stream of numbered records has lost.

    Args:
        modulus: at which the numbers start again from 0.
        rate_hz: records that the sender numbers in a second.

    Attributes:
        lost: numbers that never came, so far.
        late: numbers that came after a later one; they are no longer lost, but not fresh either.
        doubled: records that had come before.
        restarts: times the sender began to count anew.

    Example:
        >>> watch = SequenceWatch(1 << 32, 1000.0)
        >>> [watch.accept(number, number * 1_000_000) for number in (1, 2, 3, 6, 5, 6, 7)]
        [None, 0, 0, 2, None, None, 0]
        >>> watch.lost, watch.late, watch.doubled
        (1, 1, 1)
    """

    def __init__(self, modulus: int, rate_hz: float) -> None:
        self.lost = self.late = self.doubled = self.restarts = 0
        self._modulus, self._rate_hz = modulus, rate_hz
        self._slack = max(SLACK_S * rate_hz, SLACK)
        self._last: int | None = None
        self._before: int | None = None
        self._last_ns = 0
        self._ahead = 0.0
        self._behind: list[int] = []
        self._missing: deque[int] = deque(maxlen=REMEMBERED)

    @property
    def last(self) -> int | None:
        """Number of the newest record; None when the stream was begun anew and nothing has come."""
        return self._last

    def expect_anew(self, *, goes_on: bool = False) -> None:
        """Take any number next: the stream is started again.

        Args:
            goes_on: a start does not set the numbers back: the last ones that were seen are still old.
        """
        self._before = (self._last if self._last is not None else self._before) if goes_on else None
        self._last = None
        self._behind.clear()
        self._missing.clear()

    def accept(self, number: int, now_ns: int) -> int | None:
        """Return how many records were lost just before this one, None for one that is not known to be fresh.

        The first record after ``expect_anew`` is none either: nothing before it shows that it is not an old one.

        Raises:
            SequenceRestart: the sender began to count anew.
        """
        last = self._last
        if last is None:
            if self._before is not None and (self._before - number) % self._modulus < REMEMBERED:
                self.doubled += 1
                return None
            self._last, self._last_ns, self._ahead = number, now_ns, self._slack
            return None
        step = (number - last) % self._modulus
        if 0 < step < self._modulus // 2 and self._is_possible(step, now_ns):
            if step == 1 and len(self._behind) >= RESTART_AFTER and self._behind[-1] == last:
                self._begin_anew(f"began anew at {self._behind[0]}")  # and has just caught up
            if step > 1:
                self._note_gap(last, step)
            self._last = number
            self._behind.clear()
            return step - 1
        self._judge_old(number, step)
        return None

    def _is_possible(self, step: int, now_ns: int) -> bool:
        """Tell whether so many records can have been sent since the last one; what is not used up is kept for
        SLACK_S.
        """
        elapsed_s = (now_ns - self._last_ns) * 1e-9
        ahead = min(self._ahead, self._slack) + elapsed_s * self._rate_hz * RATE_TOLERANCE
        if step > ahead:
            return False
        self._ahead, self._last_ns = ahead - step, now_ns
        return True

    def _note_gap(self, last: int, step: int) -> None:
        self.lost += step - 1
        first = max(1, step - REMEMBERED)
        self._missing.extend((last + i) % self._modulus for i in range(first, step))

    def _judge_old(self, number: int, step: int) -> None:
        if number in self._missing:
            self._missing.remove(number)
            self.lost -= 1
            self.late += 1
            return
        self.doubled += 1
        follows = bool(self._behind) and (number - self._behind[-1]) % self._modulus == 1
        if not follows:
            self._behind.clear()
        if step or follows:
            self._behind.append(number)
        # a window that is sent again ends at the last number at the latest: it can be longer than RESTART_AFTER
        replayed = -step % self._modulus < REMEMBERED
        if len(self._behind) >= (REMEMBERED if replayed else RESTART_AFTER):
            how = "jumped ahead to" if step < self._modulus // 2 else "began anew at"
            self._begin_anew(f"{how} {self._behind[0]}")

    def _begin_anew(self, what: str) -> NoReturn:
        last = self._last
        self.restarts += 1
        self.expect_anew()
        raise SequenceRestart(f"the numbers of its records {what} after {last}: it has restarted, or sends otherwise")
