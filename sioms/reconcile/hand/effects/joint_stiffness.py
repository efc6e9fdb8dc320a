"""A revolute joint that is softer or stiffer than stated, behind its encoder."""

from __future__ import annotations

from sioms.reconcile.effect import Channel
from sioms.reconcile.hand.effects.pairs import GEOMETRY, STIFFNESS, both, stiffer

EFFECTS = both(
    "joint_stiffness",
    Channel.MECHANICS,
    "joint",
    stiffer,
    STIFFNESS,
    title="stiffness of joint {n} between encoder and finger",
    equation="k_{n} = stated k_{n} (1 + share)",
    signature="contacts that miss the object along the line of contacts, in proportion to the load",
    separate="each object under three loads or more, with both fingers rolled (phi1, phi2) apart",
    alike=(*GEOMETRY, "load_gain"),
)
