"""What a finger feels, from the numbers of its `shape` node, and the internal force that two fingers tell."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

from sioms.hand.touch import Felt
from sioms.tactile.quality import Quality, State, state_of
from sioms.tactile.sensing import CHANNELS

_AT = {name: index for index, (name, _, _) in enumerate(CHANNELS)}
TOUCHED, ANGLE, LOAD = _AT["touched"], _AT["angle"], _AT["load"]
_RADIUS, _QUALITY = _AT["equivalent_radius"], _AT["quality"]
_VAR_ANGLE, _VAR_RADIUS = _AT["var_angle"], _AT["var_radius"]
_NO_FLAGS = Felt(False)


def no_shape(node: str, channels: Sequence[str]) -> str:
    """Say why a node does not tell what a finger feels, from the names of its channels; '' when it does."""
    if tuple(channels) == tuple(_AT):
        return ""
    return (
        f"{node}: its channels are {', '.join(channels[:4])}{', ...' if len(channels) > 4 else ''}; want the node "
        "shape of a finger that has a calibration (sioms tactile calibrate)"
    )


def felt(shape: Sequence[float], length_m: float) -> Felt:
    """Return what a finger feels.

    Args:
        shape: the channels of its `shape` node (`sioms.tactile.sensing.CHANNELS`).
        length_m: of the contact along the finger: force over line load.
    """
    touched, told = shape[TOUCHED], shape[_QUALITY]
    if not math.isfinite(told) or told % 1.0 or (touched not in (0.0, 1.0) and not math.isnan(touched)):
        return Felt(None)  # strains, of which a finger has as many
    quality = Quality(int(told))
    state = state_of(quality)
    if state is State.UNTOUCHED or Quality.WRONG_SIGN in quality:
        return _NO_FLAGS
    if state is State.BLIND:
        return Felt(None)
    angle, load = shape[ANGLE], shape[LOAD]
    if not math.isfinite(angle + load):  # too light to be told
        return _NO_FLAGS
    doubt = quality.name or "" if state is State.DOUBTFUL else ""
    return Felt(
        True, angle, math.sqrt(max(shape[_VAR_ANGLE], 0.0)), load * length_m, shape[_RADIUS],
        math.sqrt(max(shape[_VAR_RADIUS], 0.0)), doubt,
    )  # fmt: skip


def lightly(touched: float, force: float, mean: Felt) -> Felt:
    """Return what a finger feels of a touch too light for a single frame of its own.

    Args:
        touched: 1 while something touches, 0 while nothing, nan while that is not known; with `force` [N] as the node
            ``touch`` of a hand shows it.
        force: with which it presses.
        mean: what the mean of many frames feels; the place is its own.
    """
    if touched not in (0.0, 1.0) or not math.isfinite(force) or mean.touched is None:
        return Felt(None)
    if not touched:
        return _NO_FLAGS
    return replace(mean, force=force) if mean.touched else Felt(True, force=force)


def internal_force(one: Felt, two: Felt) -> float | None:
    """Return the internal force that both fingers tell [N]: 0 unless both are touched, None if one is blind."""
    if one.touched is None or two.touched is None:
        return None
    return 0.5 * (one.force + two.force) if one.touched and two.touched else 0.0


def wrist_force(one: Sequence[float], two: Sequence[float], psi: float, contact_n: float) -> float:
    """Return the internal force that wrist sensors tell [N], 0 unless both bear more than `contact_n` of it.

    Args:
        one, two: fx, fy of the object on each finger, along the axes of the platen [N].
        psi: direction of the line of centres [rad].
        contact_n: what a sensor shows without contact.
    """
    c, s = math.cos(psi), math.sin(psi)
    first, second = -(one[0] * c + one[1] * s), two[0] * c + two[1] * s
    return 0.5 * (first + second) if first > contact_n and second > contact_n else 0.0
