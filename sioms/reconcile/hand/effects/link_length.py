"""A link that is longer or shorter than stated."""

from __future__ import annotations

from operator import add

from sioms.reconcile.effect import Channel
from sioms.reconcile.hand.effects.pairs import FINGERS, GEOMETRY, changed, others
from sioms.reconcile.sensors.effect import Quantity, SensorEffect


def of_finger(finger: int) -> SensorEffect:
    """Return the effect of one finger."""
    return SensorEffect(
        name=f"link_length_{finger}",
        title=f"length of link {finger}",
        channel=Channel.MECHANICS,
        change=changed("link", finger, add, "dl"),
        equation=f"l_{finger} = stated l_{finger} + dl",
        parameters=(Quantity("dl", "m", -0.03, 0.03, 2e-3, "added to the stated length"),),
        signature="contacts that miss the object along the link, whatever its size and the load",
        lookalikes=others(f"link_length_{finger}", *GEOMETRY),
        separate="objects of two sizes or more, in several directions psi, with both fingers rolled (phi1, phi2) apart",
    )


EFFECTS = tuple(of_finger(finger) for finger in FINGERS)
