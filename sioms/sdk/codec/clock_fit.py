"""Maps the stamps of a device's clock to the host's clock by the least delay seen.

A sample stamped ``t`` by the device arrives at host time ``h = t + offset + drift t + delay`` with a
delay that is never negative and often near its least value. So the line that touches the points
(t, h - t) from below is the best estimate of offset and drift: of all lines under the points the one
nearest to them in the mean is the edge of their lower convex hull over the mean of t (Moon, Skelly
and Towsley, "Estimation and removal of clock skew from network delay measurements", INFOCOM 1999).
What remains unknown is the least delay itself, which a one-way stream cannot show.

The window is kept as the point of least delay of each of the last quarter seconds, so memory and work are bounded: a
few operations a sample, one hull a quarter second.

**The rate that is stated may be wrong.** It is measured, as the median slope over all pairs of these points (Theil and
Sen: a few that were held up do not matter), and replaces the stated one where it differs by more than delays explain.
Until it has been measured (RATE_SPAN_NS) no stamp is more than LATE_NS before the sample's arrival. Later, a sample may
be mapped further back, for a host that was held up gets old samples; but only for BURST_NS, and when all samples of
GIVE_UP_NS came late, the fit no longer holds and begins anew with them.
"""

from __future__ import annotations

from collections import deque
from itertools import combinations, pairwise
from statistics import median

BUCKET_NS = 250_000_000
BUCKETS = 64
MAX_DRIFT = 0.01
"""Bound of the relative drift: ceramic resonators keep 0.5 %."""
MIN_SPAN_NS = 2_000_000_000
"""Before the window is this long the jitter of the delays would pass for drift."""
STALL_NS = 50_000_000
"""A bucket whose least delay is longer than drift and this explain was held up, and tells nothing."""
JUMP_NS = 500_000_000
"""A stamp that maps further than this into the future belongs to a clock that was set back to start."""
RATE_SPAN_NS = 700_000_000
"""Measured over less than this, a rate is not believed: four points of the window."""
RATE_POINTS = 24
"""Points that a rate is measured on: 276 pairs."""
RATE_LATELY = 6
"""Points on which a rate is seen to have changed."""
RATE_TOLERANCE = 0.005
RATE_JITTER_NS = 20_000_000
"""A rate is wrong when it differs by RATE_TOLERANCE and by what this jitter makes of the span."""
LATE_NS = 50_000_000
BURST_NS = 100_000_000
GIVE_UP_NS = 500_000_000


class ClockFit:
    """Running fit of one device clock that counts ticks and wraps.

    Args:
        tick_ns: duration of one count as stated [ns].
        modulus: counts after which the clock starts again at 0.

    Attributes:
        restarts: times the clock was set back to start.
        misfits: times the fit no longer held and was begun anew.
        is_measured: the rate has been measured since the clock began; until then stamps may be wrong by LATE_NS.
    """

    def __init__(self, tick_ns: float = 1000, modulus: int = 1 << 32) -> None:
        self.restarts = self.misfits = 0
        self._mapped_ns: int = 0
        self._stated_ns, self._modulus = tick_ns, modulus
        self._tick_ns = float(tick_ns)
        self._reset()

    @property
    def drift(self) -> float:
        """Host time per device time as stated minus one, as fitted."""
        return self._tick_ns / self._stated_ns * (1 + self._slope) - 1

    @property
    def rate_error(self) -> float:
        """Measured duration of a count over the stated one minus one, where that was found wrong; else 0."""
        return self._tick_ns / self._stated_ns - 1

    @property
    def uncertainty_ns(self) -> int:
        """How far stamps may be from the truth, beside the least delay: the scatter of the points about the fit."""
        if not self.is_measured:
            return LATE_NS
        over = [now - self._map(self._device(count)) for count, now in list(self._points)[-RATE_POINTS:]]
        return max(0, min(max(over), LATE_NS))

    def to_host(self, count: int, now_ns: int) -> int:
        """Return the host time [ns] of the device's stamp ``count`` that arrived at ``now_ns``.

        Never later than ``now_ns`` and never earlier than what an earlier stamp was mapped to.
        """
        device_ns = self._unwrap(count, now_ns)
        if self._points and self._map(device_ns) > now_ns + JUMP_NS:
            self._reset()
            self.restarts += 1
            device_ns = self._unwrap(count, now_ns)
        self._add(device_ns, now_ns)
        stamp_ns = self._bounded(self._map(self._device(self._counted)), now_ns)
        self._mapped_ns = max(min(stamp_ns, now_ns), self._mapped_ns)
        return self._mapped_ns

    def expect_anew(self) -> None:
        """Forget what was fitted: the device may have begun anew meanwhile. Mapped stamps still never go back."""
        self._reset()

    def _reset(self) -> None:
        self._points: deque[tuple[int, int]] = deque(maxlen=BUCKETS)
        self._bucket_end_ns = 0
        self._last_count = self._last_now_ns = self._counted = 0
        self._slope = 0.0
        self._anchor = (0, 0)
        self._late_since_ns: int | None = None
        self.is_measured = False

    def _unwrap(self, count: int, now_ns: int) -> int:
        """Return device time since the first stamp [ns], whole turns of the counter by the host's clock."""
        if self._points:
            step = (count - self._last_count) % self._modulus
            elapsed = (now_ns - self._last_now_ns) / self._tick_ns
            turns = max(0, round((elapsed - step) / self._modulus))
            self._counted += step + turns * self._modulus
        self._last_count, self._last_now_ns = count, now_ns
        return self._device(self._counted)

    def _device(self, counted: int) -> int:
        return round(counted * self._tick_ns)

    def _map(self, device_ns: int) -> int:
        t, d = self._anchor
        return device_ns + d + round(self._slope * (device_ns - t))

    def _add(self, t: int, now_ns: int) -> None:
        d = now_ns - t
        if not self._points or now_ns >= self._bucket_end_ns:
            self._bucket_end_ns = now_ns + BUCKET_NS
            if self._points:
                self._fit()
                d = now_ns - self._device(self._counted)
            self._points.append((self._counted, now_ns))
            if len(self._points) == 1:
                self._anchor = (t, d)
        elif d < self._points[-1][1] - self._device(self._points[-1][0]):
            self._points[-1] = (self._counted, now_ns)
        t = self._device(self._counted)
        if now_ns < self._map(t):
            self._anchor = (t, now_ns - t)

    def _bounded(self, stamp_ns: int, now_ns: int) -> int:
        """Return a mapped stamp, or where the fit cannot be right, what the arrival says."""
        if stamp_ns >= now_ns - LATE_NS:
            self._late_since_ns = None
            return stamp_ns
        if self._late_since_ns is None:
            self._late_since_ns = now_ns
        late_ns = now_ns - self._late_since_ns
        if self.is_measured and late_ns <= BURST_NS:
            return stamp_ns
        if late_ns > GIVE_UP_NS and self.is_measured:
            self._begin_with([point for point in self._points if point[1] > self._late_since_ns])
        return now_ns - LATE_NS

    def _begin_with(self, points: list[tuple[int, int]]) -> None:
        """Begin anew with the last points: the fit of those before no longer holds."""
        self.misfits += 1
        self._points = deque(points or [self._points[-1]], BUCKETS)
        self._late_since_ns = None
        self.is_measured = False
        self._rest_on_least()

    def _rest_on_least(self) -> None:
        self._slope = 0.0
        self._anchor = min(self._pairs(), key=lambda point: point[1])

    def _pairs(self) -> list[tuple[int, int]]:
        """Return device time and delay of the points."""
        return [(t, now - t) for t, now in ((self._device(count), now) for count, now in self._points)]

    def _measure(self) -> None:
        """Replace a rate that the device does not keep, and forget what came before it changed."""
        points = list(self._points)[-RATE_POINTS:]
        lately, ratio = points[-RATE_LATELY:], self._ratio(points)
        if len(lately) == RATE_LATELY < len(points):
            change = abs(self._ratio(lately) / ratio - 1)
            if change > 4 * RATE_TOLERANCE + RATE_JITTER_NS / (lately[-1][1] - lately[0][1]):
                self._begin_with(lately)
                points, ratio = lately, self._ratio(lately)
        span_ns = points[-1][1] - points[0][1]
        if span_ns < RATE_SPAN_NS or len(points) < 4:
            return
        self.is_measured = True
        if abs(ratio - 1) > RATE_TOLERANCE + RATE_JITTER_NS / span_ns:
            self._tick_ns *= ratio
            self._late_since_ns = None
            self._rest_on_least()

    def _ratio(self, points: list[tuple[int, int]]) -> float:
        """Return the duration of a count over the present one, by some points; 1 where the count stands still."""
        slopes = [
            (now - earlier) / ((count - before) * self._tick_ns)
            for (before, earlier), (count, now) in combinations(points, 2) if count > before
        ]  # fmt: skip
        return median(slopes) if slopes else 1.0

    def _fit(self) -> None:
        self._measure()
        everything = self._pairs()
        t0, d0 = min(everything, key=lambda point: point[1])
        points = [(t, d) for t, d in everything if d - d0 <= MAX_DRIFT * abs(t - t0) + STALL_NS]
        if points[-1][0] - points[0][0] < MIN_SPAN_NS:
            return
        hull = _lower_hull(points)
        mean_t = sum(t for t, _ in points) / len(points)
        self._anchor = hull[0]
        for left, right in pairwise(hull):
            self._anchor = left
            self._slope = max(-MAX_DRIFT, min(MAX_DRIFT, (right[1] - left[1]) / (right[0] - left[0])))
            if right[0] >= mean_t:
                break
        below = min(d - self._map_delay(t) for t, d in everything)
        if below < 0:
            self._anchor = (self._anchor[0], self._anchor[1] + round(below))

    def _map_delay(self, t: int) -> float:
        return self._anchor[1] + self._slope * (t - self._anchor[0])


def _lower_hull(points: list[tuple[int, int]]) -> list[tuple[int, int]]:
    """Return the lower convex hull of points sorted by t (Andrew's monotone chain)."""
    hull: list[tuple[int, int]] = []
    for p in points:
        while len(hull) > 1 and _turns_right(hull[-2], hull[-1], p):
            hull.pop()
        hull.append(p)
    return hull


def _turns_right(a: tuple[int, int], b: tuple[int, int], c: tuple[int, int]) -> bool:
    return (b[0] - a[0]) * (c[1] - a[1]) <= (b[1] - a[1]) * (c[0] - a[0])
