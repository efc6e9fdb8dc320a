"""The library of effects of a hand: one file each, for finger 1 and finger 2.

A user's package lists a ``SensorEffect`` (or a tuple of them) under the entry-point group ``sioms.effects.hand``;
``HandBelief.responding`` takes a function of the grasps.
"""

from __future__ import annotations

from functools import cache

from sioms.reconcile.hand.effects import (
    drive_stiffness,
    friction,
    joint_stiffness,
    link_length,
    load_gain,
    mounting_angle,
    terms,
)
from sioms.reconcile.library import collect
from sioms.reconcile.sensors.effect import SensorEffect

GROUP = "sioms.effects.hand"
BUILT_IN = (
    *link_length.EFFECTS,
    *mounting_angle.EFFECTS,
    *joint_stiffness.EFFECTS,
    *drive_stiffness.EFFECTS,
    *load_gain.EFFECTS,
    *friction.EFFECTS,
)


@cache
def library() -> dict[str, SensorEffect]:
    """Return every known effect of a hand, and the nameless terms."""
    return {**collect(GROUP, BUILT_IN), **{t.name: t for t in terms.TERMS}}
