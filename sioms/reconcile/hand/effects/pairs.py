"""What effects of one finger share: names with the finger's number, and a change of one number of a pair."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from sioms.reconcile.hand.belief import HandBelief
from sioms.reconcile.hand.grasps import Floats
from sioms.reconcile.sensors.effect import Values

FINGERS = (1, 2)
GEOMETRY = ("link_length", "mounting_angle", "joint_stiffness")


def of_both(*names: str) -> tuple[str, ...]:
    """Return the names of effects with the number of either finger."""
    return tuple(f"{name}_{finger}" for name in names for finger in FINGERS)


def others(name: str, *names: str) -> tuple[str, ...]:
    """Return the names of effects of both fingers, less one."""
    return tuple(n for n in of_both(*names) if n != name)


def changed(what: str, finger: int, by: Callable[[Floats, float], Floats], symbol: str) -> Callable[..., HandBelief]:
    """Return the change of a belief that sets one number of a pair.

    Args:
        what: the pair, by its name in the belief.
        by: number and parameter to the new number.
    """

    def change(b: HandBelief, v: Values) -> HandBelief:
        pair = getattr(b, what).copy()
        pair[finger - 1] = by(pair[finger - 1], float(v[symbol][0]))
        return replace(b, **{what: pair})

    return change
