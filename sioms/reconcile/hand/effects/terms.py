"""Nameless terms: what a refusal may offer where no effect of the library explains recorded grasps."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from sioms.reconcile.hand.effects.pairs import FINGERS, GEOMETRY, of_both
from sioms.reconcile.hand.grasps import Floats
from sioms.reconcile.sensors.effect import Quantity, SensorEffect, term

Changes = tuple[Floats, Floats, Floats]
LIKE = of_both(*GEOMETRY)


def _on(index: int, part: int, column: Floats) -> Changes:
    """Return changes of one kind (0 turn of the link, 1 place, 2 farther out) of one finger."""
    out = [np.zeros((len(column), 2)) for _ in range(3)]
    out[part][:, index] = column
    return out[0], out[1], out[2]


def _farther(index: int) -> Callable[..., Changes]:
    return lambda t, g, p: _on(index, 2, np.full(len(g), p[0]))


def _stretched(index: int) -> Callable[..., Changes]:
    return lambda t, g, p: _on(index, 1, p[0] * (g.place[:, index] - 0.5 * np.pi))


def _rippled(index: int) -> Callable[..., Changes]:
    return lambda t, g, p: _on(index, 1, p[0] * np.sin(p[2] * g.place[:, index] + p[1]))


def _seated(index: int) -> Callable[..., Changes]:
    return lambda t, g, p: _on(index, 0, p[0] * np.tanh(t.torque[:, index] / p[1]))


def _hardened(index: int) -> Callable[..., Changes]:
    return lambda t, g, p: _on(index, 0, p[0] * t.torque[:, index] * np.abs(t.torque[:, index]))


def _indented(index: int) -> Callable[..., Changes]:
    return lambda t, g, p: _on(index, 2, -p[0] * t.press[:, index])


def _drifted(index: int) -> Callable[..., Changes]:
    return lambda t, g, p: _on(index, 0, p[0] * (g.time - g.time[0]))


def _swung(index: int) -> Callable[..., Changes]:
    return lambda t, g, p: _on(index, 0, p[0] * np.sin(g.joints[:, 3 * index + 2] + p[1]))


def _of(finger: int) -> tuple[SensorEffect, ...]:
    """Return the terms of one finger."""
    i, n = finger - 1, str(finger)

    def made(name: str, equation: str, response: Any, *parameters: Quantity) -> SensorEffect:
        return term(f"{name}_{n}", equation, response, *parameters, confounders=LIKE)

    return (
        made("farther", f"contact {n} lies c farther from its finger's centre", _farther(i),
             Quantity("c", "m", -0.01, 0.01, 3e-4, "farther out")),
        made("stretched", f"place_{n} = felt place_{n} + c (felt place_{n} - pi/2)", _stretched(i),
             Quantity("c", "1", -0.5, 0.5, 0.02, "share")),
        made("rippled", f"place_{n} = felt place_{n} + c sin(k felt place_{n} + p)", _rippled(i),
             Quantity("c", "rad", 0.0, 0.5, 5e-3, "size"),
             Quantity("p", "rad", -np.pi, np.pi, 0.3, "phase", phase=True),
             Quantity("k", "1", 0.5, 80.0, 0.3, "waves in 2 pi", starts=(2.0, 4.0, 8.0, 18.0, 36.0, 50.0))),
        made("seated", f"th_{n} = read th_{n} + c tanh(torque_{n}/s)", _seated(i),
             Quantity("c", "rad", -0.3, 0.3, 5e-3, "turn at last"),
             Quantity("s", "N m", 1e-3, 1.0, 0.03, "torque that it takes", starts=(0.03, 0.01, 0.1))),
        made("hardened", f"th_{n} = read th_{n} + c torque_{n} |torque_{n}|", _hardened(i),
             Quantity("c", "rad/(N m)^2", -20.0, 20.0, 0.1, "size")),
        made("indented", f"contact {n} lies c press_{n} nearer to its finger's centre", _indented(i),
             Quantity("c", "m/N", -0.01, 0.01, 1e-4, "softness")),
        made("drifted", f"th_{n} = read th_{n} + c t", _drifted(i),
             Quantity("c", "rad/s", -1e-2, 1e-2, 1e-5, "rate")),
        made("swung", f"th_{n} = read th_{n} + c sin(read th_{n} + p)", _swung(i),
             Quantity("c", "rad", 0.0, 0.5, 5e-3, "size"),
             Quantity("p", "rad", -np.pi, np.pi, 0.3, "phase", phase=True)),
    )  # fmt: skip


TERMS = tuple(t for finger in FINGERS for t in _of(finger))
