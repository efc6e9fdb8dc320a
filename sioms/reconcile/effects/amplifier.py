"""The drive's force against its command: a dead band about zero, and a force constant that differs by direction."""

from __future__ import annotations

import numpy as np

from sioms.reconcile.effect import Array, Channel, Effect, Number, Parameter, Ref, Slot, Trials
from sioms.reconcile.jit import state_function


@state_function
def dead_force(x: Number, v: Number, u: Number, temperature: Number, p: Array) -> Number:
    """-clip(u, -w, w)."""
    return -0.5 * (np.abs(u + p[0]) - np.abs(u - p[0]))


@state_function
def one_sided_gain(x: Number, v: Number, u: Number, temperature: Number, p: Array) -> Number:
    """1 + d sign(u)."""
    return 1.0 + p[0] * np.sign(u)


#: First guesses of the dead band, over the largest force.
GRID_DEAD = (0.01, 0.03, 0.08, 0.2)

DEAD_BAND = Effect(
    name="dead_band",
    title="dead band of the drive",
    channel=Channel.ACTUATOR,
    slot=Slot.FORCE,
    function=dead_force,
    trials=Trials(lambda seen: ({"w": g * seen.force} for g in GRID_DEAD), stretched=False),
    equation="F = u - clip(u, -w, w): nothing within w of zero, and w less beyond",
    parameters=(Parameter("w", "{F}", Ref.FORCE, 0.0, 1.0, 0.05, "half width of the dead band", shape=True),),
    signature="force residual against the command, of one size from a small command on",
    confounders=("coulomb", "load_friction", "gain_asymmetry"),
    separate="force steps about zero while the axis moves on",
)
GAIN_ASYMMETRY = Effect(
    name="gain_asymmetry",
    title="force constant that differs by direction",
    channel=Channel.ACTUATOR,
    slot=Slot.GAIN,
    function=one_sided_gain,
    equation="F = u (1 + d sign(u))",
    parameters=(
        Parameter("d", "1", Ref.ONE, -0.6, 0.6, 0.03, "half the difference of the force constants", least=0.004),
    ),
    signature="force residual with the size of the motor force, the same way for both its signs",
    confounders=("offset", "viscous_direction", "asymmetric_spring", "dead_band"),
    separate="the same moves both ways, with two loads",
)

EFFECTS = (DEAD_BAND, GAIN_ASYMMETRY)
