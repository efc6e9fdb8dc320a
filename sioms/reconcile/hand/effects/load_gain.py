"""A finger that tells another load than there is."""

from __future__ import annotations

from operator import add

from sioms.reconcile.effect import Channel
from sioms.reconcile.hand.effects.pairs import FINGERS, changed, of_both
from sioms.reconcile.sensors.effect import Quantity, SensorEffect


def of_finger(finger: int) -> SensorEffect:
    """Return the effect of one finger."""
    other = of_both("load_gain")[2 - finger]
    return SensorEffect(
        name=f"load_gain_{finger}",
        title=f"scale of the load that finger {finger} tells",
        channel=Channel.SENSOR,
        change=changed("gain", finger, add, "g"),
        equation=f"told load_{finger} = (1 + g) load_{finger}",
        parameters=(Quantity("g", "1", -0.8, 4.0, 0.1, "relative departure of the load"),),
        signature="loads that differ from those of the wrist, or of the other finger, in proportion",
        lookalikes=(f"drive_stiffness_{finger}", f"joint_stiffness_{finger}", other),
        separate="the wrists' forces recorded with the loads",
    )


EFFECTS = tuple(of_finger(finger) for finger in FINGERS)
