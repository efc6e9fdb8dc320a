"""Friction: forces that oppose motion and vanish or hold at rest.

Sources: B. Armstrong-Helouvry, P. Dupont, C. Canudas de Wit, "A survey of models, analysis tools and
compensation methods for the control of machines with friction", Automatica 30 (1994) 1083-1138,
for viscous, Coulomb, Stribeck; P. R. Dahl, "A solid friction model", 1968, for presliding; C. Canudas de Wit, H.
Olsson, K. J. Astrom, P. Lischinsky, "A new model for control of systems with friction", IEEE Trans. Automatic Control
40 (1995) 419-425, for both at once.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from sioms.reconcile.effect import (
    TURN,
    Array,
    Channel,
    Effect,
    Mechanism,
    Number,
    Parameter,
    Ref,
    Seen,
    Slot,
    Trials,
)
from sioms.reconcile.jit import state_function


@state_function
def viscous_force(x: Number, v: Number, u: Number, temperature: Number, p: Array) -> Number:
    """-b v."""
    return -p[0] * v


@state_function
def direction_force(x: Number, v: Number, u: Number, temperature: Number, p: Array) -> Number:
    """-d |v|: adds d to the viscous coefficient forward, subtracts it backward."""
    return -p[0] * np.abs(v)


@state_function
def quadratic_force(x: Number, v: Number, u: Number, temperature: Number, p: Array) -> Number:
    """-c v |v|."""
    return -p[0] * v * np.abs(v)


@state_function
def coulomb_level(x: Number, v: Number, u: Number, temperature: Number, p: Array) -> Number:
    """Fc."""
    return p[0] + 0.0 * v


@state_function
def position_level(x: Number, v: Number, u: Number, temperature: Number, p: Array) -> Number:
    """Fc + Fm sin(n theta + phase)."""
    return p[0] + p[1] * np.sin(p[3] * p[TURN] * x + p[2])


@state_function
def stribeck_level(x: Number, v: Number, u: Number, temperature: Number, p: Array) -> Number:
    """Fc + (Fs - Fc) exp(-(v / vs)^2)."""
    return p[0] + (p[1] - p[0]) * np.exp(-((v / p[2]) ** 2))


@state_function
def load_level(x: Number, v: Number, u: Number, temperature: Number, p: Array) -> Number:
    """mu |u|."""
    return p[0] * np.abs(u)


#: Steps from one trial of a length to the next; speeds of a drop, of the largest. Within so many steps of the encoder
#: no path is seen.
STEP_LENGTH = 3.5
GRID_DROP = (0.003, 0.01, 0.03, 0.1)
UNSEEN_STEPS = 2.0


def lengths(seen: Seen, lower: float, upper: float) -> list[float]:
    """List first guesses of the path over which friction builds up, bounds over the pitch: up to half of what was
    travelled.
    """
    low = 10.0 * lower * seen.pitch
    high = max(min(0.8 * upper * seen.pitch, 0.5 * seen.travel), low)
    return [float(g) for g in np.geomspace(low, high, 1 + int(np.ceil(np.log(high / low) / np.log(STEP_LENGTH))))]


def _lugre(seen: Seen) -> Iterator[dict[str, float]]:
    for xs in lengths(seen, 1e-5, 2e-2):
        for drop in GRID_DROP:
            yield {"xs": xs, "vs": drop * seen.max_speed}


def _building_up(row: Any, p: Array) -> None:
    for place, value in zip(("hyst_f", "hyst_x", "hyst_s", "hyst_v"), p, strict=False):
        setattr(row, place, value)


def _building_up_twin(p: Array, pitch: float) -> dict[str, dict[str, float]]:
    rise, speed = (p[2] - p[0], p[3]) if len(p) > 2 else (0.0, 1.0)
    stiffness = (p[0] + rise) / p[1]
    return {"presliding": {"level": p[0], "stiffness": stiffness, "rise": rise, "velocity": speed}}


def _varying(row: Any, p: Array) -> None:
    row.vary_a, row.vary_phase, row.vary_n = p


def _varying_twin(p: Array, pitch: float) -> dict[str, dict[str, float]]:
    return {"friction_variation": {"depth": p[0], "pitch": pitch / p[2], "phase": p[1]}}


def _varying_column(motion: Any, wave: float, phase: float, dry: Array) -> Array:
    out: Array = dry * np.sin(wave * motion.x + phase)
    return out


BUILDING_UP = Mechanism(_building_up, _building_up_twin, builds_up=True)


VISCOUS = Effect(
    name="viscous",
    title="viscous friction",
    channel=Channel.MECHANICS,
    slot=Slot.FORCE,
    function=viscous_force,
    equation="F = -b_extra v",
    parameters=(Parameter("b_extra", "{F} s/{x}", Ref.DAMPING, 0.0, 5.0, 0.05, "added viscous coefficient"),),
    signature="force residual proportional to speed, odd in direction",
    confounders=("coulomb", "quadratic_drag", "viscous_direction"),
    separate="cruise at several speeds both ways",
)
VISCOUS_DIRECTION = Effect(
    name="viscous_direction",
    title="direction-dependent viscous friction",
    channel=Channel.MECHANICS,
    slot=Slot.FORCE,
    function=direction_force,
    equation="F = -b_dir |v|: the coefficient is b + b_dir forward, b - b_dir backward",
    parameters=(
        Parameter(
            "b_dir",
            "{F} s/{x}",
            Ref.DAMPING,
            -2.0,
            2.0,
            0.02,
            "half the difference of the forward and backward coefficients",
        ),
    ),
    signature="force residual proportional to speed, even in direction",
    confounders=("offset",),
    separate="cruise at several speeds both ways, and rest",
)
QUADRATIC_DRAG = Effect(
    name="quadratic_drag",
    title="quadratic drag",
    channel=Channel.MECHANICS,
    slot=Slot.FORCE,
    function=quadratic_force,
    equation="F = -c v |v|",
    parameters=(Parameter("c", "{F} s^2/{x}^2", Ref.DRAG, 0.0, 5.0, 0.05, "drag coefficient"),),
    signature="force residual with the square of speed, odd in direction",
    confounders=("viscous",),
    separate="cruise at several speeds up to the largest, both ways",
)
COULOMB = Effect(
    name="coulomb",
    title="Coulomb friction",
    channel=Channel.MECHANICS,
    slot=Slot.FRICTION,
    function=coulomb_level,
    equation="F = -Fc sign(v); at rest it holds any force up to Fc",
    parameters=(Parameter("Fc", "{F}", Ref.FORCE, 0.0, 1.5, 0.05, "friction level"),),
    signature="force residual steps with the direction of motion and does not depend on speed",
    confounders=("stribeck", "viscous", "offset", "presliding", "dead_band"),
    separate="slow reversals and cruise at several speeds both ways",
    replaces=("stribeck", "presliding", "lugre", "coulomb_position"),
)
COULOMB_POSITION = Effect(
    name="coulomb_position",
    title="Coulomb friction that varies over the turn",
    channel=Channel.MECHANICS,
    slot=Slot.FRICTION,
    function=position_level,
    equation="F = -(Fc + Fm sin(n theta + phase)) sign(v)",
    parameters=(
        Parameter("Fc", "{F}", Ref.FORCE, 0.0, 1.5, 0.05, "mean friction level"),
        Parameter("Fm", "{F}", Ref.FORCE, 0.0, 1.5, 0.02, "amplitude of its variation"),
        Parameter("phase", "rad", Ref.ANGLE, -np.pi, np.pi, 0.0, "phase at position zero", phase=True),
        Parameter("n", "1/pitch", Ref.ONE, 1.0, 60.0, 1.0, "periods in a pitch", fixed=True),
    ),
    signature="periodic force residual whose sign follows the direction of motion",
    confounders=("coulomb", "cogging", "torque_ripple"),
    separate="one full turn at constant speed, both ways",
    replaces=("coulomb", "stribeck", "presliding", "lugre"),
)
STRIBECK = Effect(
    name="stribeck",
    title="Stribeck friction (low-speed drop)",
    channel=Channel.MECHANICS,
    slot=Slot.FRICTION,
    function=stribeck_level,
    equation="F = -(Fc + (Fs - Fc) exp(-(v/vs)^2)) sign(v); at rest it holds up to Fs",
    parameters=(
        Parameter("Fc", "{F}", Ref.FORCE, 0.0, 1.5, 0.05, "level at speed"),
        Parameter("Fs", "{F}", Ref.FORCE, 0.0, 3.0, 0.08, "breakaway level, Fc or more"),
        Parameter("vs", "{x}/s", Ref.SPEED, 2e-4, 0.5, 0.02, "speed over which the level drops"),
    ),
    signature="as Coulomb friction, larger below the Stribeck speed",
    confounders=("coulomb", "presliding", "backlash"),
    separate="reversals at several low speeds",
    ratios=(("Fs", "Fc", 5.0), ("Fc", "Fs", 1.0)),
    replaces=("coulomb", "presliding", "lugre", "coulomb_position"),
)
PRESLIDING = Effect(
    name="presliding",
    title="Coulomb friction with presliding (Dahl)",
    channel=Channel.MECHANICS,
    mechanism=BUILDING_UP,
    trials=Trials(lambda seen: ({"xs": xs} for xs in lengths(seen, 1e-5, 5e-3))),
    equation="dF/dx = (Fc sign(v) - F) / xs, force -F",
    parameters=(
        Parameter("Fc", "{F}", Ref.FORCE, 0.0, 1.5, 0.05, "level after sliding"),
        Parameter(
            "xs",
            "{x}",
            Ref.PITCH,
            1e-5,
            5e-3,
            1e-3,
            "presliding displacement",
            vanishes=True,
            steps=UNSEEN_STEPS,
        ),
    ),
    signature="friction force builds up over a displacement after every reversal",
    confounders=("coulomb", "stribeck", "backlash"),
    separate="small reversals of several amplitudes",
    session=("state at the start",),
    replaces=("coulomb", "stribeck", "lugre", "coulomb_position"),
)
LUGRE = Effect(
    name="lugre",
    title="friction with presliding and low-speed drop (LuGre)",
    channel=Channel.MECHANICS,
    mechanism=BUILDING_UP,
    trials=Trials(_lugre),
    equation="dF/dx = (g sign(v) - F) Fs/(xs g), force -F, g = Fc + (Fs - Fc) exp(-(v/vs)^2)",
    parameters=(
        Parameter("Fc", "{F}", Ref.FORCE, 0.0, 1.5, 0.05, "level at speed"),
        Parameter(
            "xs",
            "{x}",
            Ref.PITCH,
            1e-5,
            2e-2,
            1e-3,
            "presliding displacement",
            vanishes=True,
            steps=UNSEEN_STEPS,
        ),
        Parameter("Fs", "{F}", Ref.FORCE, 0.0, 3.0, 0.08, "breakaway level, Fc or more"),
        Parameter("vs", "{x}/s", Ref.SPEED, 2e-4, 0.5, 0.02, "speed over which the level drops", vanishes=True),
    ),
    signature="friction force builds up over a displacement after every reversal and drops with the speed",
    confounders=("stribeck", "presliding", "coulomb", "backlash"),
    separate="small reversals of several amplitudes, and reversals at several low speeds",
    session=("state at the start",),
    ratios=(("Fs", "Fc", 5.0), ("Fc", "Fs", 1.0)),
    replaces=("coulomb", "stribeck", "presliding", "coulomb_position"),
    joins=("stribeck", "presliding"),
)
FRICTION_VARIATION = Effect(
    name="friction_variation",
    title="dry friction that varies over the turn",
    channel=Channel.MECHANICS,
    mechanism=Mechanism(_varying, _varying_twin, varies=True, column=_varying_column),
    equation="dry friction with a low-speed drop or presliding, its level times 1 + depth sin(n theta + phase)",
    parameters=(
        Parameter("depth", "1", Ref.ONE, 0.0, 0.95, 0.1, "relative variation of the level", least=0.02),
        Parameter("phase", "rad", Ref.ANGLE, -np.pi, np.pi, 0.0, "phase at position zero", phase=True),
        Parameter("n", "1/pitch", Ref.ONE, 1.0, 60.0, 1.0, "periods in a pitch", fixed=True),
    ),
    signature="periodic force residual whose sign follows the direction of motion, as large as the dry friction is at "
    "that speed",
    confounders=("torque_ripple", "cogging", "coulomb_position"),
    separate="one full turn both ways, at constant speed and with acceleration",
    beside=("stribeck", "presliding", "lugre"),
)
LOAD_FRICTION = Effect(
    name="load_friction",
    title="load-dependent friction",
    channel=Channel.MECHANICS,
    slot=Slot.FRICTION,
    function=load_level,
    equation="F = -mu |u| sign(v)",
    parameters=(Parameter("mu", "1", Ref.ONE, 0.0, 0.6, 0.05, "share of the transmitted force lost"),),
    signature="force residual opposes motion and grows with the motor force",
    confounders=("coulomb", "thermal_gain", "payload"),
    separate="the same speeds at several accelerations or loads",
)

EFFECTS = (
    VISCOUS,
    VISCOUS_DIRECTION,
    QUADRATIC_DRAG,
    COULOMB,
    COULOMB_POSITION,
    STRIBECK,
    PRESLIDING,
    LUGRE,
    FRICTION_VARIATION,
    LOAD_FRICTION,
)
