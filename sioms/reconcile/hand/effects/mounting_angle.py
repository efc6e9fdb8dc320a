"""A finger that is turned on its link."""

from __future__ import annotations

import math
from operator import add

from sioms.reconcile.effect import Channel
from sioms.reconcile.hand.effects.pairs import GEOMETRY, both
from sioms.reconcile.sensors.effect import Quantity

EFFECTS = both(
    "mounting_angle",
    Channel.SENSOR,
    "mount",
    add,
    Quantity("beta", "rad", -0.5, 0.5, math.radians(1.5), "by which the finger is turned, anti-clockwise"),
    title="mounting angle of finger {n}",
    equation="place_{n} = felt place_{n} + beta",
    signature="contacts that miss the object across the line of contacts, in proportion to its size",
    separate="disks of two sizes or more, and a bar, with both fingers rolled (phi1, phi2) apart",
    alike=GEOMETRY,
)
