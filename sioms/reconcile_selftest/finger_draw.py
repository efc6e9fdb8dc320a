"""Draw fingers and what they hide at random. All numbers SI; a draw is reproducible by its seed."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

NAMED = (
    "gain_scatter",
    "depth_scatter",
    "angle_scatter",
    "angle_offset",
    "poisson",
    "quadratic",
    "temperature_drift",
    "creep",
    "proximity",
    "strip_inhomogeneity",
    "strip_peak",
    "adhesion",
    "sliding_friction",
    "mains_line",
    "cross_talk",
    "dead_element",
    "force_gain",
)
NAMELESS = ("cubic", "ageing", "warm_gain", "knocks")
MIXABLE = (
    "gain_scatter",
    "depth_scatter",
    "angle_scatter",
    "poisson",
    "quadratic",
    "temperature_drift",
    "creep",
    "proximity",
    "strip_inhomogeneity",
    "strip_peak",
    "adhesion",
    "mains_line",
    "force_gain",
)


@dataclass(frozen=True, slots=True)
class HiddenFinger:
    """One finger and what it hides.

    Attributes:
        kind: null, single, multi, confounded or unknown.
        named, nameless: hidden effects with their parameters; values of elements are arrays.
        rival: the confounder of a confounded effect.
        one_place: all touches are made at one place.
    """

    name: str
    kind: str
    core: float
    outer: float
    poisson: float
    angle: Array
    radius: float
    gain: float
    extent: float
    noise: float
    step: float
    named: dict[str, dict[str, Array]] = field(default_factory=dict)
    nameless: dict[str, dict[str, float]] = field(default_factory=dict)
    rival: str = ""
    one_place: bool = False

    def public(self) -> str:
        """Return what the solver may know: a model file."""
        angles = ", ".join(repr(float(a)) for a in self.angle)
        return (
            f'[finger]\nname = "{self.name}"\ncore_m = {self.core!r}\nouter_m = {self.outer!r}\nshear_modulus_pa = '
            "83000.0\n"
            f"poisson = {self.poisson!r}\nangle_rad = [{angles}]\nradius_m = {self.radius!r}\ngain = {self.gain!r}\n"
        )


def draw_finger(name: str, kind: str, rng: np.random.Generator, only: str = "") -> HiddenFinger:
    """Draw one finger of a kind; ``only`` asks for a certain effect."""
    u = rng.uniform
    count = int(rng.choice([12, 14, 16]))
    pitch = np.radians(float(u(8.6, 10.0)))
    outer = float(u(12.2e-3, 13.2e-3))
    core = outer - float(u(2.8e-3, 3.5e-3))
    base = {
        "name": name,
        "kind": kind,
        "core": core,
        "outer": outer,
        "poisson": float(rng.choice([0.45, 0.46, 0.47])),
        "angle": np.radians(75.0) + pitch * (0.5 * (count - 1) - np.arange(count)),
        "radius": core + float(u(0.6e-3, 0.9e-3)),
        "gain": float(u(2.0, 4.0)),
        "extent": float(u(0.02, 0.06)),
        "noise": float(u(3e-4, 7e-4)),
        "step": float(rng.choice([1e-4, 5e-4])),
    }
    named: dict[str, dict[str, Array]] = {}
    nameless: dict[str, dict[str, float]] = {}
    rival, one_place = "", False
    if kind == "single":
        pick = only or str(rng.choice(NAMED))
        named[pick] = _effect(pick, count, rng)
    elif kind == "multi":
        for pick in _mixture(int(rng.integers(2, 4)), rng):
            named[pick] = _effect(pick, count, rng)
    elif kind == "confounded":
        pair = ["gain_scatter", "depth_scatter"]
        rng.shuffle(pair)
        named[pair[0]], rival, one_place = _effect(pair[0], count, rng), pair[1], True
    elif kind == "unknown":
        pick = only or str(rng.choice(NAMELESS))
        nameless[pick] = _nameless(pick, rng)
        if rng.random() < 0.4 and pick != "knocks":
            named["gain_scatter"] = _effect("gain_scatter", count, rng)
    return HiddenFinger(**base, named=named, nameless=nameless, rival=rival, one_place=one_place)


def _mixture(count: int, rng: np.random.Generator) -> list[str]:
    return [str(p) for p in rng.choice(MIXABLE, count, replace=False)]


def _effect(name: str, count: int, rng: np.random.Generator) -> dict[str, Array]:
    """Draw the size of an effect, clear of the noise and within what fingers show."""
    u, n = rng.uniform, rng.standard_normal
    sign = float(rng.choice([-1.0, 1.0]))

    def one(value: float) -> Array:
        return np.array([value])

    table: dict[str, dict[str, Array]] = {
        "gain_scatter": {"g": float(u(0.05, 0.15)) * np.clip(n(count), -2, 2)},
        "depth_scatter": {"dr": float(u(0.08e-3, 0.18e-3)) * np.clip(n(count), -2, 2)},
        "angle_scatter": {"dt": np.radians(float(u(0.3, 0.8))) * np.clip(n(count), -2, 2)},
        "angle_offset": {"off": one(sign * np.radians(float(u(0.3, 1.2))))},
        "poisson": {"dnu": one(-float(u(0.02, 0.06)))},
        "quadratic": {"q": sign * float(u(3.0, 6.0)) * (1.0 + 0.3 * n(count))},
        "temperature_drift": {"k": one(sign * float(u(2e-3, 1e-2)))},
        "creep": {"c": one(float(u(0.08, 0.22))), "tau": one(float(u(0.4, 1.2)))},
        "proximity": {"A": one(-float(u(0.008, 0.04))), "range": one(float(u(0.15, 0.4)))},
        "strip_inhomogeneity": {
            "G": one(float(u(0.03, 0.07))),
            "period": one(2 * np.pi / float(rng.integers(28, 48))),
            "phase": one(float(u(-3, 3))),
        },
        "strip_peak": {"c": one(sign * float(u(0.06, 0.15))), "width": one(float(u(0.05, 0.12)))},
        "adhesion": {"share": one(float(u(0.4, 0.9)))},
        "sliding_friction": {"f": one(sign * float(u(0.15, 0.6)))},
        "mains_line": {
            "a": one(float(u(1e-3, 3e-3))),
            "f": one(float(rng.choice([50.0, 60.0, 100.0, 120.0])) * float(u(0.999, 1.001))),
        },
        "cross_talk": {"x": one(float(u(0.02, 0.06)))},
        "dead_element": {"index": one(float(rng.integers(2, count - 2)))},
        "force_gain": {"g": one(sign * float(u(0.06, 0.2)))},
    }
    return table[name]


def _nameless(name: str, rng: np.random.Generator) -> dict[str, float]:
    u = rng.uniform
    table = {
        "cubic": {"k": float(rng.choice([-1.0, 1.0])) * float(u(40.0, 80.0))},
        "ageing": {"share": -float(u(0.08, 0.2))},
        "warm_gain": {"k": float(rng.choice([-1.0, 1.0])) * float(u(0.05, 0.1))},
        "knocks": {"height": float(u(0.01, 0.03))},
    }
    return table[name]
