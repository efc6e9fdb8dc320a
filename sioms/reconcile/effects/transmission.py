"""Transmission and load: what sits behind the motor."""

from __future__ import annotations

from sioms.reconcile.effect import Channel, Effect, Parameter, Ref, Slot

ELASTIC = Effect(
    name="elastic",
    title="elastic transmission (two masses)",
    channel=Channel.MECHANICS,
    slot=Slot.ELASTIC,
    equation="J (1-r) am = u - k (xm-xl) - d (vm-vl), J r al = k (xm-xl) + d (vm-vl); "
    "k = (2 pi f_res)^2 J r (1-r), d = 2 zeta sqrt(k J r (1-r))",
    parameters=(
        Parameter("f_res", "Hz", Ref.FREQUENCY, 2.0, 300.0, 20.0, "resonance of the free pair"),
        Parameter("load_fraction", "1", Ref.ONE, 0.03, 0.97, 0.5, "share of the inertia behind the spring"),
        # what does not ring is no elastic transmission: a bristle's damping, or a lead in time, passes for one of 0.3 to 1
        Parameter("zeta", "1", Ref.ONE, 0.0, 0.3, 0.05, "damping ratio"),
    ),
    signature="force residual concentrated around one frequency, whatever the position",
    lookalikes=("delay", "lag", "backlash", "payload"),
    separate="a multi-sine across the resonance at two amplitudes",
    replaces=("backlash",),
)
BACKLASH = Effect(
    name="backlash",
    title="backlash",
    channel=Channel.MECHANICS,
    slot=Slot.BACKLASH,
    equation="the load moves freely within +-gap/2 of the motor and follows in contact",
    parameters=(
        Parameter("gap", "{x}", Ref.PITCH, 1e-5, 0.2, 3e-3, "free play"),
        Parameter("load_fraction", "1", Ref.ONE, 0.03, 0.97, 0.5, "share of the inertia behind the gap"),
        Parameter(
            "f_contact", "Hz", Ref.FREQUENCY, 20.0, 400.0, 120.0, "stiffness of the contact, as a resonance"
        ),
        Parameter("zeta", "1", Ref.ONE, 0.0, 2.0, 0.05, "damping ratio of the contact"),
    ),
    signature="bursts of force residual after every reversal of force",
    lookalikes=("stribeck", "presliding", "elastic"),
    separate="force reversals of several amplitudes about rest",
    replaces=("elastic",),
)
PAYLOAD = Effect(
    name="payload",
    title="payload inertia",
    channel=Channel.MECHANICS,
    slot=Slot.INERTIA,
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
    lookalikes=("encoder_scale", "thermal_gain", "elastic"),
    separate="index marks, or a known added mass",
)

EFFECTS = (ELASTIC, BACKLASH, PAYLOAD)
