"""A revolute joint that is softer or stiffer than stated, behind its encoder."""

from __future__ import annotations

from sioms.reconcile.effect import Channel
from sioms.reconcile.hand.effects.pairs import FINGERS, GEOMETRY, changed, of_both, others
from sioms.reconcile.sensors.effect import Quantity, SensorEffect


def of_finger(finger: int) -> SensorEffect:
    """Return the effect of one finger."""
    return SensorEffect(
        name=f"joint_stiffness_{finger}",
        title=f"stiffness of joint {finger} between encoder and finger",
        channel=Channel.MECHANICS,
        change=changed("joint", finger, lambda k, share: k * (1.0 + share), "share"),
        equation=f"k_{finger} = stated k_{finger} (1 + share)",
        parameters=(Quantity("share", "1", -0.9, 9.0, 0.2, "relative departure of the stiffness"),),
        signature="contacts that miss the object along the line of contacts, in proportion to the load",
        lookalikes=(*others(f"joint_stiffness_{finger}", *GEOMETRY), *of_both("load_gain")),
        separate="each object under three loads or more, with both fingers rolled (phi1, phi2) apart",
    )


EFFECTS = tuple(of_finger(finger) for finger in FINGERS)
