"""What the power stage of a drive can give: how fast its force changes, and how much of it is left at speed."""

from __future__ import annotations

from typing import Any

import numpy as np

from sioms.reconcile.effect import Array, Channel, Effect, Mechanism, Number, Parameter, Ref, Slot, Trials
from sioms.reconcile.jit import state_function


def _slow(row: Any, p: Array) -> None:
    row.slew = p[0]


@state_function
def short_supply(x: Number, v: Number, u: Number, temperature: Number, p: Array) -> Number:
    """clip(u, -F0 (1 + v/v0), F0 (1 - v/v0)) - u, no limit beyond zero."""
    most = p[0] * np.maximum(1.0 - v / p[1], 0.0)
    least = -p[0] * np.maximum(1.0 + v / p[1], 0.0)
    return np.minimum(np.maximum(u, least), most) - u


#: First guesses: times [s] in which the largest force is reached; limits at rest over that force, and speeds without
#: load over the largest speed.
GRID_RISE = (3e-3, 10e-3, 30e-3, 0.1)
GRID_REST = (1.0, 0.8, 0.6, 0.4)
GRID_FREE = (0.8, 1.2, 2.0)

SLEW_LIMIT = Effect(
    name="slew_limit",
    title="limited rate of change of the force",
    channel=Channel.ACTUATOR,
    mechanism=Mechanism(_slow, lambda p, pitch: {"slew_limit": {"rate": p[0]}}),
    trials=Trials(lambda seen: ({"rate": seen.force / t} for t in GRID_RISE), stretched=False),
    sized=False,
    equation="F follows u, |dF/dt| <= rate",
    parameters=(Parameter("rate", "{F}/s", Ref.RISE, 1.0, 5e4, 50.0, "largest rate of change of the force"),),
    signature="force residual after steps of the command, the longer the larger they are; measured current in ramps",
    confounders=("lag", "delay", "saturation"),
    separate="force steps of several heights: a lag takes as long for all, a limited rate longer for large ones",
)
SUPPLY_LIMIT = Effect(
    name="supply_limit",
    title="supply that gives less force at speed",
    channel=Channel.ACTUATOR,
    slot=Slot.FORCE,
    function=short_supply,
    trials=Trials(
        lambda seen: ({"F0": f * seen.force, "v0": v * seen.max_speed} for f in GRID_REST for v in GRID_FREE),
        stretched=False,
    ),
    sized=False,
    equation="F = clip(u, -F0 (1 + v/v0), F0 (1 - v/v0))",
    parameters=(
        Parameter("F0", "{F}", Ref.FORCE, 0.02, 10.0, 0.5, "largest force at rest"),
        Parameter("v0", "{x}/s", Ref.SPEED, 0.1, 20.0, 1.2, "speed at which no force is left"),
    ),
    signature="force residual where the command is large in the direction of motion, more at speed",
    confounders=("saturation", "viscous", "quadratic_drag", "thermal_gain"),
    separate="force steps of growing height at rest and at speed",
    replaces=("saturation",),
)

EFFECTS = (SLEW_LIMIT, SUPPLY_LIMIT)
