"""Nameless terms: what a refusal may offer for a finger when no effect of the library explains the touches."""

from __future__ import annotations

import numpy as np

from sioms.reconcile.effect import TERM_PREFIX
from sioms.reconcile.finger.belief import Scene
from sioms.reconcile.finger.pressures import Floats
from sioms.reconcile.sensors.effect import Quantity, term

_LOAD = 200.0


def cubed(output: Floats, scene: Scene, p: Floats) -> Floats:
    """Add k d^3."""
    out: Floats = output + p[0] * output**3
    return out


def bent(output: Floats, scene: Scene, p: Floats) -> Floats:
    """Take off c of what is beyond s."""
    out: Floats = output - p[0] * np.maximum(output - p[1], 0.0)
    return out


def fading(output: Floats, scene: Scene, p: Floats) -> Floats:
    """Multiply by 1 + c + k (t - mean t): as it was when the gains were stated is not known."""
    out: Floats = output * (1.0 + p[1] + p[0] * scene.time)[:, None]
    return out


def warming(output: Floats, scene: Scene, p: Floats) -> Floats:
    """Multiply by 1 + c + k (T - mean T): at what temperature the gains were stated is not known."""
    out: Floats = output * (1.0 + p[1] + p[0] * scene.temperature)[:, None]
    return out


def rising(output: Floats, scene: Scene, p: Floats) -> Floats:
    """Multiply by 1 + c + k (place - mean place): where the gains were stated is not known."""
    along = scene.place - scene.place.mean()
    out: Floats = output * (1.0 + p[1] + p[0] * along)[:, None]
    return out


def lifted(output: Floats, scene: Scene, p: Floats) -> Floats:
    """Add k, wherever the touch is."""
    out: Floats = output + p[0]
    return out


def stiffening(output: Floats, scene: Scene, p: Floats) -> Floats:
    """Multiply by (1 + c) (P / 200 N/m)^k: at what load the gains were stated is not known."""
    out: Floats = output * (1.0 + p[1]) * (np.maximum(scene.load, 1e-3) / _LOAD)[:, None] ** p[0]
    return out


def lopsided(output: Floats, scene: Scene, p: Floats) -> Floats:
    """Add k x exp(-|x|/w), x the angle from the touch."""
    if scene.distance is None:
        return output
    out: Floats = output + p[0] * scene.distance / p[1] * np.exp(-np.abs(scene.distance) / p[1])
    return out


def rippled(output: Floats, scene: Scene, p: Floats) -> Floats:
    """Add k sin(n t_i + phase) cos-like over the angle of the element, wherever the touch is."""
    if scene.distance is None:
        return output
    angle = scene.distance + scene.place[:, None]
    out: Floats = output + p[0] * np.sin(p[2] * angle + p[1])
    return out


TERMS = (
    term(
        "cube",
        "d = l + k l^3",
        cubed,
        Quantity("k", "1", -500.0, 500.0, 20.0, "size"),
        confounders=("quadratic",),
    ),
    term(
        "knee",
        "d = l - c (l - s) beyond s",
        bent,
        Quantity("c", "1", -1.2, 1.2, 0.02, "slope that is lost there"),
        Quantity("s", "1", 1e-3, 1.0, 5e-3, "output", starts=(0.01, 0.02, 0.04, 0.07, 0.12, 0.2)),
        confounders=("quadratic",),
    ),
    term(
        "time",
        "d = l (1 + c + k (t - mean t))",
        fading,
        Quantity("k", "1/s", -0.1, 0.1, 1e-5, "size"),
        Quantity("c", "1", -0.5, 0.5, 0.02, "in the middle of the time"),
        confounders=("gain_scatter",),
    ),
    term(
        "warmth",
        "d = l (1 + c + k (T - mean T))",
        warming,
        Quantity("k", "1/K", -1.0, 1.0, 0.01, "size"),
        Quantity("c", "1", -0.5, 0.5, 0.02, "at the mean temperature"),
        confounders=("gain_scatter",),
    ),
    term(
        "place",
        "d = l (1 + c + k (t_c - mean t_c))",
        rising,
        Quantity("k", "1/rad", -1.0, 1.0, 0.02, "size"),
        Quantity("c", "1", -0.5, 0.5, 0.02, "at the mean place"),
        confounders=("gain_scatter",),
    ),
    term(
        "offset",
        "d = l + k under any touch",
        lifted,
        Quantity("k", "1", -0.3, 0.3, 1e-3, "size"),
        confounders=("proximity",),
    ),
    term(
        "load",
        "d = l (1 + c) (P / 200 N/m)^k",
        stiffening,
        Quantity("k", "1", -1.0, 1.0, 0.02, "exponent"),
        Quantity("c", "1", -0.5, 0.5, 0.02, "at 200 N/m"),
        confounders=("quadratic", "hertz", "gain_scatter"),
    ),
    term(
        "lopsided",
        "d = l + k x/w exp(-|x|/w), x from the touch",
        lopsided,
        Quantity("k", "1", -0.3, 0.3, 2e-3, "size"),
        Quantity("w", "rad", 0.02, 1.0, 0.05, "reach", starts=(0.05, 0.15, 0.4)),
        confounders=("sliding_friction", "angle_offset"),
    ),
    term(
        "ripple",
        "d = l + k sin(n t_i + phase) under any touch",
        rippled,
        Quantity("k", "1", 0.0, 0.3, 1e-3, "size"),
        Quantity("phase", "rad", -np.pi, np.pi, 0.3, "phase", phase=True),
        Quantity("n", "1", 0.5, 20.0, 0.3, "order", starts=(1.0, 2.0, 4.0, 8.0)),
    ),
)
#: Terms that multiply by what grows with a variable: with what value of it the gains were stated is not known.
GROWING = tuple(f"{TERM_PREFIX}{n}" for n in ("time", "warmth", "place", "load"))
