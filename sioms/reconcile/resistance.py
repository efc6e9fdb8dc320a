"""What opposes the motion in a model, all told: viscous friction and whatever of its effects leaves with the motion."""

from __future__ import annotations

import numpy as np

from sioms.reconcile.effect import Array, Slot
from sioms.reconcile.effects import known
from sioms.reconcile.model import AxisModel


def resistance(model: AxisModel, x: Array, v: Array, u: Array, temperature: Array) -> Array:
    """Return the force that opposes the motion in each state, positive against it, shape (n,), [{F}].

    What drives the axis as it moves is negative; what is there at rest as well, such as gravity, does not count.

    Args:
        model: with its effects.
        x: place, shape (n,), [{x}].
        v: velocity, nowhere zero, shape (n,), [{x}/s].
        u: force of the drive, shape (n,), [{F}].
        temperature: of the thermal models, as of ``Run``, shape (n,).
    """
    still, level = np.zeros_like(v), np.zeros_like(v)
    force = model.viscous * v
    for name, given in model.effects.items():
        effect = known()[name]
        if effect.slot is None or effect.slot is Slot.GAIN:
            continue
        row = effect.row(effect.values(given), model.pitch)
        if effect.slot is Slot.FORCE:
            force = force - effect.evaluate(x, v, u, temperature, row) + effect.evaluate(x, still, u, temperature, row)
        else:
            level = level + effect.evaluate(x, v, u, temperature, row)
    return np.asarray(force * np.sign(v) + np.maximum(level, 0.0))
