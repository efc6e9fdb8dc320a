"""What a hidden axis is, and what of it the solver may know. All numbers SI; nothing here draws or computes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Numbers = dict[str, float]


class Servo(NamedTuple):
    """Sampled controller: u = clip(k (e + kz e1) - kp u1 + kb v, +-limit).

    v is the first difference of position through one pole at ``filter_hz`` (0: none), or, with ``mean``, half of that
    over two samples.
    """

    k: float
    kz: float
    kp: float
    kb: float
    limit: float
    filter_hz: float = 0.0
    mean: bool = False


@dataclass(frozen=True, slots=True)
class Axis:
    """One axis and what it hides.

    Attributes:
        kind: null, single, multi, confounded, unknown or near.
        current, marks: whether the drive's current and index marks are recorded.
        seed: of its commands and noise.
        named, nameless: hidden effects with their parameters.
        rival: the confounder of a confounded effect.
    """

    name: str
    kind: str
    rotary: bool
    sample_s: float
    inertia: float
    viscous: float
    rated: float
    speed: float
    resolution: float
    pitch: float
    servo: Servo
    excitation: str
    current: bool
    marks: bool
    seed: int
    named: Mapping[str, Numbers] = field(default_factory=dict)
    nameless: Mapping[str, Numbers] = field(default_factory=dict)
    rival: str = ""

    @property
    def hidden(self) -> dict[str, Numbers]:
        """Everything that it hides."""
        return {**self.named, **self.nameless}

    def rng(self, purpose: int) -> np.random.Generator:
        """Return the random numbers of a purpose, the same whenever asked for."""
        return np.random.default_rng([self.seed, purpose])

    def public(self) -> dict[str, dict[str, object]]:
        """Return what the solver may know."""
        servo = self.servo
        return {
            "axis": {
                "name": self.name,
                "kind": "rotary" if self.rotary else "linear",
                "sample_time_s": self.sample_s,
                "inertia": self.inertia,
                "viscous": self.viscous,
                "resolution": self.resolution,
                "pitch": self.pitch,
                "rated_force": self.rated,
                "max_speed": self.speed,
            },
            "controller": {
                "k": servo.k,
                "kz": servo.kz,
                "kp": servo.kp,
                "kb": servo.kb,
                "offset": 0.0,
                "limit": servo.limit,
                "velocity_filter_hz": servo.filter_hz,
                "velocity_mean": servo.mean,
            },
        }
