"""Light beams broken by moving axes, a gripper, and a square wave: binary inputs with exact edge times.

A binary input is known as a function of time, so its edges carry the instant at which they happened,
finer than the tick in which they are found.
"""

from collections.abc import Sequence

import numpy as np
from msgspec import Struct

from .binary_step import Beams


class Edge(Struct, frozen=True):
    """A change of a binary signal.

    Args:
        stamp_ns: when it happened [ns, CLOCK_MONOTONIC].
        level: the level after it.
    """

    stamp_ns: int
    level: bool


def port_values(value: int, edges: Sequence[tuple[Edge, int]]) -> list[tuple[int, int]]:
    """Return how a port changes under edges of its bits.

    Args:
        value: of the port before.
        edges: (edge, bit), in any order.

    Returns:
        (stamp_ns, value) for each instant at which the value changes, oldest first.
    """
    changes: list[tuple[int, int]] = []
    for edge, bit in sorted(edges, key=lambda item: item[0].stamp_ns):
        new = value | 1 << bit if edge.level else value & ~(1 << bit)
        if new == value:
            continue
        if changes and changes[-1][0] == edge.stamp_ns:
            changes.pop()
        changes.append((edge.stamp_ns, new))
        value = new
    return changes


class Box(Struct, frozen=True):
    """Positions at which an object breaks a beam: every listed coordinate lies within its interval.

    Args:
        intervals: (coordinate, low, high): index into the positions, bounds [m or rad], inclusive.
    """

    intervals: tuple[tuple[int, float, float], ...]

    def span(self, before: Sequence[float], after: Sequence[float]) -> tuple[float, float] | None:
        """Return the part of the way from before to after that lies inside, as fractions; None when none does."""
        enter, leave = 0.0, 1.0
        for coordinate, low, high in self.intervals:
            start, way = before[coordinate], after[coordinate] - before[coordinate]
            if way == 0.0:
                if not low <= start <= high:
                    return None
                continue
            first, second = (low - start) / way, (high - start) / way
            enter, leave = max(enter, min(first, second)), min(leave, max(first, second))
        return (enter, leave) if enter <= leave else None


class Beam:
    """A light beam and the boxes that break it.

    Args:
        boxes: the beam is broken while any of them holds.

    Attributes:
        broken: at the last look.
        positions, stamp_ns: of the last look; None and 0 before the first.
    """

    def __init__(self, boxes: Sequence[Box]) -> None:
        self.boxes = tuple(boxes)
        self.positions: tuple[float, ...] | None = None
        self.stamp_ns = 0
        self.broken = False

    def pass_over(self, positions: Sequence[float], stamp_ns: int) -> None:
        """Take the positions at a time on the way to which nothing has changed, as somebody else has found."""
        self.positions, self.stamp_ns = tuple(positions), stamp_ns

    def sample(self, positions: Sequence[float], stamp_ns: int) -> list[Edge]:
        """Take the positions at a time and return the edges since the last sample, oldest first.

        Between samples the positions move evenly.

        Args:
            positions: all coordinates [m or rad].
            stamp_ns: time they hold for [ns].
        """
        now = tuple(positions)
        before = now if self.positions is None else self.positions
        since_ns = stamp_ns if self.positions is None else self.stamp_ns
        self.pass_over(now, stamp_ns)
        spans = _union([span for box in self.boxes if (span := box.span(before, now))])
        changes: list[tuple[float, bool]] = []
        if self.broken and (not spans or spans[0][0] > 0.0):
            changes.append((0.0, False))
        for enter, leave in spans:
            if not (self.broken and enter == 0.0) and (enter < leave or leave == 1.0):
                changes.append((enter, True))
            if leave < 1.0 and (enter < leave or (self.broken and enter == 0.0)):
                changes.append((leave, False))
        if changes:
            self.broken = changes[-1][1]
        return [Edge(since_ns + round((stamp_ns - since_ns) * part), level) for part, level in changes]


def beams_record(beams: Sequence[Beam], coordinates: int) -> Beams:
    """Return beams as steps see them, for ``look``; what changes is not filled in.

    Args:
        beams: which.
        coordinates: how many positions they look at.
    """
    boxes = [box for beam in beams for box in beam.boxes]
    intervals = [interval for box in boxes for interval in box.intervals]
    ends = np.cumsum([0] + [len(beam.boxes) for beam in beams], dtype=np.int64)
    inner = np.cumsum([0] + [len(box.intervals) for box in boxes], dtype=np.int64)
    return Beams(
        n=len(beams), m=coordinates if beams else 0, looked_ns=0, boxes=ends, intervals=inner,
        coordinate=np.array([c for c, _, _ in intervals], dtype=np.int64),
        low=np.array([low for _, low, _ in intervals], dtype=np.float64),
        high=np.array([high for _, _, high in intervals], dtype=np.float64),
        broken=np.zeros(len(beams), dtype=np.bool_), before=np.zeros(coordinates), now=np.zeros(coordinates),
    )  # fmt: skip


def _union(spans: list[tuple[float, float]]) -> list[tuple[float, float]]:
    """Return overlapping spans merged, in order."""
    merged: list[tuple[float, float]] = []
    for enter, leave in sorted(spans):
        if merged and enter <= merged[-1][1]:
            merged[-1] = (merged[-1][0], max(merged[-1][1], leave))
        else:
            merged.append((enter, leave))
    return merged


class SquareWave(Struct, frozen=True):
    """A stimulus: high for a part of each period.

    Args:
        period_ns: [ns], at least 2.
        high_ns: how long it is high in each period [ns].
        start_ns: when the first period begins [ns]; low before.
        count: number of periods, 0 for no end.
    """

    period_ns: int
    high_ns: int
    start_ns: int = 0
    count: int = 0

    def level(self, stamp_ns: int) -> bool:
        """Return the level at a time."""
        cycle, phase = divmod(stamp_ns - self.start_ns, self.period_ns)
        return cycle >= 0 and not (self.count and cycle >= self.count) and phase < self.high_ns

    def edges(self, since_ns: int, until_ns: int) -> list[Edge]:
        """Return the edges after since up to and including until, oldest first."""
        edges: list[Edge] = []
        cycle = max(0, (since_ns - self.start_ns) // self.period_ns)
        while not (self.count and cycle >= self.count):
            rise = self.start_ns + cycle * self.period_ns
            if rise > until_ns:
                break
            for stamp, level in ((rise, True), (rise + self.high_ns, False)):
                if since_ns < stamp <= until_ns:
                    edges.append(Edge(stamp, level))
            cycle += 1
        return edges


class Gripper:
    """Jaws that move some time after the output that commands them, with an end switch at either end.

    Args:
        delay_ns: from the output to the first motion [ns].
        travel_ns: for the whole way [ns], positive.
        object_at: opening at which an object stops the jaws (0 closed to 1 open); 0 for no object.

    Attributes:
        opening: at the last sample, 0 closed to 1 open.
        closed, opened: the end switches at the last sample.
    """

    def __init__(self, delay_ns: int, travel_ns: int, object_at: float = 0.0) -> None:
        if delay_ns < 0 or travel_ns <= 0 or not 0 <= object_at < 1:
            raise ValueError(
                f"build gripper: delay {delay_ns} ns, travel {travel_ns} ns, object_at {object_at:g}; "
                "want at least 0, positive, and 0 to below 1"
            )
        self._delay_ns, self._travel_ns = delay_ns, travel_ns
        self.object_at = object_at
        self.opening, self.closed, self.opened = 1.0, False, True
        self._goals: list[tuple[int, bool]] = []
        self._asked = self._closing = False
        self._sampled_ns: int | None = None

    def command(self, close: bool, stamp_ns: int) -> None:
        """Set the output at a time [ns]; the same value again changes nothing."""
        if close != self._asked:
            self._asked = close
            self._goals.append((stamp_ns + self._delay_ns, close))

    def sample(self, stamp_ns: int) -> tuple[list[Edge], list[Edge]]:
        """Move the jaws up to a time and return the edges of the switches "closed" and "open", oldest first."""
        closed: list[Edge] = []
        opened: list[Edge] = []
        now_ns = stamp_ns if self._sampled_ns is None else self._sampled_ns
        while self._goals and self._goals[0][0] <= stamp_ns:
            begin_ns, closing = self._goals.pop(0)
            begin_ns = max(begin_ns, now_ns)
            self._move(now_ns, begin_ns, closed, opened)
            self._closing, now_ns = closing, begin_ns
        self._move(now_ns, stamp_ns, closed, opened)
        self._sampled_ns = stamp_ns
        return closed, opened

    @property
    def is_at_rest(self) -> bool:
        """Whether the jaws stand still, and will without another command."""
        return not self._goals and self.opening == (self.object_at if self._closing else 1.0)

    def _move(self, since_ns: int, until_ns: int, closed: list[Edge], opened: list[Edge]) -> None:
        """Move one way from a time to another."""
        end = self.object_at if self._closing else 1.0
        way = end - self.opening
        if way == 0 or until_ns <= since_ns:
            return
        arrival_ns = since_ns + round(abs(way) * self._travel_ns)
        if self.closed or self.opened:
            (closed if self.closed else opened).append(Edge(since_ns, False))
            self.closed = self.opened = False
        if arrival_ns > until_ns:
            self.opening += (until_ns - since_ns) / self._travel_ns * (1 if way > 0 else -1)
            return
        self.opening = end
        self.closed, self.opened = end == 0.0, end == 1.0
        if self.closed or self.opened:
            (closed if self.closed else opened).append(Edge(arrival_ns, True))
