"""Maps the stamps of a device's clock to the host's clock by the least delay seen.

A sample stamped ``t`` by the device arrives at host time ``h = t + offset + drift t + delay`` with a
delay that is never negative and often near its least value. So the line that touches the points
(t, h - t) from below is the best estimate of offset and drift: of all lines under the points the one
nearest to them in the mean is the edge of their lower convex hull over the mean of t (Moon, Skelly
and Towsley, "Estimation and removal of clock skew from network delay measurements", INFOCOM 1999).
What remains unknown is the least delay itself, which a one-way stream cannot show.

The window is kept as the least point of each of the last buckets of device time, so memory and work are
bounded: a few operations a sample, one hull a bucket.
"""

from __future__ import annotations

from collections import deque
from itertools import pairwise

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


class ClockFit:
    """Running fit of one device clock that counts ticks and wraps.

    Args:
        tick_ns: duration of one count [ns].
        modulus: counts after which the clock starts again at 0.
    """

    def __init__(self, tick_ns: int = 1000, modulus: int = 1 << 32) -> None:
        self.restarts = 0
        self._mapped_ns: int = 0
        self._tick_ns, self._modulus = tick_ns, modulus
        self._reset()

    @property
    def drift(self) -> float:
        """Host time per device time minus one, as fitted."""
        return self._slope

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
        self._mapped_ns = max(min(self._map(device_ns), now_ns), self._mapped_ns)
        return self._mapped_ns

    def expect_anew(self) -> None:
        """Forget what was fitted: the device may have begun anew meanwhile. Mapped stamps still never go back."""
        self._reset()

    def _reset(self) -> None:
        self._points: deque[tuple[int, int]] = deque(maxlen=BUCKETS)
        self._bucket_end_ns = 0
        self._last_count = 0
        self._last_now_ns = 0
        self._device_ns = 0
        self._slope = 0.0
        self._anchor = (0, 0)

    def _unwrap(self, count: int, now_ns: int) -> int:
        """Return device time since the first stamp [ns], whole turns of the counter by the host's clock."""
        if self._points:
            step = (count - self._last_count) % self._modulus
            elapsed = (now_ns - self._last_now_ns) // self._tick_ns
            turns = max(0, round((elapsed - step) / self._modulus))
            self._device_ns += (step + turns * self._modulus) * self._tick_ns
        self._last_count, self._last_now_ns = count, now_ns
        return self._device_ns

    def _map(self, device_ns: int) -> int:
        t, d = self._anchor
        return device_ns + d + round(self._slope * (device_ns - t))

    def _add(self, t: int, now_ns: int) -> None:
        d = now_ns - t
        if not self._points or t >= self._bucket_end_ns:
            self._bucket_end_ns = t + BUCKET_NS
            if self._points:
                self._fit()
            self._points.append((t, d))
            if len(self._points) == 1:
                self._anchor = (t, d)
        elif d < self._points[-1][1]:
            self._points[-1] = (t, d)
        if now_ns < self._map(t):
            self._anchor = (t, d)

    def _fit(self) -> None:
        t0, d0 = min(self._points, key=lambda point: point[1])
        points = [(t, d) for t, d in self._points if d - d0 <= MAX_DRIFT * abs(t - t0) + STALL_NS]
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
        below = min(d - self._map_delay(t) for t, d in self._points)
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
