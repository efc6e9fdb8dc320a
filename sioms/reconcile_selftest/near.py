"""Forms near those of the library, made anew: each as a machine might have it, none as a name has it.

A solver that gives one a name of the library is sure and wrong: what it should say is *unexplained*, with what else
there is. The shape of each is drawn, so that no two are alike.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from sioms.reconcile_selftest.axis import Numbers

#: What may be hidden, by the number that the world knows it by, and known effects one of which may be beside it.
BESIDE = {
    "near_drop": ("viscous", "payload"),
    "near_drag": ("coulomb", "payload"),
    "near_spring": ("viscous", "coulomb"),
    "near_load": ("viscous", "payload"),
    "near_wave": ("viscous", "payload"),
    "near_cogging": ("coulomb", "viscous"),
    "near_heat": ("coulomb", "viscous"),
    "near_build": ("viscous", "payload"),
    "near_warm": ("viscous", "payload"),
    "near_gain": ("coulomb", "viscous"),
}
NEAR = tuple(BESIDE)
DROP, DRAG, SPRING, LOAD, WAVE, COGGING, HEAT, BUILD, WARM, GAIN = range(len(NEAR))
#: Elements of what builds up.
ELEMENTS = 3


def draw_near(name: str, rated: float, speed: float, reach: float, order: float, rng: np.random.Generator) -> Numbers:
    """Draw one: its size, the scale of its variable, its shape, how much more of it there is, and its phase.

    Args:
        order: of what repeats in a turn.
    """

    def u(low: float, high: float) -> float:
        return float(rng.uniform(low, high))

    def one(*values: float) -> float:
        return float(rng.choice(values))

    dry = rated * u(0.06, 0.2)
    numbers = {
        # 1 + more exp(-z^shape), or of 1/(1 + z^-shape)
        "near_drop": (dry, speed * 10.0 ** u(-1.8, -0.5), one(u(0.6, 1.2), u(3.2, 4.5), -u(1.0, 2.5)), u(0.6, 1.4)),
        # 1 - exp(-z), z/(1 + z), sinh z: each about a drag that the library has
        "near_drag": (rated * u(0.1, 0.3), speed * u(0.3, 0.8), one(0.0, 1.0, 2.0), 0.0),
        "near_spring": (rated * u(0.1, 0.3), reach * u(0.3, 0.6), one(0.0, 1.0, 2.0), 0.0),
        "near_load": (rated * u(0.1, 0.25), rated, one(u(0.5, 0.75), u(1.3, 1.7)), 0.0),
        # a triangle, cut off at 1 / shape
        "near_wave": (dry, order, u(1.0, 2.5), u(0.3, 0.6)),
        "near_cogging": (rated * u(0.06, 0.14), order, u(1.0, 2.5), 0.0),
        # a loss that levels off where the drive is as warm as ``more``
        "near_heat": (u(0.9, 1.8), u(5.0, 12.0), 0.0, u(0.05, 0.2)),
        # elements that yield one after the other
        "near_build": (dry, reach * u(2e-3, 6e-3), u(2.0, 4.0), 0.0),
        # with the clock, or the way
        "near_warm": (dry, u(3.0, 10.0), one(0.0, 1.0), one(-1.0, 1.0) * u(0.25, 0.5)),
        "near_gain": (u(0.06, 0.2), rated, one(1.0, 2.0), 0.0),
    }[name]
    size, scale, shape, more = numbers
    if name in ("near_drag", "near_spring") and shape == 2.0:  # as large at the end of the range as the others
        size /= float(np.sinh((speed if name == "near_drag" else reach) / scale))
    return {"size": size, "scale": scale, "shape": shape, "more": more, "phase": u(-np.pi, np.pi)}


@njit(cache=True, nogil=True)
def cut_off(angle: float, shape: float) -> float:
    """Return a triangular wave that is cut off at 1 / shape, of height 1."""
    return float(min(max(shape * 2.0 / np.pi * np.arcsin(np.sin(angle)), -1.0), 1.0))


@njit(cache=True, nogil=True)
def bent(z: float, shape: float) -> float:
    """Return a law of z, odd in it, by its number."""
    if shape == 0.0:
        return float(np.sign(z) * (1.0 - np.exp(-abs(z))))
    return float(z / (1.0 + abs(z)) if shape == 1.0 else np.sinh(z))


@njit(cache=True, nogil=True)
def near_level(kind: int, a: tuple[float, float, float, float, float], v: float, u: float, theta: float, run: float,
               clock: float) -> float:  # fmt: skip
    """Return the level of dry friction of a form, 0 where it is none; ``run``: the way so far over what a second at the
    scale makes; ``clock`` [s].
    """
    size, scale, shape, more, phase = a
    if kind == DROP:
        z = abs(v) / scale
        return float(size * (1.0 + more * (np.exp(-(z**shape)) if shape > 0.0 else 1.0 / (1.0 + z**-shape))))
    if kind == LOAD:
        return float(size * (abs(u) / scale) ** shape)
    if kind == WAVE:
        return size * (1.0 + more * cut_off(scale * theta + phase, shape))
    if kind == WARM:
        z = clock if shape == 0.0 else run
        return float(size * (1.0 + more * (1.0 - np.exp(-z / scale))))
    return 0.0


@njit(cache=True, nogil=True)
def near_force(kind: int, a: tuple[float, float, float, float, float], x: float, v: float, u: float, theta: float,
               heat: float) -> float:  # fmt: skip
    """Return what a form adds to the force on the axis."""
    size, scale, shape, more, phase = a
    if kind == DRAG:
        return -size * bent(v / scale, shape)
    if kind == SPRING:
        return -size * bent(x / scale, shape)
    if kind == COGGING:
        return size * cut_off(scale * theta + phase, shape)
    if kind == HEAT:
        return -u * size * heat / (1.0 + heat / more)
    if kind == GAIN:
        return float(-u * size * (abs(u) / scale) ** shape)
    return 0.0
