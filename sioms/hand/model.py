"""What a hand is known to be, beyond what is stated: the file that its driver loads (``model_file``).

``sioms reconcile hand`` writes it, corrected by what it named in recorded grasps:

    [hand]
    link_m = [0.142, 0.14]           # from the revolute axis to the finger's centre
    mount_rad = [0.0, 0.026]         # by which each finger is turned on its link, anti-clockwise
    joint_stiffness = [3.0, 2.4]     # N m/rad, between encoder and finger; inf where none gives
    load_gain = [0.0, 0.0]           # relative departure of the load that a finger tells
    friction = 1.3                   # the least coefficient, to be relied on

One number stands for both fingers. Without input or output.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace

from sioms.documents import toml_of
from sioms.hand.contacts import LEAST_FRICTION
from sioms.hand.kinematics import LINK_M, Hand
from sioms.hand.touch import Felt

Pair = tuple[float, float]


@dataclass(frozen=True, slots=True)
class HandModel:
    """A hand; immutable. Pairs are of finger 1 and finger 2.

    Args:
        link_m: from the revolute axis to the finger's centre, > 0.
        mount_rad: angle by which a finger is turned on its link.
        joint_stiffness: of a link and its finger behind the encoder of its axis [N m/rad], > 0.
        load_gain: relative departure of the load that a finger tells, > -1.
        friction: least coefficient, > 0.
    """

    link_m: Pair = (LINK_M, LINK_M)
    mount_rad: Pair = (0.0, 0.0)
    joint_stiffness: Pair = (math.inf, math.inf)
    load_gain: Pair = (0.0, 0.0)
    friction: float = LEAST_FRICTION

    def __post_init__(self) -> None:
        for name, low in (("link_m", 0.0), ("joint_stiffness", 0.0), ("load_gain", -1.0)):
            if not all(low < one for one in getattr(self, name)):
                raise ValueError(f"describe hand: {name} is {getattr(self, name)}; want above {low:g}")
        numbers = (*self.link_m, *self.mount_rad, *self.load_gain, self.friction)
        if not all(map(math.isfinite, numbers)) or not self.friction > 0.0:
            raise ValueError(f"describe hand: {self}; want finite numbers, and friction above 0")

    def maps(self, least_m: float = 1e-6) -> Hand:
        """Return its maps of joints and coordinates."""
        return Hand(*self.link_m, least_m)

    def corrected(self, felt: Felt, index: int) -> Felt:
        """Return what a finger (0 or 1) feels, its place in the angle of its link and its load as it truly is."""
        return replace(felt, phi=felt.phi + self.mount_rad[index], force=felt.force / (1.0 + self.load_gain[index]))


KEYS = tuple(f.name for f in fields(HandModel))


def model_of(text: str, stated: HandModel = HandModel()) -> HandModel:
    """Read a model; what it does not say is as stated.

    Raises:
        ValueError: it is none; the message says what is wrong.
    """
    table = toml_of(text)
    hand = table.get("hand")
    if set(table) != {"hand"} or not isinstance(hand, dict):
        raise ValueError(f"its tables are {', '.join(sorted(table)) or 'none'}; want [hand] alone")
    if odd := sorted(set(hand) - set(KEYS)):
        raise ValueError(f"[hand]: nobody reads {', '.join(odd)}; known are {', '.join(KEYS)}")
    pairs = {key: _pair(key, value) for key, value in hand.items()}
    friction = pairs.pop("friction", (stated.friction,) * 2)[0]
    return replace(stated, **pairs, friction=friction)


def _pair(key: str, value: object) -> Pair:
    many = value if isinstance(value, list) and key != "friction" else [value, value]
    numbers = [float(one) for one in many if isinstance(one, int | float) and not isinstance(one, bool)]
    if len(many) != 2 or len(numbers) != 2:
        raise ValueError(f"[hand]: {key} is {value!r}; want a number" + (", or two" if key != "friction" else ""))
    return numbers[0], numbers[1]


def to_toml(model: HandModel) -> str:
    """Write a model; `model_of` reads it."""
    lines = ["[hand]"]
    for key in KEYS:
        value = getattr(model, key)
        lines.append(f"{key} = {list(value) if isinstance(value, tuple) else value!r}")
    return "\n".join(lines) + "\n"
