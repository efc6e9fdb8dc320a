"""When requests were sent, on a clock of the tests' own: the kernel's timestamps are of the system's."""

from __future__ import annotations

import time
from collections.abc import Callable

import pytest

from sioms.timestamps import Timestamps


class SentTimes:
    """Times of requests, by both clocks.

    Args:
        clock: gives the time of the tests [ns].
    """

    def __init__(self, clock: Callable[[], int]) -> None:
        self._clock = clock
        self._noted: list[tuple[int, int]] = []

    def note(self) -> None:
        """Note that a request is about to be sent."""
        self._noted.append((time.time_ns(), self._clock()))

    def install(self, patch: pytest.MonkeyPatch) -> None:
        """Have drivers take timestamps for times by the tests' clock."""
        patch.setattr(Timestamps, "monotonic_ns", lambda _, timestamp_ns: self._sent_ns(timestamp_ns))

    def _sent_ns(self, timestamp_ns: int) -> int:
        return next((ns for noted_ns, ns in reversed(self._noted) if noted_ns <= timestamp_ns), 0)
