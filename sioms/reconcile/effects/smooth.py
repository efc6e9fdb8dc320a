"""Smooth laws without a name: what of one variable orders the remainder, where no effect and no formula does.

A law is a broken line over one variable through nine places, evenly laid over what the records show, zero in the
middle (a constant is the offset's); beyond the last places it stays as it is there. Its numbers are its values at the
places, so that each has a unit and an interval. It says how the force goes, and not why; it is searched for only when
library and formulas leave something that a smoother explains.
"""

from __future__ import annotations

import numpy as np

from sioms.reconcile.effect import (
    TERM_PREFIX,
    Array,
    Channel,
    Effect,
    Number,
    Over,
    Parameter,
    Ref,
    Slot,
    StateFunction,
)
from sioms.reconcile.jit import state_function

#: Places to either side of the middle.
SIDE = 4
#: These places, in steps from the middle.
PLACES = (*range(-SIDE, 0), *range(1, SIDE + 1))
#: Where a row has the middle and the step; of the values the eighth comes after the place of the pitch.
CENTRE, STEP = 2 * SIDE + 1, 2 * SIDE + 2


@state_function
def by_place(x: Number, v: Number, u: Number, temperature: Number, p: Array) -> Number:
    """s(x)."""
    z = np.minimum(np.maximum((x - p[CENTRE]) / p[STEP], -SIDE), SIDE)
    s = 0.0 * z
    for k in range(SIDE):
        s = s + p[k] * np.maximum(1.0 - np.abs(z + (SIDE - k)), 0.0)
        s = s + p[SIDE + k + k // 3] * np.maximum(1.0 - np.abs(z - (k + 1)), 0.0)
    return s


@state_function
def by_speed(x: Number, v: Number, u: Number, temperature: Number, p: Array) -> Number:
    """s(v)."""
    z = np.minimum(np.maximum((v - p[CENTRE]) / p[STEP], -SIDE), SIDE)
    s = 0.0 * z
    for k in range(SIDE):
        s = s + p[k] * np.maximum(1.0 - np.abs(z + (SIDE - k)), 0.0)
        s = s + p[SIDE + k + k // 3] * np.maximum(1.0 - np.abs(z - (k + 1)), 0.0)
    return s


@state_function
def by_force(x: Number, v: Number, u: Number, temperature: Number, p: Array) -> Number:
    """s(u)."""
    z = np.minimum(np.maximum((u - p[CENTRE]) / p[STEP], -SIDE), SIDE)
    s = 0.0 * z
    for k in range(SIDE):
        s = s + p[k] * np.maximum(1.0 - np.abs(z + (SIDE - k)), 0.0)
        s = s + p[SIDE + k + k // 3] * np.maximum(1.0 - np.abs(z - (k + 1)), 0.0)
    return s


@state_function
def drag_by_place(x: Number, v: Number, u: Number, temperature: Number, p: Array) -> Number:
    """-s(x) v."""
    z = np.minimum(np.maximum((x - p[CENTRE]) / p[STEP], -SIDE), SIDE)
    s = 0.0 * z
    for k in range(SIDE):
        s = s + p[k] * np.maximum(1.0 - np.abs(z + (SIDE - k)), 0.0)
        s = s + p[SIDE + k + k // 3] * np.maximum(1.0 - np.abs(z - (k + 1)), 0.0)
    return -s * v


def _law(
    name: str,
    title: str,
    equation: str,
    function: StateFunction,
    over: Over,
    units: tuple[str, Ref, str],
    replaces: tuple[str, ...],
    slot: Slot = Slot.FORCE,
    beside: tuple[str, ...] = (),
) -> Effect:
    """Make a law; ``units``: of its values, their natural size, and the unit of its variable."""
    unit, size, of = units
    values = tuple(Parameter(f"s{i}", unit, size, -50.0, 50.0, 0.05, f"value {at:+d} steps from the middle")
                   for i, at in enumerate(PLACES, 1))  # fmt: skip
    laid = tuple(Parameter(symbol, of, Ref.ONE, -1e12, 1e12, 1.0, text, fixed=True, shape=True)
                 for symbol, text in (("middle", "the middle place"), ("step", "from place to place")))  # fmt: skip
    return Effect(
        name=TERM_PREFIX + name,
        title=title,
        channel=Channel.MECHANICS,
        slot=slot,
        function=function,
        over=over,
        sized=False,
        equation=equation,
        parameters=(*values, *laid),
        signature="",
        confounders=(),
        separate="",
        replaces=replaces,
        beside=beside,
    )


OF_PLACE = ("spring", "gravity", "hardening_spring", "asymmetric_spring", "term_x2", "term_wave", "term_stop_above",
            "term_stop_below")  # fmt: skip
OF_SPEED = ("viscous", "viscous_direction", "quadratic_drag", "quadratic_direction", "power_drag", "term_v3",
            "term_falling_drag", "term_levelling_drag")  # fmt: skip
OF_FORCE = ("gain_asymmetry", "dead_band", "term_dull_force", "term_load_square")
DRY = ("coulomb", "stribeck", "presliding", "lugre")

LAWS = (
    _law("law_of_place", "smooth law of position", "F = s(x), a broken line", by_place, Over.PLACE,
         ("{F}", Ref.FORCE, "{x}"), OF_PLACE),
    _law("law_of_speed", "smooth law of speed", "F = s(v), a broken line", by_speed, Over.SPEED,
         ("{F}", Ref.FORCE, "{x}/s"), OF_SPEED),
    _law("law_of_force", "smooth law of the motor force", "F = s(u), a broken line", by_force, Over.FORCE,
         ("{F}", Ref.FORCE, "{F}"), OF_FORCE),
    _law("drag_by_place", "smooth law of position, times speed", "F = -s(x) v, s a broken line", drag_by_place,
         Over.PLACE, ("{F} s/{x}", Ref.DAMPING, "{x}"), ("term_xv", "term_turn_drag")),
    _law("friction_by_place", "smooth law of position, against the motion", "F = -s(x) sign(v), s a broken line",
         by_place, Over.PLACE, ("{F}", Ref.FORCE, "{x}"), ("coulomb_position", "term_place_friction"),
         Slot.FRICTION, DRY),
    _law("friction_by_force", "smooth law of the motor force, against the motion",
         "F = -s(u) sign(v), s a broken line", by_force, Over.FORCE,
         ("{F}", Ref.FORCE, "{F}"), ("load_friction", "load_square_friction"), Slot.FRICTION),
)  # fmt: skip
#: Laws that share friction out with what has a name by convention alone.
OPPOSING = tuple(TERM_PREFIX + n for n in ("law_of_speed", "drag_by_place", "friction_by_place", "friction_by_force"))
#: What has the constant of a law, which is zero in the middle by convention alone.
CONSTANT = {
    "term_law_of_place": "offset",
    "term_drag_by_place": "viscous",
    "term_friction_by_place": "coulomb",
}
