"""Two clocks: what is known of one machine's from another, and of either by UTC. Pure.

Conventions: CLOCK_MONOTONIC of two machines, *here* and *there* (the cell's), in integer nanoseconds. The offset is
what there shows more than here.
"""

from __future__ import annotations

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Mapping
    from enum import IntEnum
else:
    from .enumeration import IntEnum

DRIFT_PPM = 200
"""How fast two clocks part at most: two oscillators of 50 ppm, both slewed a little by their disciplines."""
UNKNOWN_NS = 1 << 62
"""The error of a time of which nothing is known [ns]."""


class Source(IntEnum):
    """What keeps a wall clock right. The numbers are wire facts."""

    NONE = 0
    NTP = 1
    PTP = 2


class Wall:
    """A wall clock beside a monotonic one.

    Attributes:
        ahead_ns: what UTC since 1970 shows more than CLOCK_MONOTONIC of the same machine.
        error_ns: how wrong the former is at most, as its kernel knows; UNKNOWN_NS where nothing keeps it right.
        source: what does.
    """

    __slots__ = ("ahead_ns", "error_ns", "source")

    def __init__(self, ahead_ns: int, error_ns: int, source: int) -> None:
        self.ahead_ns, self.error_ns, self.source = ahead_ns, error_ns, source


class Utc:
    """An instant by UTC.

    Attributes:
        ns: since 1970 [ns].
        error_ns: how wrong it is at most [ns]; ``clock.UNKNOWN_NS`` where nothing keeps the cell's clock right.
        source: what keeps the cell's clock right: 'PTP', 'NTP' or 'none'.
    """

    __slots__ = ("error_ns", "ns", "source")

    def __init__(self, ns: int, error_ns: int, source: str) -> None:
        self.ns, self.error_ns, self.source = ns, error_ns, source

    def __repr__(self) -> str:
        error = "unknown" if self.error_ns >= UNKNOWN_NS else f"{self.error_ns / 1e3:.0f} us"
        return f"<UTC {self.ns / 1e9:.6f} s, error {error}, by {self.source}>"


class Offset:
    """Bounds of the offset of two clocks, out of exchanges of messages.

    A message that was sent here at a and came there at b says that the offset is less than b - a, one of the other
    direction that it is more: no exchange of any delay can make them wrong, and short ones make them narrow. Bounds of
    before hold on, widened by what clocks drift.

    Args:
        drift_ppm: how fast the clocks part at most [1e-6].
    """

    def __init__(self, drift_ppm: int = DRIFT_PPM) -> None:
        self._drift_ppm = drift_ppm
        self._low = self._high = 0
        self._at_ns: int | None = None
        self.restarts = -1

    @property
    def known(self) -> bool:
        """Whether there has been an exchange."""
        return self._at_ns is not None

    def exchange(self, sent_ns: int, got_ns: int, answered_ns: int, back_ns: int) -> None:
        """Take an exchange: sent here, got there, answered there, back here.

        Raises:
            ValueError: one of both took negative time.
        """
        low, high = answered_ns - back_ns, got_ns - sent_ns
        if low > high or back_ns < sent_ns:
            raise ValueError(f"an exchange from {sent_ns} to {back_ns} with {got_ns} to {answered_ns} in between")
        high += (back_ns - sent_ns) * self._drift_ppm // 1_000_000 + 1  # it is of the beginning, the other of the end
        if self._at_ns is not None:
            wider = self._wider(back_ns)
            narrow = max(low, self._low - wider), min(high, self._high + wider)
            if narrow[0] <= narrow[1]:
                self._low, self._high, self._at_ns = *narrow, back_ns
                return
        # The first, or one of the clocks has jumped, as while its machine was suspended: begin anew.
        self._low, self._high, self._at_ns = low, high, back_ns
        self.restarts += 1

    def _wider(self, now_ns: int) -> int:
        return abs(now_ns - (self._at_ns or 0)) * self._drift_ppm // 1_000_000 + 1

    @property
    def ns(self) -> int:
        """The offset: the middle of its bounds [ns]."""
        return (self._low + self._high) // 2

    def error_ns(self, now_ns: int) -> int:
        """Return how wrong ``ns`` is at most at an instant here [ns]."""
        if self._at_ns is None:
            return UNKNOWN_NS
        return (self._high - self._low + 1) // 2 + self._wider(now_ns)


class Clock:
    """The clock of a cell as a client sees it. This one is that of a cell on the same machine; a link has its own.

    Attributes:
        wall: tells of the cell's wall clock; None: not known.
        everywhere_ns: instant, in the cell's clock, before which nothing that its nodes show may end.
    """

    wall: Wall | None = None
    everywhere_ns = 0

    @property
    def offset_ns(self) -> int:
        """What the cell's clock shows more than that of this machine."""
        return 0

    @property
    def error_ns(self) -> int:
        """How wrong that is at most [ns]."""
        return 0

    def here(self, there_ns: int) -> int:
        """Return an instant of the cell's clock in that of this machine."""
        return there_ns - self.offset_ns

    def there(self, here_ns: int) -> int:
        """Return an instant of this machine's clock in that of the cell."""
        return here_ns + self.offset_ns

    def utc(self, there_ns: int) -> Utc:
        """Return an instant of the cell's clock by UTC, as the cell's machine knows it."""
        wall = self.wall
        if wall is None:
            return Utc(0, UNKNOWN_NS, "none")
        return Utc(there_ns + wall.ahead_ns, wall.error_ns, ("none", "NTP", "PTP")[wall.source])


def starts(start_ns: int, clocks: Mapping[str, Clock], within_ns: int) -> tuple[dict[str, int], int, str]:
    """Return one instant in the clocks of several cells, by what makes their differences least.

    Args:
        start_ns: the instant here [ns, CLOCK_MONOTONIC].
        clocks: of the cells, by their names, each with its wall clock.
        within_ns: how far apart the cells may be [ns].

    Returns:
        The instant in the clock of each cell, how far two are apart at most [ns], and by what: 'UTC' or 'links'.

    Raises:
        ValueError: what is known of the clocks does not do.
    """
    links = {name: clock.error_ns for name, clock in clocks.items()}
    walls = {name: clock.wall or Wall(0, UNKNOWN_NS, Source.NONE) for name, clock in clocks.items()}
    bounds = {"links": _apart(list(links.values())), "UTC": _apart([wall.error_ns for wall in walls.values()])}
    by = min(bounds, key=bounds.__getitem__)
    if bounds[by] > within_ns:
        told = ", ".join(f"{name} {_text(links[name])} and {_text(walls[name].error_ns)}" for name in clocks)
        apart = f"the cells may be {_text(bounds[by])} apart, more than {_text(within_ns)}"
        raise ValueError(f"{apart}; errors by link and by UTC: {told}")
    there = {name: clock.there(start_ns) for name, clock in clocks.items()}
    if by == "UTC":
        first = next(iter(clocks))
        utc_ns = there[first] + walls[first].ahead_ns
        there = {name: utc_ns - wall.ahead_ns for name, wall in walls.items()}
    return there, bounds[by], by


def _apart(errors: list[int]) -> int:
    """Return how far apart two of several are at most; one alone is not."""
    return sum(sorted(errors)[-2:]) if len(errors) > 1 else 0


def _text(ns: int) -> str:
    return "unknown" if ns >= UNKNOWN_NS else f"{ns / 1e3:.0f} us"
