"""Fingers that yield, each by itself: how fast the hand may go into what a finger feels.

    speed of finger i into what it feels  <=  K (f_most - f_i)

Above the greatest force a finger retreats, below it goes on as it is told: nothing is pressed by an error that wants to
be brought back, and nothing swings, since a finger that has retreated comes again only when it is told to. The link
keeps its direction while its finger yields, the carriages move it. Pure: rates and forces in, rates out.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

from sioms.hand.kinematics import Six


class Push(NamedTuple):
    """What a finger feels.

    Args:
        force: with which it presses [N], >= 0.
        angle: from the finger into what it presses on, in the axes of the platen [rad].
    """

    force: float
    angle: float


def push_of(fx: float, fy: float) -> Push:
    """Return what a finger feels on which an object acts with this force [N]."""
    return Push(math.hypot(fx, fy), math.atan2(-fy, -fx))


def yielded(
    rates: Sequence[float], at: Sequence[float], pushes: Sequence[Push | None], most_n: float, damper: float,
    fastest: float,
) -> Six:  # fmt: skip
    """Return the rates of x, y, psi, d, phi1, phi2 at which no finger goes too fast into what it feels.

    Args:
        rates: as wanted [m/s, rad/s].
        at: the six coordinates.
        pushes: what fingers 1 and 2 feel; None: nothing.
        most_n: greatest force of each [N].
        damper: K [m/(s N)].
        fastest: with which a finger retreats [m/s].
    """
    x, y, psi, d, phi1, phi2 = rates
    c, s = math.cos(at[2]), math.sin(at[2])
    for sign, push in zip((-1.0, 1.0), pushes, strict=True):
        if push is None:
            continue
        nx, ny = math.cos(push.angle), math.sin(push.angle)
        along, across = 0.5 * sign * d, 0.5 * sign * at[3] * psi
        speed = (x + along * c - across * s) * nx + (y + along * s + across * c) * ny
        excess = speed - max(damper * (most_n - push.force), -fastest)
        if excess <= 0.0:
            continue
        bx, by = -excess * nx, -excess * ny
        x, y, d = x + 0.5 * bx, y + 0.5 * by, d + sign * (bx * c + by * s)
        turn = sign * (by * c - bx * s) / at[3]
        psi, phi1, phi2 = psi + turn, phi1 + turn, phi2 + turn
    return x, y, psi, d, phi1, phi2
