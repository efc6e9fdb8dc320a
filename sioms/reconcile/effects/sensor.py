"""The sensor channel: what lies between the true and the measured position."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from sioms.reconcile.effect import Array, Channel, Effect, Mechanism, Parameter, Ref, Seen, Trials


def _scaled(row: Any, p: Array) -> None:
    row.gain_y = p[0]


def _eccentric(row: Any, p: Array) -> None:
    row.ecc_amp, row.ecc_phase = p


def _coarse(row: Any, p: Array) -> None:
    row.quantum *= p[0]


def _erring(row: Any, p: Array) -> None:
    row.err_amp, row.err_phase, row.err_n = p


#: First guess of an error within the signal period, over that, and how often this comes in a pitch where nothing tells.
OF_PERIOD, USUAL = 0.02, 64


def _waves(seen: Seen) -> Iterator[dict[str, float]]:
    for n in seen.waves or (USUAL,):
        for phase in GRID_PHASE:
            yield {"amp": OF_PERIOD / n * seen.scales["amp"], "phase": float(phase), "n": float(n)}


#: First guesses of the eccentricity: phases, and sizes where impacts come to fall differently with each.
GRID_PHASE = np.linspace(-np.pi, np.pi, 9)[1:]
SIZES = (1.0, 0.7, 0.4)


def _runouts(seen: Seen) -> Iterator[dict[str, float]]:
    for share in SIZES if seen.bounces else SIZES[:1]:
        for phase in GRID_PHASE:
            yield {"amp": share * 1e-3 * seen.scales["amp"], "phase": float(phase)}


ENCODER_SCALE = Effect(
    name="encoder_scale",
    title="encoder scale",
    channel=Channel.SENSOR,
    mechanism=Mechanism(_scaled, lambda p, pitch: {"encoder_scale": {"gain": p[0]}}),
    trials=Trials(lambda seen: ({"gain": 1.01},)),
    neutral=1.0,
    equation="measured = gain * true",
    parameters=(
        Parameter(
            "gain",
            "1",
            Ref.ONE,
            0.8,
            1.25,
            1.0,
            "measured over true displacement",
            least=0.02,  # by the force alone: as of a payload
        ),
    ),
    signature="index marks at a wrong spacing; force residual as from a wrong inertia",
    confounders=("payload", "thermal_gain"),
    separate="index marks over the whole range, or a known mass",
)
ECCENTRICITY = Effect(
    name="eccentricity",
    title="encoder eccentricity",
    channel=Channel.SENSOR,
    mechanism=Mechanism(
        _eccentric,
        lambda p, pitch: {"encoder_eccentricity": {"amplitude": p[0], "pitch": pitch, "phase": p[1]}},
    ),
    trials=Trials(_runouts),
    equation="measured = true + amp sin(theta + phase)",
    parameters=(
        Parameter("amp", "{x}", Ref.PITCH, 0.0, 0.02, 1e-3, "amplitude of the reading error"),
        Parameter("phase", "rad", Ref.ANGLE, -np.pi, np.pi, 0.0, "phase at position zero", phase=True),
    ),
    signature="apparent speed ripple once a turn, with the square of speed in force",
    confounders=("gravity", "torque_ripple", "cogging"),
    separate="full turns at several speeds",
)
INTERPOLATION_ERROR = Effect(
    name="interpolation_error",
    title="encoder that errs within its signal period",
    channel=Channel.SENSOR,
    mechanism=Mechanism(
        _erring,
        lambda p, pitch: {"encoder_interpolation": {"amplitude": p[0], "pitch": pitch / p[2], "phase": p[1]}},
    ),
    trials=Trials(_waves),
    equation="measured = true + amp sin(n theta + phase)",
    parameters=(
        Parameter("amp", "{x}", Ref.PITCH, 0.0, 0.01, 3e-4, "amplitude of the reading error"),
        Parameter("phase", "rad", Ref.ANGLE, -np.pi, np.pi, 0.0, "phase at position zero", phase=True),
        Parameter("n", "1/pitch", Ref.ONE, 16.0, 4096.0, 64.0, "signal periods in a pitch", fixed=True),
    ),
    signature="wave of the position in the position, of one size at all speeds; taken for noise of the sensor",
    confounders=("cogging", "torque_ripple"),
    separate="slow motion over some signal periods, and full turns at several speeds",
)
ENCODER_QUANTISATION = Effect(
    name="encoder_quantisation",
    title="coarser encoder than stated",
    channel=Channel.SENSOR,
    mechanism=Mechanism(_coarse, lambda p, pitch: {"encoder_quantisation": {"factor": p[0]}}),
    trials=Trials(lambda seen: ({},)),
    equation="counts come in multiples of factor",
    parameters=(Parameter("factor", "1", Ref.ONE, 1.0, 4096.0, 1.0, "true over stated resolution", fixed=True),),
    signature="only multiples of a number in the counts",
    confounders=("backlash",),
    separate="slow motion in one direction",
)

EFFECTS = (ENCODER_SCALE, ECCENTRICITY, INTERPOLATION_ERROR, ENCODER_QUANTISATION)
