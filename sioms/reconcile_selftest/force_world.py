"""Force/torque sensors with hidden effects: drawn, loaded with known weights, and read. Nothing is shared with the
solver.

Hysteresis is a handful of springs with dry friction in parallel (Iwan's model), not the solver's single play.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

NAMED = ("gain", "cross_talk", "quadratic", "offset_drift", "hysteresis", "temperature")
NAMELESS = ("cubic", "settling", "fading", "knocks")
CONFOUNDED = {"warming": ("offset_drift", "temperature"), "one_way": ("gain", "cross_talk")}
COMPONENTS = ("fx", "fy", "fz", "tx", "ty", "tz")


@dataclass(frozen=True, slots=True)
class HiddenSensor:
    """One sensor and what it hides; sizes are shares of full range. ``excitation``: full, warming or one_way."""

    name: str
    kind: str
    full: Array
    noise: Array
    excitation: str = "full"
    named: dict[str, dict[str, Array]] = field(default_factory=dict)
    nameless: dict[str, dict[str, float]] = field(default_factory=dict)
    rival: str = ""

    def public(self) -> str:
        """Return what the solver may know: a model file."""
        names = ", ".join(f'"{n}"' for n in COMPONENTS)
        full = ", ".join(repr(float(v)) for v in self.full)
        return f'[sensor]\nname = "{self.name}"\ncomponents = [{names}]\nfull_range = [{full}]\n'


def draw_sensor(name: str, kind: str, rng: np.random.Generator, only: str = "") -> HiddenSensor:
    """Draw one sensor of a kind; ``only`` asks for a certain effect or excitation."""
    force, arm = float(10 ** rng.uniform(1.3, 2.7)), float(rng.uniform(0.03, 0.08))
    full = np.array([force, force, 2.0 * force, force * arm, force * arm, force * arm])
    noise = rng.uniform(2e-4, 6e-4, 6)
    named: dict[str, dict[str, Array]] = {}
    nameless: dict[str, dict[str, float]] = {}
    rival, excitation = "", "full"
    if kind == "single":
        pick = only or str(rng.choice(NAMED))
        named[pick] = _effect(pick, rng)
    elif kind == "multi":
        for pick in rng.choice(NAMED, int(rng.integers(2, 4)), replace=False):
            named[str(pick)] = _effect(str(pick), rng)
    elif kind == "confounded":
        excitation = only or str(rng.choice(list(CONFOUNDED)))
        pair = list(CONFOUNDED[excitation])
        rng.shuffle(pair)
        named[pair[0]], rival = _effect(pair[0], rng), pair[1]
    elif kind == "unknown":
        pick = only or str(rng.choice(NAMELESS))
        nameless[pick] = _nameless(pick, rng)
        if rng.random() < 0.4 and pick != "knocks":
            named["cross_talk"] = _effect("cross_talk", rng)
    return HiddenSensor(name, kind, full, noise, excitation, named, nameless, rival)


def _effect(name: str, rng: np.random.Generator) -> dict[str, Array]:
    n = np.clip(rng.standard_normal((6, 6)), -2.0, 2.0)
    table = {
        "gain": {"g": float(rng.uniform(0.01, 0.03)) * n[0]},
        "cross_talk": {"x": float(rng.uniform(0.008, 0.02)) * n * (1.0 - np.eye(6))},
        "quadratic": {"q": float(rng.uniform(0.005, 0.015)) * np.sign(n[0]) * rng.uniform(0.4, 1.5, 6)},
        "offset_drift": {"d": float(rng.uniform(1e-5, 4e-5)) * n[0]},
        "hysteresis": {
            "b": float(rng.uniform(0.004, 0.01)) * rng.uniform(0.6, 1.4, 6),
            "r": np.array([rng.uniform(0.05, 0.15)]),
        },
        "temperature": {"k": float(rng.uniform(1.5e-3, 4e-3)) * n[0]},
    }
    return table[name]


def _nameless(name: str, rng: np.random.Generator) -> dict[str, float]:
    sign = float(rng.choice([-1.0, 1.0]))
    table = {
        "cubic": {"k": sign * float(rng.uniform(0.02, 0.05))},
        "settling": {"d": sign * float(rng.uniform(0.01, 0.03)), "tau": float(rng.uniform(30.0, 90.0))},
        "fading": {"k": -float(rng.uniform(0.05, 0.12))},
        "knocks": {"height": float(rng.uniform(0.05, 0.15))},
    }
    return table[name]


def record(s: HiddenSensor, rng: np.random.Generator) -> dict[str, Array]:
    """Apply known loads and read; columns in N, N m, s and deg C."""
    load = _programme(s, rng)
    n = len(load)
    time = np.arange(n, dtype=np.float64)
    swing = 1.5 * np.sin(2 * np.pi * time / (0.37 * n) + float(rng.uniform(0, 6))) + 0.6 * np.sin(
        2 * np.pi * time / (0.11 * n)
    )
    warm = 2.5 * time / n if s.excitation == "warming" else swing
    out = load * (1.0 + _get(s, "gain", "g")) + load @ _get(s, "cross_talk", "x", np.zeros((6, 6))).T
    out = (
        out
        + _get(s, "quadratic", "q") * load**2
        + np.outer(time, _get(s, "offset_drift", "d"))
        + np.outer(warm, _get(s, "temperature", "k"))
    )
    if "hysteresis" in s.named:
        e = s.named["hysteresis"]
        out = out - e["b"] * _friction(load, float(e["r"][0]))
    if "cubic" in s.nameless:
        out = out + s.nameless["cubic"]["k"] * load**3
    if "settling" in s.nameless:
        e_ = s.nameless["settling"]
        out = out - e_["d"] * np.expm1(-time / e_["tau"])[:, None]
    if "fading" in s.nameless:
        out = out * (1.0 + s.nameless["fading"]["k"] * time / n)[:, None]
    if "knocks" in s.nameless:
        hit = rng.choice(n, n // 40, replace=False)
        out[hit] += s.nameless["knocks"]["height"] * rng.standard_normal((len(hit), 6))
    out = out + 0.01 * rng.standard_normal(6) + s.noise * rng.standard_normal(out.shape)
    columns: dict[str, Array] = {"t": time, "temp": 23.0 + warm + 0.01 * rng.standard_normal(n)}
    for i, name in enumerate(COMPONENTS):
        columns[f"load_{name}"], columns[name] = load[:, i] * s.full[i], out[:, i] * s.full[i]
    return columns


def _get(s: HiddenSensor, effect: str, symbol: str, nothing: Array | None = None) -> Array:
    if effect in s.named:
        return s.named[effect][symbol]
    return np.zeros(6) if nothing is None else nothing


def _friction(load: Array, reach: float) -> Array:
    """Return the force of springs with dry friction in parallel that give way one after the other up to ``reach``, at
    most 1.
    """
    limits = reach * (np.arange(6) + 0.5) / 6.0
    state = np.zeros((6, load.shape[1]))
    out = np.zeros_like(load)
    before = load[0]
    for i in range(len(load)):
        state = np.clip(state + load[i] - before, -limits[:, None], limits[:, None])
        before = load[i]
        out[i] = (state / limits[:, None]).mean(0)
    return out


def _programme(s: HiddenSensor, rng: np.random.Generator) -> Array:
    """Weights hung on one after the other, then arms and pulleys in any direction."""
    up = np.concatenate([np.linspace(0, 1, 8), np.linspace(0.86, -1, 14), np.linspace(-0.86, 0, 7), np.zeros(3)])
    if s.excitation == "one_way":
        way = rng.uniform(0.3, 0.8, 6) * rng.choice([-1.0, 1.0], 6)
        size = np.repeat(np.tile(0.9 * up, 6), 3)
        return np.asarray(np.outer(size, way))
    alone = np.concatenate([np.repeat(np.outer(0.8 * up, np.eye(6)[i]), 2, axis=0) for i in range(6)])
    free = np.cumsum(0.08 * rng.standard_normal((240, 6)), axis=0)
    free = np.clip(free - free[0], -0.9, 0.9) * np.minimum(np.arange(240)[::-1, None] / 30.0, 1.0)
    return np.concatenate([alone, np.repeat(free, 2, axis=0)])
