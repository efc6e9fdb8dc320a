"""Draw axes, hidden effects and commands at random. All numbers SI; a draw is reproducible by its seed."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
SAMPLE_S = 1e-3

#: What may be confounded with what under which poor excitation.
CONFOUNDED = {
    "cruise": ("coulomb", "viscous"),
    "oneway": ("coulomb", "offset"),
    "small": ("gravity", "offset"),
}
NAMED = (
    "viscous",
    "coulomb",
    "stribeck",
    "backlash",
    "cogging",
    "torque_ripple",
    "gravity",
    "offset",
    "delay",
    "saturation",
    "elastic",
    "encoder_scale",
    "encoder_quantisation",
    "thermal_gain",
    "payload",
)
NAMELESS = ("cubic_spring", "falling_drag", "hysteresis", "swinging_inertia", "knocks")
MIXABLE = ("viscous", "coulomb", "stribeck", "cogging", "gravity", "offset", "delay", "payload", "elastic")


@dataclass(frozen=True, slots=True)
class Axis:
    """One axis and what it hides.

    Attributes:
        kind: null, single, multi, confounded or unknown.
        named, nameless: hidden effects with their parameters.
        rival: the look-alike of a confounded effect.
    """

    name: str
    kind: str
    rotary: bool
    inertia: float
    viscous: float
    rated: float
    speed: float
    resolution: float
    pitch: float
    gains: tuple[float, float, float, float, float]  # k, kz, kp, kb, limit
    excitation: str
    named: dict[str, dict[str, float]] = field(default_factory=dict)
    nameless: dict[str, dict[str, float]] = field(default_factory=dict)
    rival: str = ""

    def public(self) -> dict[str, object]:
        """Return what the solver may know."""
        k, kz, kp, kb, limit = self.gains
        return {
            "axis": {
                "name": self.name,
                "kind": "rotary" if self.rotary else "linear",
                "sample_time_s": SAMPLE_S,
                "inertia": self.inertia,
                "viscous": self.viscous,
                "resolution": self.resolution,
                "pitch": self.pitch,
                "rated_force": self.rated,
                "max_speed": self.speed,
            },
            "controller": {
                "k": k,
                "kz": kz,
                "kp": kp,
                "kb": kb,
                "offset": 0.0,
                "limit": limit,
                "velocity_filter_hz": 0.0,
            },
        }


def draw_axis(name: str, kind: str, rng: np.random.Generator, only: str = "") -> Axis:
    """Draw one axis of a kind; ``only`` asks for a certain effect (single) or excitation (confounded)."""
    excitation = "full"
    if kind == "confounded":
        excitation = only or str(rng.choice(list(CONFOUNDED)))
    needs_turn = excitation == "small" or only in ("gravity", "swinging_inertia")
    rotary = bool(needs_turn or rng.random() < 0.6)
    base = _plant(name, kind, rotary, excitation, rng)
    named: dict[str, dict[str, float]] = {}
    nameless: dict[str, dict[str, float]] = {}
    rival = ""
    if kind == "single":
        pick = only or str(rng.choice(NAMED))
        if pick == "gravity" and not rotary:
            pick = "offset"
        named[pick] = _effect(pick, base, rng)
    elif kind == "multi":
        for pick in _mixture(rotary, int(rng.integers(2, 4)), rng):
            named[pick] = _effect(pick, base, rng)
    elif kind == "confounded":
        pair = list(CONFOUNDED[excitation])
        rng.shuffle(pair)
        named[pair[0]], rival = _effect(pair[0], base, rng), pair[1]
        if pair[0] == "gravity":  # near the horizontal, where a little travel does not show its slope
            drawn = named["gravity"]["phase"]
            named["gravity"]["phase"] = float(
                np.copysign(0.5 * np.pi + 0.2 * (abs(drawn) - 0.5 * np.pi), drawn)
            )
        if (
            excitation == "oneway" and pair[0] == "offset"
        ):  # a force along with the motion is no friction, whatever is recorded
            named["offset"]["off"] = -abs(named["offset"]["off"])
    elif kind == "unknown":
        pick = only or str(
            rng.choice(NAMELESS if rotary else [n for n in NAMELESS if n != "swinging_inertia"])
        )
        nameless[pick] = _effect(pick, base, rng)
        if rng.random() < 0.4 and pick in ("cubic_spring", "falling_drag"):
            named["coulomb"] = _effect("coulomb", base, rng)
    return Axis(**{**base, "named": named, "nameless": nameless, "rival": rival})  # type: ignore[arg-type]


def _plant(
    name: str, kind: str, rotary: bool, excitation: str, rng: np.random.Generator
) -> dict[str, object]:
    if rotary:
        inertia, acceleration = 10 ** rng.uniform(-3.2, -2.0), rng.uniform(250, 500)
        speed, pitch = rng.uniform(12, 30), 2.0 * np.pi
        resolution = pitch / float(rng.choice([8192, 16384, 65536]))
    else:
        inertia, acceleration = rng.uniform(2, 25), rng.uniform(4, 9)
        speed, pitch = rng.uniform(0.15, 0.4), float(rng.choice([0.005, 0.01, 0.02]))
        resolution = float(rng.choice([5e-8, 1e-7, 5e-7]))
    rated = inertia * acceleration
    viscous = float(rng.uniform(0.004, 0.03)) * rated / speed
    # lead-lag position loop: phase lead around the crossover w
    w = 2.0 * np.pi * rng.uniform(7.0, 14.0)
    zero, pole = w / 3.0, 3.5 * w
    kz, kp = -np.exp(-zero * SAMPLE_S), -np.exp(-pole * SAMPLE_S)
    # |C(jw)| |1 / (J w^2)| = 1
    z = np.exp(1j * w * SAMPLE_S)
    k = inertia * w**2 * abs((1.0 + kp / z) / (1.0 + kz / z))
    return {
        "name": name,
        "kind": kind,
        "rotary": rotary,
        "inertia": float(inertia),
        "viscous": viscous,
        "rated": float(rated),
        "speed": float(speed),
        "resolution": resolution,
        "pitch": pitch,
        "gains": (float(k), float(kz), float(kp), 0.0, 2.5 * float(rated)),
        "excitation": excitation,
    }


def _mixture(rotary: bool, count: int, rng: np.random.Generator) -> list[str]:
    pool = [n for n in MIXABLE if rotary or n != "gravity"]
    picks = [str(p) for p in rng.choice(pool, count, replace=False)]
    return picks if not {"coulomb", "stribeck"} <= set(picks) else _mixture(rotary, count, rng)


def _effect(name: str, base: dict[str, object], rng: np.random.Generator) -> dict[str, float]:
    """Draw the size of an effect, clear of the noise and within what machines show."""
    f, v, j, x = (float(base[k]) for k in ("rated", "speed", "inertia", "pitch"))  # type: ignore[arg-type]
    u = rng.uniform
    phase = float(u(-np.pi, np.pi))
    fc = f * float(u(0.06, 0.2))
    table: dict[str, dict[str, float]] = {
        "viscous": {"b_extra": f / v * float(u(0.08, 0.4))},
        "coulomb": {"Fc": fc},
        "stribeck": {"Fc": fc, "Fs": fc * float(u(1.6, 2.4)), "vs": v * float(u(0.015, 0.05))},
        "backlash": {
            "gap": x * float(u(0.004, 0.01)) if x > 1 else 1e-4 * float(u(1.0, 4.0)),
            "load_fraction": float(u(0.4, 0.6)),
        },
        "cogging": {"amp": f * float(u(0.06, 0.14)), "n": float(rng.integers(4, 25)), "phase": phase},
        "torque_ripple": {"depth": float(u(0.08, 0.2)), "n": float(rng.integers(4, 13)), "phase": phase},
        "gravity": {"amp": f * float(u(0.08, 0.3)), "phase": phase},
        "offset": {"off": f * float(u(0.04, 0.12)) * float(rng.choice([-1, 1]))},
        "delay": {"delay": float(u(1.5e-3, 5e-3))},
        "saturation": {"limit": f * float(u(0.4, 0.52))},  # the commands ask for 0.55 and more
        "elastic": {
            "f_res": float(u(14, 28)),
            "load_fraction": float(u(0.35, 0.6)),
            "zeta": float(u(0.03, 0.08)),
        },
        "encoder_scale": {"gain": 1.0 + float(u(0.012, 0.03)) * float(rng.choice([-1, 1]))},
        "encoder_quantisation": {"factor": float(rng.choice([16, 32, 64]))},
        "thermal_gain": {"loss": float(u(0.7, 1.2)), "tau": float(u(5, 12))},
        "payload": {"J_extra": j * float(u(0.12, 0.5))},
        "cubic_spring": {"k": 0.25 * f / ((2.0 * x) ** 3 if x > 1 else 0.1**3) * float(u(0.7, 1.5))},
        "falling_drag": {"c": 2.0 * f * float(u(0.08, 0.16)) / (v * 0.18), "v0": 0.18 * v},
        "hysteresis": {
            "level": f * float(u(0.08, 0.16)),
            "length": x * float(u(0.03, 0.07)) if x > 1 else 4e-3 * float(u(0.7, 1.5)),
        },
        "swinging_inertia": {"depth": float(u(0.2, 0.35)), "n": float(rng.integers(1, 4)), "phase": phase},
        "knocks": {"height": f * float(u(0.4, 0.8)), "count": 6.0},
    }
    return table[name]


def commands(axis: Axis, seconds: float, rng: np.random.Generator) -> list[Array]:
    """Draw the position commands of the four records, each starting where the axis is at rest: at zero."""
    t: Array = np.arange(int(seconds / SAMPLE_S), dtype=np.float64) * SAMPLE_S
    a = 0.45 * axis.rated / axis.inertia
    reach = 3.0 * np.pi if axis.rotary else 0.12
    if axis.excitation == "cruise":
        v = 0.35 * axis.speed
        return [_profile(t, np.where(np.sin(2 * np.pi * t / 4.0) >= 0, v, -v), a) for _ in range(4)]
    if axis.excitation == "oneway":
        return [
            np.cumsum(
                0.4
                * axis.speed
                * (
                    1.0
                    + 0.5
                    * np.sin(
                        2 * np.pi * np.cumsum(rng.uniform(0.5, 2.0, len(t))) * SAMPLE_S + rng.uniform(0, 6)
                    )
                )
                * np.minimum(t / 0.15, 1.0)
            )
            * SAMPLE_S
            for _ in range(4)
        ]
    if axis.excitation == "small":
        return [_waves(t, 0.2, 0.3 * axis.speed, rng) for _ in range(4)]
    slow = 0.05 * axis.speed
    legs = rng.uniform(0.3, 0.9, 24)
    signs = np.where(np.arange(24) % 2 == 0, 1.0, -1.0)
    steps = np.repeat(signs * rng.choice([0.0, 1.0, 1.0], 24), (legs * 1000).astype(int))[: len(t)]
    ladder = np.repeat(np.array([0.2, -0.35, 0.6, -0.8, 0.95, -0.15, 0.45, -0.6]), len(t) // 8 + 1)[: len(t)]
    return [
        _fold(_profile(t, steps * 0.8 * axis.speed, a), reach),
        _waves(t, 0.6 * reach, 0.9 * axis.speed, rng),
        _profile(
            t, slow * np.sign(np.sin(2 * np.pi * t / 2.2 + 0.1)) * np.where(t < 0.6 * t[-1], 1.0, 0.4), a
        ),
        _fold(_profile(t, ladder * axis.speed, a), reach),
    ]


def _profile(t: Array, speed: Array, acceleration: float) -> Array:
    """Follow a speed with limited acceleration."""
    v, out = 0.0, np.empty_like(t)
    step = acceleration * SAMPLE_S
    for i, goal in enumerate(speed):
        v += min(max(goal - v, -step), step)
        out[i] = v
    return np.asarray(np.cumsum(out) * SAMPLE_S)


def _fold(x: Array, reach: float) -> Array:
    """Shrink a path that leaves the range."""
    top = float(np.max(np.abs(x)))
    return x if top <= 2.0 * reach else x * 2.0 * reach / top


def _waves(t: Array, reach: float, speed: float, rng: np.random.Generator) -> Array:
    f = rng.uniform(0.4, 6.0, 7)
    x = np.sum(np.sin(2 * np.pi * f[:, None] * t + rng.uniform(0, 6.28, 7)[:, None]) / f[:, None], axis=0)
    x = (x - x[0]) * np.minimum(t / 0.3, 1.0) ** 2
    top = np.max(np.abs(np.gradient(x, SAMPLE_S)))
    return np.asarray(x * min(speed / top, reach / np.max(np.abs(x))))
