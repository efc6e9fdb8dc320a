"""Nameless terms: what a refusal may offer when no effect of the library explains the data.

A term describes the residual in symbols; it claims no cause and is kept out of the list of named effects.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from sioms.reconcile.effect import (
    NONE,
    TERM_PREFIX,
    TURN,
    Array,
    Channel,
    Effect,
    Mechanism,
    Number,
    Parameter,
    Ref,
    Slot,
    StateFunction,
    Trials,
)
from sioms.reconcile.effects.friction import BUILDING_UP, UNSEEN_STEPS, lengths
from sioms.reconcile.jit import state_function


@state_function
def square(x: Number, v: Number, u: Number, temperature: Number, p: Array) -> Number:
    """-k x^2."""
    return -p[0] * x * x


@state_function
def cubic_drag(x: Number, v: Number, u: Number, temperature: Number, p: Array) -> Number:
    """-c v^3."""
    return -p[0] * v * v * v


@state_function
def falling_drag(x: Number, v: Number, u: Number, temperature: Number, p: Array) -> Number:
    """-c v / (1 + (v/v0)^2)."""
    return -p[0] * v / (1.0 + (v / p[1]) ** 2)


@state_function
def levelling_drag(x: Number, v: Number, u: Number, temperature: Number, p: Array) -> Number:
    """-f tanh(v/v0)."""
    return -p[0] * np.tanh(v / p[1])


@state_function
def place_drag(x: Number, v: Number, u: Number, temperature: Number, p: Array) -> Number:
    """-c x v."""
    return -p[0] * x * v


@state_function
def turn_drag(x: Number, v: Number, u: Number, temperature: Number, p: Array) -> Number:
    """-c v sin(n theta + phase)."""
    return -p[0] * v * np.sin(p[2] * p[TURN] * x + p[1])


@state_function
def wave(x: Number, v: Number, u: Number, temperature: Number, p: Array) -> Number:
    """amp sin(kappa theta + phase), kappa any number."""
    return p[0] * np.sin(p[2] * p[TURN] * x + p[1])


@state_function
def stop_above(x: Number, v: Number, u: Number, temperature: Number, p: Array) -> Number:
    """-k (x - x0) beyond x0."""
    return -0.5 * p[0] * (x - p[1] + np.abs(x - p[1]))


@state_function
def stop_below(x: Number, v: Number, u: Number, temperature: Number, p: Array) -> Number:
    """-k (x - x0) short of x0."""
    return -0.5 * p[0] * (x - p[1] - np.abs(x - p[1]))


@state_function
def load_square(x: Number, v: Number, u: Number, temperature: Number, p: Array) -> Number:
    """-g u |u|, with g per unit of force."""
    return -p[0] * u * np.abs(u)


@state_function
def place_level(x: Number, v: Number, u: Number, temperature: Number, p: Array) -> Number:
    """g x."""
    return p[0] * x


@state_function
def dull_force(x: Number, v: Number, u: Number, temperature: Number, p: Array) -> Number:
    """-f tanh(u/u0)."""
    return -p[0] * np.tanh(u / p[1])


def _turning(row: Any, p: Array) -> None:
    row.mod_a, row.mod_phase, row.mod_n = p


def _turning_column(motion: Any, wave: float, phase: float, dry: Array) -> Array:
    """Force of a unit inertia that varies over the turn: -(s a + s' v^2 / 2)."""
    at = wave * motion.x + phase
    f: Array = -(np.sin(at) * motion.a + 0.5 * motion.v**2 * wave * np.cos(at))
    return f


PHASE = Parameter("phase", "rad", Ref.ANGLE, -np.pi, np.pi, 0.0, "phase at position zero", phase=True)
ORDER = Parameter("n", "1/pitch", Ref.ONE, 1.0, 12.0, 1.0, "periods in a pitch", fixed=True)
PLACE = Parameter("x0", "{x}", Ref.PITCH, -1e6, 1e6, 0.01, "place of the bend")
SPEED = Parameter("v0", "{x}/s", Ref.SPEED, 2e-3, 1.0, 0.1, "speed of the bend")


def _size(symbol: str, unit: str, ref: Ref, text: str = "size") -> Parameter:
    return Parameter(symbol, unit, ref, -50.0, 50.0, 0.05, text)


def _term(
    name: str,
    equation: str,
    function: StateFunction | None,
    *parameters: Parameter,
    slot: Slot | None = Slot.FORCE,
    mechanism: Mechanism = NONE,
    trials: Trials | None = None,
    replaces: tuple[str, ...] = (),
    confounders: tuple[str, ...] = (),
) -> Effect:
    return Effect(
        name=TERM_PREFIX + name,
        title=equation,
        channel=Channel.MECHANICS,
        slot=slot,
        function=function,
        mechanism=mechanism,
        trials=trials,
        equation=equation,
        parameters=parameters,
        signature="",
        confounders=confounders,
        separate="",
        replaces=replaces,
    )


TERMS = (
    _term("x2", "F = -k x^2", square, _size("k", "{F}/{x}^2", Ref.STIFFNESS)),
    _term(
        "stop_above",
        "F = -k (x - x0) where x > x0",
        stop_above,
        _size("k", "{F}/{x}", Ref.STIFFNESS, "stiffness of the stop"),
        PLACE,
        confounders=("spring",),
    ),
    _term(
        "stop_below",
        "F = -k (x - x0) where x < x0",
        stop_below,
        _size("k", "{F}/{x}", Ref.STIFFNESS, "stiffness of the stop"),
        PLACE,
        confounders=("spring",),
    ),
    _term(
        "v3",
        "F = -c v^3",
        cubic_drag,
        _size("c", "{F} s^3/{x}^3", Ref.DRAG),
        confounders=("viscous", "quadratic_drag"),
    ),
    _term(
        "falling_drag",
        "F = -c v / (1 + (v/v0)^2)",
        falling_drag,
        _size("c", "{F} s/{x}", Ref.DAMPING),
        SPEED,
        confounders=("viscous",),
    ),
    _term(
        "levelling_drag",
        "F = -f tanh(v/v0)",
        levelling_drag,
        _size("f", "{F}", Ref.FORCE),
        SPEED,
        confounders=("coulomb", "viscous"),
    ),
    _term("xv", "F = -c x v", place_drag, _size("c", "{F} s/{x}^2", Ref.DAMPING)),
    _term(
        "turn_drag",
        "F = -c v sin(n theta + phase)",
        turn_drag,
        _size("c", "{F} s/{x}", Ref.DAMPING),
        PHASE,
        ORDER,
    ),
    _term(
        "wave",
        "F = amp sin(kappa theta + phase)",
        wave,
        _size("amp", "{F}", Ref.FORCE),
        PHASE,
        Parameter("kappa", "1/pitch", Ref.ONE, 0.02, 3.0, 0.5, "periods in a pitch, any number"),
        confounders=("gravity", "spring", "offset"),
    ),
    _term(
        "place_friction",
        "F = -g x sign(v)",
        place_level,
        _size("g", "{F}/{x}", Ref.STIFFNESS, "slope of dry friction along the range"),
        slot=Slot.FRICTION,
    ),
    _term("load_square", "F = -g u |u|", load_square, _size("g", "1/({F})", Ref.ONE)),
    _term(
        "dull_force",
        "F = -f tanh(u/u0)",
        dull_force,
        _size("f", "{F}", Ref.FORCE),
        Parameter("u0", "{F}", Ref.FORCE, 5e-3, 0.5, 0.05, "force of the bend", shape=True),
        confounders=("load_friction", "payload"),
    ),
    _term(
        "hysteresis",
        "dF/dx = (f sign(v) - F)/length, force -F",
        None,
        Parameter("f", "{F}", Ref.FORCE, 0.0, 1.5, 0.05, "level long after a reversal"),
        Parameter(
            "xs",
            "{x}",
            Ref.PITCH,
            5e-3,
            100.0,
            0.05,
            "displacement over which it builds up",
            vanishes=True,
            steps=UNSEEN_STEPS,
        ),
        slot=None,
        mechanism=BUILDING_UP,
        trials=Trials(lambda seen: ({"xs": xs} for xs in lengths(seen, 5e-3, 100.0))),
        replaces=("presliding", "lugre", "coulomb", "stribeck", "coulomb_position"),
        confounders=("coulomb",),
    ),
    _term(
        "turn_inertia",
        "J = J0 + dJ sin(n theta + phase)",
        None,
        Parameter("dJ", "{F} s^2/{x}", Ref.INERTIA, 0.0, 0.9, 0.1, "amplitude of the inertia"),
        PHASE,
        ORDER,
        slot=None,
        mechanism=Mechanism(_turning, column=_turning_column),
    ),
)
