"""Transmission and load: what sits behind the motor."""

from __future__ import annotations

from typing import Any

import numpy as np

from sioms.reconcile.effect import Array, Channel, Effect, Mechanism, Parameter, Ref, Trials

#: First guesses: resonances [Hz] and shares of the inertia, gaps over the pitch.
GRID_RESONANCE = (7.0, 11.0, 16.0, 24.0, 36.0, 55.0)
GRID_SWING = (0.3, 0.5, 0.8, 1.3)
GRID_LOAD = (0.3, 0.6)
GRID_GAP = tuple(float(g) for g in np.geomspace(3e-4, 0.18, 24))
#: A contact that bounces makes a cost of many minima; started with one that does not, it would not find all that do.
#: The best few gaps of the first contact are tried with the others.
CONTACTS = tuple({"load_fraction": f, "zeta": z} for f, z in ((0.4, 0.3), (0.6, 0.3), (0.4, 0.05), (0.6, 0.05)))


def _elastic(row: Any, p: Array) -> None:
    _couple(row, p[1], p[0], p[2])


def _loose(row: Any, p: Array) -> None:
    _couple(row, p[1], p[2], p[3])
    row.gap = p[0]


def _couple(row: Any, r: float, hz: float, zeta: float) -> None:
    """Part the inertia; write stiffness and damping of the transmission."""
    reduced = row.inertia * r * (1.0 - r)
    row.load, row.stiff = r, (2.0 * np.pi * hz) ** 2 * reduced
    row.damp = 2.0 * zeta * np.sqrt(row.stiff * reduced)


def _heavier(row: Any, p: Array) -> None:
    row.inertia += p[0]


def _elastic_twin(p: Array, pitch: float) -> dict[str, dict[str, float]]:
    return {"elastic": {"frequency_hz": p[0], "load_fraction": p[1], "damping": p[2]}}


def _loose_twin(p: Array, pitch: float) -> dict[str, dict[str, float]]:
    return {"backlash": {"gap": p[0], "load_fraction": p[1], "frequency_hz": p[2], "damping": p[3]}}


ELASTIC = Effect(
    name="elastic",
    title="elastic transmission (two masses)",
    channel=Channel.MECHANICS,
    mechanism=Mechanism(_elastic, _elastic_twin, last=True, substeps=4),
    trials=Trials(
        lambda seen: ({"f_res": g, "load_fraction": f} for g in GRID_RESONANCE for f in GRID_LOAD),
        kept=2,
        stretched=False,
    ),
    sized=False,
    takes=(("f_res", "f_contact"),),  # a contact that is never left
    equation="J (1-r) am = u - k (xm-xl) - d (vm-vl), J r al = k (xm-xl) + d (vm-vl); "
    "k = (2 pi f_res)^2 J r (1-r), d = 2 zeta sqrt(k J r (1-r))",
    parameters=(
        Parameter("f_res", "Hz", Ref.FREQUENCY, 2.0, 300.0, 20.0, "resonance of the free pair"),
        Parameter("load_fraction", "1", Ref.ONE, 0.03, 0.97, 0.5, "share of the inertia behind the spring"),
        # what does not ring is no elastic transmission: a bristle's damping, or a lead in time, passes for one of 0.3
        # to 1
        Parameter("zeta", "1", Ref.ONE, 0.0, 0.3, 0.05, "damping ratio"),
    ),
    signature="force residual concentrated around one frequency, whatever the position",
    confounders=("delay", "lag", "backlash", "payload", "swinging_load"),
    separate="a multi-sine across the resonance at two amplitudes",
    replaces=("backlash", "swinging_load"),
)
SWINGING_LOAD = Effect(
    name="swinging_load",
    title="load that swings or sloshes (slow second mass)",
    channel=Channel.MECHANICS,
    mechanism=Mechanism(_elastic, _elastic_twin, last=True),
    trials=Trials(
        lambda seen: ({"f_res": g, "load_fraction": f} for g in GRID_SWING for f in GRID_LOAD),
        kept=2,
        stretched=False,
    ),
    sized=False,
    equation="as two masses: (1-r) J hold the axis, r J hang on it and swing about it at f_res",
    parameters=(
        # slower than that it does not come back within a record: it is a mass, or a force along the way
        Parameter(
            "f_res", "Hz", Ref.FREQUENCY, 0.15, 2.0, 0.8, "frequency of the pair, the axis let go", vanishes=True
        ),
        Parameter("load_fraction", "1", Ref.ONE, 0.03, 0.97, 0.3, "share of the inertia that swings"),
        Parameter("zeta", "1", Ref.ONE, 0.0, 0.3, 0.02, "damping ratio"),
    ),
    signature="force residual at one low frequency that goes on after the axis has stopped",
    confounders=("elastic", "payload", "spring"),
    separate="short moves, and rests of several periods after them",
    replaces=("elastic", "backlash"),
)
BACKLASH = Effect(
    name="backlash",
    title="backlash",
    channel=Channel.MECHANICS,
    mechanism=Mechanism(_loose, _loose_twin, last=True, substeps=6, bounces=True),
    trials=Trials(
        lambda seen: ({"gap": g * seen.pitch, **CONTACTS[0]} for g in GRID_GAP),
        further=CONTACTS[1:],
        kept=2,
        stretched=False,
    ),
    equation="the load moves freely within +-gap/2 of the motor and follows in contact",
    parameters=(
        Parameter("gap", "{x}", Ref.PITCH, 1e-5, 0.2, 3e-3, "free play", steps=1.0),
        Parameter("load_fraction", "1", Ref.ONE, 0.03, 0.97, 0.5, "share of the inertia behind the gap", soft=True),
        Parameter(
            "f_contact",
            "Hz",
            Ref.FREQUENCY,
            20.0,
            400.0,
            120.0,
            "stiffness of the contact, as a resonance",
            soft=True,
        ),
        Parameter("zeta", "1", Ref.ONE, 0.0, 2.0, 0.05, "damping ratio of the contact", soft=True),
    ),
    signature="bursts of force residual after every reversal of force",
    confounders=("stribeck", "presliding", "elastic"),
    separate="force reversals of several amplitudes about rest",
    replaces=("elastic", "swinging_load"),
)
PAYLOAD = Effect(
    name="payload",
    title="payload inertia",
    channel=Channel.MECHANICS,
    mechanism=Mechanism(_heavier, lambda p, pitch: {}),
    trials=Trials(lambda seen: ({},)),
    equation="(J + J_extra) a = F",
    parameters=(
        Parameter(
            "J_extra",
            "{F} s^2/{x}",
            Ref.INERTIA,
            -0.8,
            20.0,
            0.1,
            "added inertia; negative where the nominal model has too much",
            least=0.02,  # below it dry friction passes for it
        ),
    ),
    signature="force residual proportional to acceleration",
    confounders=("encoder_scale", "thermal_gain", "elastic"),
    separate="index marks, or a known added mass",
)

EFFECTS = (ELASTIC, SWINGING_LOAD, BACKLASH, PAYLOAD)
