"""The dry friction of a model on a motion that is given: what its levels and its hysteresis make of place and speed."""

from __future__ import annotations

import numpy as np

from sioms.reconcile.effect import Array, Slot
from sioms.reconcile.effects import known
from sioms.reconcile.jit import kernel
from sioms.reconcile.model import AxisModel


def dry_friction(model: AxisModel, x: Array, v: Array, u: Array, temperature: Array, way: Array) -> Array:
    """Return the force of dry friction on the axis, [{F}].

    Args:
        x, v, u, temperature: states as state functions take them, shape (n,).
        way: direction of motion, -1 to 1.
    """
    total, share = np.zeros_like(x), np.ones_like(x)
    laws = [(known()[n], known()[n].values(given)) for n, given in model.effects.items()]
    for effect, p in laws:
        if effect.mechanism.varies:
            share *= 1.0 + p[0] * np.sin(p[2] * 2.0 * np.pi / model.pitch * x + p[1])
    for effect, p in laws:
        if effect.slot is Slot.FRICTION:
            total -= share * way * effect.evaluate(x, v, u, temperature, effect.row(p, model.pitch))
        elif effect.mechanism.builds_up:
            rest, drop = (p[2], np.exp(-((v / p[3]) ** 2))) if len(p) > 2 else (p[0], 0.0 * v)
            total -= built_up(x, share * (p[0] + (rest - p[0]) * drop), rest / p[1])
    return total


@kernel
def built_up(x: Array, level: Array, stiffness: float) -> Array:
    """Friction that nears a level over displacement, dF/dx = stiffness (sign(v) - F / level), from none; shape (n,)."""
    force, out = 0.0, np.zeros_like(x)
    for i in range(1, len(x)):
        moved = x[i] - x[i - 1]
        if level[i] > 0.0:
            goal = level[i] if moved > 0.0 else -level[i]
            force = goal + (force - goal) * np.exp(-stiffness * np.abs(moved) / level[i])
        out[i] = force
    return out
