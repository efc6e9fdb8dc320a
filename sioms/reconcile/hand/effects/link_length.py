"""A link that is longer or shorter than stated."""

from __future__ import annotations

from operator import add

from sioms.reconcile.effect import Channel
from sioms.reconcile.hand.effects.pairs import GEOMETRY, both
from sioms.reconcile.sensors.effect import Quantity

EFFECTS = both(
    "link_length",
    Channel.MECHANICS,
    "link",
    add,
    Quantity("dl", "m", -0.03, 0.03, 2e-3, "added to the stated length"),
    title="length of link {n}",
    equation="l_{n} = stated l_{n} + dl",
    signature="contacts that miss the object along the link, whatever its size and the load",
    separate="objects of two sizes or more, in several directions psi, with both fingers rolled (phi1, phi2) apart",
    alike=GEOMETRY,
)
