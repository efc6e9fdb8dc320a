"""The sensor channel: what lies between the true and the measured position."""

from __future__ import annotations

import numpy as np

from sioms.reconcile.effect import Channel, Effect, Parameter, Ref, Slot

ENCODER_SCALE = Effect(
    name="encoder_scale",
    title="encoder scale",
    channel=Channel.SENSOR,
    slot=Slot.SCALE,
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
    lookalikes=("payload", "thermal_gain"),
    separate="index marks over the whole range, or a known mass",
)
ECCENTRICITY = Effect(
    name="eccentricity",
    title="encoder eccentricity",
    channel=Channel.SENSOR,
    slot=Slot.ECCENTRICITY,
    equation="measured = true + amp sin(theta + phase)",
    parameters=(
        Parameter("amp", "{x}", Ref.PITCH, 0.0, 0.02, 1e-3, "amplitude of the reading error"),
        Parameter("phase", "rad", Ref.ANGLE, -np.pi, np.pi, 0.0, "phase at position zero", phase=True),
    ),
    signature="apparent speed ripple once a turn, with the square of speed in force",
    lookalikes=("gravity", "torque_ripple", "cogging"),
    separate="full turns at several speeds",
)
ENCODER_QUANTISATION = Effect(
    name="encoder_quantisation",
    title="coarser encoder than stated",
    channel=Channel.SENSOR,
    slot=Slot.LATTICE,
    equation="counts come in multiples of factor",
    parameters=(
        Parameter("factor", "1", Ref.ONE, 1.0, 4096.0, 1.0, "true over stated resolution", fixed=True),
    ),
    signature="only multiples of a number in the counts",
    lookalikes=("backlash",),
    separate="slow motion in one direction",
)

EFFECTS = (ENCODER_SCALE, ECCENTRICITY, ENCODER_QUANTISATION)
