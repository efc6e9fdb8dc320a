"""What effects of one finger share: names with the finger's number, and a change of one number of a pair."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from sioms.reconcile.effect import Channel
from sioms.reconcile.hand.belief import HandBelief
from sioms.reconcile.hand.grasps import Floats
from sioms.reconcile.sensors.effect import Quantity, SensorEffect, Values

FINGERS = (1, 2)
GEOMETRY = ("link_length", "mounting_angle", "joint_stiffness")
STIFFNESS = Quantity("share", "1", -0.9, 9.0, 0.2, "relative departure of the stiffness")


def stiffer(stiffness: Floats, share: float) -> Floats:
    """Return a stiffness that departs from the stated one by a share of it."""
    return stiffness * (1.0 + share)


def of_both(*names: str) -> tuple[str, ...]:
    """Return the names of effects with the number of either finger."""
    return tuple(f"{name}_{finger}" for name in names for finger in FINGERS)


def both(
    name: str, channel: Channel, pair: str, by: Callable[[Floats, float], Floats], quantity: Quantity, *, title: str,
    equation: str, signature: str, separate: str, alike: tuple[str, ...] = (), alike_there: tuple[str, ...] = (),
) -> tuple[SensorEffect, ...]:  # fmt: skip
    """Return an effect of finger 1 and the same of finger 2; `{n}` in its texts is the finger's number.

    Args:
        pair: what it changes, by its name in the belief.
        by: number of the pair and parameter to the new number.
        quantity: the parameter.
        alike: names, without number, of effects of either finger that look like it.
        alike_there: of the same finger only.
    """

    def of(finger: int) -> SensorEffect:
        own = f"{name}_{finger}"
        likes = (*(like for like in of_both(*alike) if like != own), *(f"{like}_{finger}" for like in alike_there))
        return SensorEffect(
            name=own, title=title.format(n=finger), channel=channel, parameters=(quantity,), confounders=likes,
            change=changed(pair, finger, by, quantity.symbol), equation=equation.format(n=finger),
            signature=signature.format(n=finger), separate=separate,
        )  # fmt: skip

    return tuple(of(finger) for finger in FINGERS)


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
