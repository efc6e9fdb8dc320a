"""A finger that tells another load than there is."""

from __future__ import annotations

from operator import add

from sioms.reconcile.effect import Channel
from sioms.reconcile.hand.effects.pairs import both
from sioms.reconcile.sensors.effect import Quantity

EFFECTS = both(
    "load_gain",
    Channel.SENSOR,
    "gain",
    add,
    Quantity("g", "1", -0.8, 4.0, 0.1, "relative departure of the load"),
    title="scale of the load that finger {n} tells",
    equation="told load_{n} = (1 + g) load_{n}",
    signature="loads that differ from those of the wrist, or of the other finger, in proportion",
    separate="the wrists' forces recorded with the loads",
    alike=("load_gain",),
    alike_there=("drive_stiffness", "joint_stiffness"),
)
