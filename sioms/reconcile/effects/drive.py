"""The actuator channel: what lies between the commanded and the acting force."""

from __future__ import annotations

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
    Slot,
    Trials,
)
from sioms.reconcile.jit import state_function


@state_function
def ripple_gain(x: Number, v: Number, u: Number, temperature: Number, p: Array) -> Number:
    """1 + depth sin(n theta + phase)."""
    return 1.0 + p[0] * np.sin(p[2] * p[TURN] * x + p[1])


def _late(row: Any, p: Array) -> None:
    row.delay = p[0]


def _lagging(row: Any, p: Array) -> None:
    row.lag = p[0]


def _limited(row: Any, p: Array) -> None:
    row.limit = p[0]


def _losing(row: Any, p: Array) -> None:
    row.loss, row.tau_t = p


#: First guesses: times [s] of delay and lag, limits over the largest force, thermal time constants [s].
GRID_LATE = (0.5e-3, 2e-3, 5e-3)
GRID_LIMIT = (0.95, 0.85, 0.7, 0.5, 0.3)
GRID_TAU = (3.0, 10.0, 40.0)

TORQUE_RIPPLE = Effect(
    name="torque_ripple",
    title="torque ripple",
    channel=Channel.ACTUATOR,
    slot=Slot.GAIN,
    function=ripple_gain,
    equation="F = u (1 + depth sin(n theta + phase))",
    parameters=(
        Parameter("depth", "1", Ref.ONE, 0.0, 0.6, 0.05, "relative ripple of the force constant"),
        Parameter("phase", "rad", Ref.ANGLE, -np.pi, np.pi, 0.0, "phase at position zero", phase=True),
        Parameter("n", "1/pitch", Ref.ONE, 1.0, 60.0, 1.0, "periods in a pitch", fixed=True),
    ),
    signature="periodic force residual in position, proportional to the motor force",
    confounders=("cogging", "eccentricity"),
    separate="one full turn with two loads",
)
DELAY = Effect(
    name="delay",
    title="transport delay",
    channel=Channel.ACTUATOR,
    mechanism=Mechanism(_late, lambda p, pitch: {"delay": {"delay_s": p[0]}}),
    trials=Trials(lambda seen: ({"delay": g} for g in GRID_LATE)),
    equation="F(t) = u(t - delay)",
    parameters=(Parameter("delay", "s", Ref.TIME, 0.0, 0.02, 1.5e-3, "delay of the command"),),
    signature="force residual with the rate of the command; measured current late by a constant time",
    confounders=("lag", "elastic"),
    separate="force steps, or a multi-sine up to the bandwidth",
)
LAG = Effect(
    name="lag",
    title="drive lag",
    channel=Channel.ACTUATOR,
    mechanism=Mechanism(_lagging, lambda p, pitch: {"lag": {"tau_s": p[0]}}),
    trials=Trials(lambda seen: ({"tau": g} for g in GRID_LATE)),
    equation="tau dF/dt = u - F",
    parameters=(Parameter("tau", "s", Ref.TIME, 0.0, 0.02, 1.5e-3, "time constant of the drive"),),
    signature="as a delay, with the fast part attenuated",
    confounders=("delay", "elastic"),
    separate="force steps",
)
SATURATION = Effect(
    name="saturation",
    title="force saturation",
    channel=Channel.ACTUATOR,
    mechanism=Mechanism(_limited, lambda p, pitch: {"saturation": {"limit": p[0]}}),
    trials=Trials(lambda seen: ({"limit": g * seen.force} for g in GRID_LIMIT), stretched=False),
    sized=False,
    equation="F = clip(u, -limit, limit)",
    parameters=(Parameter("limit", "{F}", Ref.FORCE, 0.02, 10.0, 0.5, "largest force"),),
    signature="force residual only where the command is large",
    confounders=("thermal_gain", "load_friction"),
    separate="force steps of growing height",
)
THERMAL_GAIN = Effect(
    name="thermal_gain",
    title="thermal loss of the force constant",
    channel=Channel.ACTUATOR,
    mechanism=Mechanism(_losing, lambda p, pitch: {}, warms=True),
    trials=Trials(lambda seen: ({"tau": g, "loss": 0.1} for g in GRID_TAU)),
    equation="F = u (1 - loss T), tau dT/dt = (u / rated)^2 - T",
    parameters=(
        Parameter("loss", "1", Ref.ONE, 0.0, 5.0, 0.1, "relative loss at steady rated heating"),
        Parameter("tau", "s", Ref.TIME, 0.5, 1e4, 10.0, "thermal time constant", soft=True),
    ),
    signature="force residual proportional to the motor force, growing with the heat put in",
    confounders=("payload", "load_friction", "saturation"),
    separate="the same record cold and warm, in both orders",
    session=("temperature at the start",),
)

EFFECTS = (TORQUE_RIPPLE, DELAY, LAG, SATURATION, THERMAL_GAIN)
