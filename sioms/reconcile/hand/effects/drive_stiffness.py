"""A revolute drive that gives more or less than stated, between command and encoder."""

from __future__ import annotations

from sioms.reconcile.effect import Channel
from sioms.reconcile.hand.effects.pairs import STIFFNESS, both, stiffer

EFFECTS = both(
    "drive_stiffness",
    Channel.ACTUATOR,
    "drive",
    stiffer,
    STIFFNESS,
    title="stiffness of drive {n} between command and encoder",
    equation="k_{n} = stated k_{n} (1 + share)",
    signature="encoders that differ from their commands otherwise than the load makes them",
    separate="each object under three loads or more, the wrists' forces recorded with them",
    alike_there=("load_gain",),
)
