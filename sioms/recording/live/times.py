"""The time of a recording: that of the cell's machine, whatever machine records.

Snapshots and events carry CLOCK_MONOTONIC of the cell's machine, which counts from that machine's start. UTC is that of
the cell's machine, too, so that two recordings of one cell agree, wherever they are made.
"""

from __future__ import annotations

import time

from sioms.protocol.clock import UNKNOWN_NS, Clock

ANEW_NS = 1_000_000_000
"""By how much the clock of a cell must differ from what was expected to be that of a machine started anew [ns]."""


class CellTime:
    """The clock of a cell over the sessions with it.

    Args:
        clock: of the cell, as ``Workcell.clock``.

    Attributes:
        offset_ns: UTC minus CLOCK_MONOTONIC of the cell's machine, when the recording began.
        shift_ns: what is added to stamps of the present session [ns]: 0, unless the cell's machine has been started
            anew since, and its clock with it; stamps of a recording go on counting.
    """

    def __init__(self, clock: Clock) -> None:
        wall = clock.wall
        self.offset_ns = 0 if wall is None else wall.ahead_ns
        self.shift_ns = 0
        self._clock = clock

    def now_ns(self) -> int:
        """Return the time as the recording counts it [ns]."""
        return self._clock.there(time.monotonic_ns()) + self.shift_ns

    def resume(self, clock: Clock) -> bool:
        """Go on with another session; return whether the cell's machine has been started anew."""
        moved_ns = clock.offset_ns - self._clock.offset_ns
        anew = abs(moved_ns) > ANEW_NS
        if anew:
            self.shift_ns -= moved_ns
        self._clock = clock
        return anew

    def about(self) -> dict[str, str]:
        """Return what a recording says of its clock."""
        wall = self._clock.wall
        error_ns = UNKNOWN_NS if wall is None else wall.error_ns
        return {
            "offset_ns": str(self.offset_ns),
            "clock": "UTC = CLOCK_MONOTONIC of the workcell's machine + offset_ns",
            "utc_source": self._clock.utc(0).source,
            "utc_error_ns": "unknown" if error_ns >= UNKNOWN_NS else str(error_ns),
        }
