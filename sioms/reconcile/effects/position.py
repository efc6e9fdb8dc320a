"""Forces that depend on where the axis is, and the constant one."""

from __future__ import annotations

import numpy as np

from sioms.reconcile.effect import TURN, Array, Channel, Effect, Number, Parameter, Ref, Slot
from sioms.reconcile.jit import state_function


@state_function
def offset_force(x: Number, v: Number, u: Number, temperature: Number, p: Array) -> Number:
    """A constant."""
    return p[0] + 0.0 * x


@state_function
def gravity_force(x: Number, v: Number, u: Number, temperature: Number, p: Array) -> Number:
    """amp sin(x + phase), x the angle of the axis: marks may come more often than once a turn."""
    return p[0] * np.sin(x + p[1])


@state_function
def cogging_force(x: Number, v: Number, u: Number, temperature: Number, p: Array) -> Number:
    """amp sin(n theta + phase) + amp2 sin(2 n theta + phase2)."""
    a = p[2] * p[TURN] * x
    return p[0] * np.sin(a + p[1]) + p[3] * np.sin(2.0 * a + p[4])


@state_function
def spring_force(x: Number, v: Number, u: Number, temperature: Number, p: Array) -> Number:
    """-k x."""
    return -p[0] * x


OFFSET = Effect(
    name="offset",
    title="constant force",
    channel=Channel.MECHANICS,
    slot=Slot.FORCE,
    function=offset_force,
    equation="F = off",
    parameters=(Parameter("off", "{F}", Ref.FORCE, -1.0, 1.0, 0.02, "constant force on the axis"),),
    signature="force residual constant everywhere, at rest too",
    confounders=("coulomb", "gravity", "viscous_direction"),
    separate="motion both ways over one full turn, and rest",
)
GRAVITY = Effect(
    name="gravity",
    title="gravity on an unbalanced rotary axis",
    channel=Channel.MECHANICS,
    slot=Slot.FORCE,
    function=gravity_force,
    equation="F = amp sin(x + phase)",
    parameters=(
        Parameter("amp", "{F}", Ref.FORCE, 0.0, 2.0, 0.05, "largest gravity force"),
        Parameter("phase", "rad", Ref.ANGLE, -np.pi, np.pi, 0.0, "phase at position zero", phase=True),
    ),
    signature="force residual with one period in a turn, whatever the speed",
    confounders=("offset", "cogging", "spring"),
    separate="one full turn, slowly, both ways",
    linear=False,
)
COGGING = Effect(
    name="cogging",
    title="cogging",
    channel=Channel.MECHANICS,
    slot=Slot.FORCE,
    function=cogging_force,
    equation="F = amp sin(n theta + phase) + amp2 sin(2 n theta + phase2)",
    parameters=(
        Parameter("amp", "{F}", Ref.FORCE, 0.0, 1.0, 0.05, "amplitude of the first harmonic"),
        Parameter("phase", "rad", Ref.ANGLE, -np.pi, np.pi, 0.0, "phase at position zero", phase=True),
        Parameter("n", "1/pitch", Ref.ONE, 1.0, 60.0, 1.0, "periods in a pitch", fixed=True),
        Parameter("amp2", "{F}", Ref.FORCE, 0.0, 1.0, 0.01, "amplitude of the second harmonic"),
        Parameter("phase2", "rad", Ref.ANGLE, -np.pi, np.pi, 0.0, "its phase", phase=True),
    ),
    signature="periodic force residual in position, present without current, whatever the speed",
    confounders=("torque_ripple", "gravity", "eccentricity"),
    separate="one full turn slowly, with and without load",
)
SPRING = Effect(
    name="spring",
    title="spring or cable",
    channel=Channel.MECHANICS,
    slot=Slot.FORCE,
    function=spring_force,
    equation="F = -k x",
    parameters=(Parameter("k", "{F}/{x}", Ref.STIFFNESS, 0.0, 5.0, 0.02, "stiffness about position zero"),),
    signature="force residual proportional to position",
    confounders=("gravity", "offset"),
    separate="the whole range, slowly, both ways",
)

EFFECTS = (OFFSET, GRAVITY, COGGING, SPRING)
