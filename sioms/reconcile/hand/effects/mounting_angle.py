"""A finger that is turned on its link."""

from __future__ import annotations

import math
from operator import add

from sioms.reconcile.effect import Channel
from sioms.reconcile.hand.effects.pairs import FINGERS, GEOMETRY, changed, others
from sioms.reconcile.sensors.effect import Quantity, SensorEffect


def of_finger(finger: int) -> SensorEffect:
    """Return the effect of one finger."""
    return SensorEffect(
        name=f"mounting_angle_{finger}",
        title=f"mounting angle of finger {finger}",
        channel=Channel.SENSOR,
        change=changed("mount", finger, add, "beta"),
        equation=f"place_{finger} = felt place_{finger} + beta",
        parameters=(
            Quantity("beta", "rad", -0.5, 0.5, math.radians(1.5), "by which the finger is turned, anti-clockwise"),
        ),
        signature="contacts that miss the object across the line of contacts, in proportion to its size",
        lookalikes=others(f"mounting_angle_{finger}", *GEOMETRY),
        separate="disks of two sizes or more, and a bar, with both fingers rolled (phi1, phi2) apart",
    )


EFFECTS = tuple(of_finger(finger) for finger in FINGERS)
