"""Friction of other laws: a power of the speed, its square one way, the square of the load, and what warms up.

Sources: R. Stribeck, "Die wesentlichen Eigenschaften der Gleit- und Rollenlager", 1902, for losses of lubricated
bearings that go with a power of the speed; T. A. Harris, "Rolling Bearing Analysis", 2001, for those that grow faster
than the load.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from sioms.reconcile.effect import Array, Channel, Effect, Mechanism, Number, Parameter, Ref, Slot, Trials
from sioms.reconcile.effects.drive import GRID_TAU
from sioms.reconcile.jit import state_function


@state_function
def power_force(x: Number, v: Number, u: Number, temperature: Number, p: Array) -> Number:
    """-c |v|^n sign(v), v in its unit."""
    return -p[0] * np.sign(v) * np.abs(v) ** p[1]


@state_function
def even_force(x: Number, v: Number, u: Number, temperature: Number, p: Array) -> Number:
    """-c v^2: adds to quadratic drag forward, subtracts from it backward."""
    return -p[0] * v * v


@state_function
def load_square_level(x: Number, v: Number, u: Number, temperature: Number, p: Array) -> Number:
    """g u^2."""
    return p[0] * u * u


@state_function
def warm_level(x: Number, v: Number, u: Number, temperature: Number, p: Array) -> Number:
    """g T."""
    return p[0] * temperature


def _warming(row: Any, p: Array) -> None:
    row.warming, row.tau_t = 1.0, p[1]


POWER_DRAG = Effect(
    name="power_drag",
    title="drag with a power of the speed",
    channel=Channel.MECHANICS,
    slot=Slot.FORCE,
    function=power_force,
    equation="F = -c |v|^n sign(v)",
    parameters=(
        Parameter("c", "{F} (s/{x})^n", Ref.FORCE, 0.0, 1e4, 0.02, "drag at unit speed"),
        Parameter("n", "1", Ref.ONE, 0.3, 3.5, 1.5, "exponent", shape=True, vanishes=True),
    ),
    signature="force residual that grows with a power of speed, odd in direction",
    confounders=("viscous", "quadratic_drag", "coulomb"),
    separate="cruise at several speeds up to the largest, both ways",
    replaces=("viscous", "quadratic_drag"),
)
QUADRATIC_DIRECTION = Effect(
    name="quadratic_direction",
    title="direction-dependent quadratic drag",
    channel=Channel.MECHANICS,
    slot=Slot.FORCE,
    function=even_force,
    equation="F = -c v^2: the drag coefficient is larger by c forward, smaller by c backward",
    parameters=(Parameter("c", "{F} s^2/{x}^2", Ref.DRAG, -1.0, 1.0, 0.03, "half the difference of the coefficients"),),
    signature="force residual with the square of speed, even in direction",
    confounders=("viscous_direction", "offset"),
    separate="cruise at several speeds both ways, and rest",
)
LOAD_SQUARE_FRICTION = Effect(
    name="load_square_friction",
    title="friction with the square of the load",
    channel=Channel.MECHANICS,
    slot=Slot.FRICTION,
    function=load_square_level,
    equation="F = -g u^2 sign(v)",
    parameters=(Parameter("g", "1/({F})", Ref.PER_FORCE, 0.0, 3.0, 0.1, "loss per squared transmitted force"),),
    signature="force residual opposes motion and grows with the square of the motor force",
    confounders=("load_friction", "coulomb", "thermal_gain"),
    separate="the same speeds at several accelerations or loads",
)
WARMING_FRICTION = Effect(
    name="warming_friction",
    title="friction that changes as the axis runs in",
    channel=Channel.MECHANICS,
    slot=Slot.FRICTION,
    function=warm_level,
    mechanism=Mechanism(_warming, warms=True),
    trials=Trials(lambda seen: ({"tau": g} for g in GRID_TAU)),
    equation="F = -g T sign(v), tau dT/dt = |v| - T",
    parameters=(
        Parameter("g", "{F} s/{x}", Ref.DAMPING, -5.0, 5.0, 0.05, "what dry friction gains where the axis has moved"),
        Parameter("tau", "s", Ref.TIME, 0.5, 1e4, 10.0, "time over which it does", soft=True),
    ),
    signature="force residual with the direction of motion that goes with how much the axis moved before",
    confounders=("coulomb", "thermal_gain", "viscous"),
    separate="the same slow move cold, and after a minute of fast ones",
    session=("how warm it is at the start",),
    replaces=("thermal_gain",),
)

EFFECTS = (POWER_DRAG, QUADRATIC_DIRECTION, LOAD_SQUARE_FRICTION, WARMING_FRICTION)
