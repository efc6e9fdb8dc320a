"""A revolute drive that gives more or less than stated, between command and encoder."""

from __future__ import annotations

from sioms.reconcile.effect import Channel
from sioms.reconcile.hand.effects.pairs import FINGERS, changed
from sioms.reconcile.sensors.effect import Quantity, SensorEffect


def of_finger(finger: int) -> SensorEffect:
    """Return the effect of one finger."""
    return SensorEffect(
        name=f"drive_stiffness_{finger}",
        title=f"stiffness of drive {finger} between command and encoder",
        channel=Channel.ACTUATOR,
        change=changed("drive", finger, lambda k, share: k * (1.0 + share), "share"),
        equation=f"k_{finger} = stated k_{finger} (1 + share)",
        parameters=(Quantity("share", "1", -0.9, 9.0, 0.2, "relative departure of the stiffness"),),
        signature="encoders that differ from their commands otherwise than the load makes them",
        lookalikes=(f"load_gain_{finger}",),
        separate="each object under three loads or more, the wrists' forces recorded with them",
    )


EFFECTS = tuple(of_finger(finger) for finger in FINGERS)
