"""The clock of a device that stamps its samples: mapped to the host's, and told of when its rate is not the stated
one.
"""

from __future__ import annotations

from collections.abc import Mapping

from .codec.clock_fit import ClockFit
from .driver import Kit

TOLD_FROM = 0.01
"""A measured rate is told of when it differs by more than this from the stated one."""


class DeviceClock:
    """Maps a device's count to the host's time.

    Args:
        name: of the device.
        kit: for what is to be said.
        rate_hz: counts in a second, as stated [Hz].
        modulus: counts after which it starts again at 0.
        advice: what to do when the device keeps another rate; ``{hz}`` is that rate.

    Concurrency: the one thread of the driver process.
    """

    def __init__(self, name: str, kit: Kit, rate_hz: float, modulus: int, advice: str = "") -> None:
        self._name, self._kit, self._modulus, self._advice = name, kit, modulus, advice
        self._restarts = self._misfits = 0
        self._last_ns = 0
        self._told = 0.0
        self._rate_hz = rate_hz
        self._fit = ClockFit(1e9 / rate_hz, modulus)

    @property
    def rate_hz(self) -> float:
        """Counts in a second, as stated [Hz]."""
        return self._rate_hz

    @property
    def measured_hz(self) -> float:
        """Counts in a second as fitted, the stated ones until they are [Hz]."""
        return self._rate_hz / (1 + self._fit.drift)

    def state(self, rate_hz: float) -> None:
        """Take another rate as the stated one; begins anew when it differs."""
        if rate_hz != self._rate_hz:
            self._restarts, self._misfits = (
                self._restarts + self._fit.restarts,
                self._misfits + self._fit.misfits,
            )
            self._rate_hz, self._told = rate_hz, 0.0
            self._fit = ClockFit(1e9 / rate_hz, self._modulus)

    def expect_anew(self) -> None:
        """Forget the count: the device may have lost its power."""
        self._fit.expect_anew()

    def to_host(self, count: int, now_ns: int) -> int:
        """Return the time of a sample [ns, CLOCK_MONOTONIC]: never later than its arrival, nor
        earlier than the last.
        """
        fit = self._fit
        self._last_ns = max(fit.to_host(count, now_ns), self._last_ns)
        if fit.rate_error != self._told:
            self._tell(fit.rate_error)
        return self._last_ns

    def counters(self) -> Mapping[str, int | str]:
        """Return what is known of the clock, for GET_STATISTICS."""
        fit = self._fit
        return {
            "clock_restarts": self._restarts + fit.restarts, "clock_misfits": self._misfits + fit.misfits,
            "clock_ppm": round(1e6 * fit.drift), "stamp_uncertainty_us": fit.uncertainty_ns // 1000,
        }  # fmt: skip

    def _tell(self, error: float) -> None:
        """Log a rate once; one that is measured better is no news."""
        if abs(error) > TOLD_FROM and abs(error - self._told) > TOLD_FROM:
            hz = self._rate_hz / (1 + error)
            text = (
                f"{self._name}: the device counts {hz:.0f} a second, not {self._rate_hz:g}; stamps follow what it "
                "counts"
            )
            self._kit.log("warning", text + (self._advice and "; " + self._advice.format(hz=f"{hz:.0f}")))
        self._told = error
