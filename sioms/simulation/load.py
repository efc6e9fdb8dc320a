"""What presses on a simulated force/torque sensor: six components, noise, a bias, and a range that it leaves when
overloaded.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

COMPONENTS = 6
_ZERO = (0.0,) * COMPONENTS


@dataclass
class Load:
    """A load that may ramp; times in seconds of the caller's clock.

    Args:
        range_n, range_nm: the sensor's full scale [N], [N m].
        noise_n, noise_nm: standard deviations.
        seed: of the noise.
    """

    range_n: float = 300.0
    range_nm: float = 30.0
    noise_n: float = 0.05
    noise_nm: float = 0.002
    seed: int = 1
    _low: Sequence[float] = _ZERO
    _high: Sequence[float] = _ZERO
    _start_s: float = 0.0
    _duration_s: float = 0.0
    _zero: Sequence[float] = _ZERO
    _chance: random.Random = field(init=False)

    def __post_init__(self) -> None:
        self._chance = random.Random(self.seed)

    def put(self, now_s: float, components: Sequence[float], duration_s: float = 0.0) -> None:
        """Go from the present load to another within a time."""
        if len(components) != COMPONENTS:
            raise ValueError(f"{len(components)} components; 6 are right: fx fy fz [N] tx ty tz [N m]")
        self._low, self._high = self.true(now_s), tuple(components)
        self._start_s, self._duration_s = now_s, duration_s

    def true(self, now_s: float) -> list[float]:
        """Return the load itself [N], [N m]."""
        done = 1.0
        if self._duration_s > 0:
            done = min(1.0, max(0.0, (now_s - self._start_s) / self._duration_s))
        return [low + (high - low) * done for low, high in zip(self._low, self._high, strict=True)]

    def zero(self, now_s: float | None) -> None:
        """Take the present load as zero, or go back to the factory's (None)."""
        self._zero = _ZERO if now_s is None else self.true(now_s)

    def measured(self, now_s: float) -> tuple[list[float], bool]:
        """Return what the sensor measures, clipped at its range and counted from its zero, and whether it clipped."""
        values, clipped = [], False
        for i, true in enumerate(self.true(now_s)):
            top, noise = (self.range_n, self.noise_n) if i < 3 else (self.range_nm, self.noise_nm)
            raw = true + self._chance.gauss(0.0, noise)
            clipped |= abs(raw) > top
            values.append(min(max(raw, -top), top) - self._zero[i])
        return values, clipped

    def handlers(self, clock: Callable[[], float]) -> dict[str, Callable[..., object]]:
        """Return the command ``load FX FY FZ TX TY TZ [SECONDS]``; without numbers it takes the load away."""

        def load(*words: str) -> None:
            numbers = [float(word) for word in words] or list(_ZERO)
            self.put(clock(), numbers[:COMPONENTS], *numbers[COMPONENTS : COMPONENTS + 1])

        return {"load": load}
