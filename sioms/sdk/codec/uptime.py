"""Restarts of a device, told by its time since the last one. Pure."""

from __future__ import annotations

RENEWED_NS = 10_000_000_000
"""A reading serves as the reference for so long; then the drift of the two clocks would tell."""
SLACK_S = 0.2
"""So much may the device's figure lag behind its clock [s]."""
DRIFT = 0.01


class Uptime:
    """Compares a device's time since its start with the host's clock.

    A device that has started anew, and one whose answers stand still, show less time than has passed. The figure was
    valid at some instant between the request and its reply, so that a host that is late is never taken for a restart.

    Args:
        unit_s: of the figure [s].
        wraps: value at which the device's counter begins anew.
        digits: digits of which it shows the first ones; 0 = all of them.
    """

    def __init__(self, unit_s: float, wraps: int, digits: int = 0) -> None:
        self._unit_s, self._wraps, self._digits = unit_s, wraps, digits
        self._reference: tuple[int, int, int] | None = None

    def forget(self) -> None:
        """Take the next figure as it is."""
        self._reference = None

    def judge(self, asked_ns: int, heard_ns: int, figure: int) -> str:
        """Return "", or how the figure contradicts the time that has passed.

        Args:
            asked_ns, heard_ns: when the request went out and when its reply was taken [ns].
            figure: what the device shows.
        """
        if self._reference is None:
            self._reference = asked_ns, heard_ns, figure
            return ""
        was_asked_ns, was_heard_ns, before = self._reference
        least_s = (asked_ns - was_heard_ns) / 1e9 * (1 - DRIFT) - SLACK_S
        most_s = (heard_ns - was_asked_ns) / 1e9 * (1 + DRIFT) + SLACK_S
        for value in self._meant(figure):
            # of a counter that is read ten times coarser, before and after
            if any(least_s <= self._passed_s(value, begin) <= most_s for begin in self._meant(before)):
                if heard_ns - was_heard_ns > RENEWED_NS:
                    self._reference = asked_ns, heard_ns, figure
                return ""
        passed_s, unit_s = (heard_ns - was_heard_ns) / 1e9, self._unit_s
        return f"its time since the start was {before * unit_s:g} s, and {passed_s:.3g} s later {figure * unit_s:g} s"

    def _passed_s(self, value: int, before: int) -> float:
        half = self._wraps // 2
        return ((value - before + half) % self._wraps - half) * self._unit_s

    def _meant(self, figure: int) -> list[int]:
        """Return the values that a figure of which the last digit may be missing can mean."""
        if self._digits and figure >= 10 ** (self._digits - 1) and 10 * figure < self._wraps:
            return [figure, 10 * figure + 5]
        return [figure]
