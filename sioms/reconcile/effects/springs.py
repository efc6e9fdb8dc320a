"""Springs that are no straight lines: stiffer the further they go, or stiffer one way than the other.

Source: I. Kovacic, M. J. Brennan, "The Duffing Equation", 2011, for the cubic.
"""

from __future__ import annotations

import numpy as np

from sioms.reconcile.effect import Array, Channel, Effect, Number, Parameter, Ref, Slot
from sioms.reconcile.jit import state_function


@state_function
def hardening_force(x: Number, v: Number, u: Number, temperature: Number, p: Array) -> Number:
    """-k3 x^3."""
    return -p[0] * x * x * x


@state_function
def asymmetric_force(x: Number, v: Number, u: Number, temperature: Number, p: Array) -> Number:
    """-d |x|: adds d to the stiffness above position zero, subtracts it below."""
    return -p[0] * np.abs(x)


HARDENING_SPRING = Effect(
    name="hardening_spring",
    title="hardening spring (cubic; softening where negative)",
    channel=Channel.MECHANICS,
    slot=Slot.FORCE,
    function=hardening_force,
    equation="F = -k3 x^3",
    parameters=(
        # bounds for travels from a millionth of a pitch to a hundred of them
        Parameter("k3", "{F}/{x}^3", Ref.STIFFNESS, -1e12, 1e12, 0.02, "cubic stiffness about position zero"),
    ),
    signature="force residual with the cube of position",
    confounders=("spring", "gravity", "asymmetric_spring"),
    separate="the whole range, slowly, both ways, and swings of several sizes",
    sized=False,
    by_reach=True,
)
ASYMMETRIC_SPRING = Effect(
    name="asymmetric_spring",
    title="spring that is stiffer one way",
    channel=Channel.MECHANICS,
    slot=Slot.FORCE,
    function=asymmetric_force,
    equation="F = -d |x|: the stiffness is k + d above position zero, k - d below",
    parameters=(Parameter("d", "{F}/{x}", Ref.STIFFNESS, -5.0, 5.0, 0.02, "half the difference of the stiffnesses"),),
    signature="force residual with the distance from position zero, the same on both sides",
    confounders=("offset", "spring", "gravity", "hardening_spring"),
    separate="the whole range, slowly, both ways",
)

EFFECTS = (HARDENING_SPRING, ASYMMETRIC_SPRING)
