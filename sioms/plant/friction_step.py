"""One step of masses under a constant force with viscous and dry friction; the theory is in friction.py."""

from __future__ import annotations

import math
from typing import Final

from sioms.native.language import Floats, Record, step

# Turns the surplus over stiction into a direction without disturbing any velocity that matters.
TINY: Final = 1e-200
SERIES_BELOW: Final = 1e-2


class Friction(Record):
    """n masses; arrays (n,), those with a velocity's and a position's row (2 n).

    ``state``: velocities [m/s], then positions [m]. ``force`` [N] is held over the step, ``resistance`` is dry friction
    added to ``sliding`` and breakaway (``plus``, ``minus`` its negative), ``variation`` a factor on both.
    ``of_velocity`` and ``of_force``: what the old velocity and the net force contribute, mean of both directions and
    half of the difference. ``fresh`` is the state after the step.
    """

    n: int
    time_s: float
    mass: Floats
    viscous_plus: Floats
    viscous_minus: Floats
    state: Floats
    force: Floats
    resistance: Floats
    variation: Floats
    plus: Floats
    minus: Floats
    sliding: Floats
    sliding_half: Floats
    velocity_mean: Floats
    velocity_half: Floats
    force_mean: Floats
    force_half: Floats
    fresh: Floats


@step
def phi1(z: float) -> float:
    """Return (1 - exp(-z)) / z, accurate for any z >= 0."""
    if z < SERIES_BELOW:
        return 1.0 - z * (1 / 2 - z / 6.0 * (1.0 - z / 4.0 * (1.0 - z / 5.0 * (1.0 - z / 6.0 * (1.0 - z / 7.0)))))
    return -math.expm1(-z) / z


@step
def phi2(z: float) -> float:
    """Return (z - 1 + exp(-z)) / z^2, by its series where the difference would cancel."""
    if z < SERIES_BELOW:
        return 1 / 2 - z / 6.0 * (1.0 - z / 4.0 * (1.0 - z / 5.0 * (1.0 - z / 6.0 * (1.0 - z / 7.0))))
    return (1.0 + math.expm1(-z) / z) / z


@step
def stop_and_reverse(f: Friction, i: int, net: float) -> int:
    """Step a mass that comes to rest within the step: up to the stop, then rest or the way back."""
    mass = f.mass[i]
    force = f.force[i]
    velocity = f.state[i]
    viscous = f.viscous_plus[i] if velocity > 0.0 else f.viscous_minus[i]
    # Time to rest: (m/b) ln(1 - b v/N), which is -m v/N for b = 0.
    z = -viscous * velocity / net
    ratio = 1.0 - z / 2.0 if z < 1e-8 else math.log1p(z) / z
    stop_s = min(-mass * velocity / net * ratio, f.time_s)
    z = viscous * stop_s / mass
    place = f.state[f.n + i] + stop_s * phi1(z) * velocity + stop_s * stop_s / mass * phi2(z) * net
    back = 1.0 if force > 0.0 else -1.0
    hold = (f.plus[i] if force > 0.0 else -f.minus[i]) * f.variation[i] + f.resistance[i]
    level = (back * f.sliding_half[i] + f.sliding[i]) * f.variation[i] + f.resistance[i]
    left_s = f.time_s - stop_s
    left = force - back * level if abs(force) > hold else 0.0
    z = (f.viscous_plus[i] if force > 0.0 else f.viscous_minus[i]) * left_s / mass
    f.fresh[i] = left_s / mass * phi1(z) * left
    f.fresh[f.n + i] = place + left_s * left_s / mass * phi2(z) * left
    return 0


@step
def glide(f: Friction) -> int:
    """Step all masses into ``fresh``; return how many went through rest."""
    n = f.n
    count = 0
    for i in range(n):
        force = f.force[i]
        velocity = f.state[i]
        most = f.plus[i] * f.variation[i] + f.resistance[i]
        least = f.minus[i] * f.variation[i] - f.resistance[i]
        toward = (force - max(min(force, most), least)) * TINY + velocity
        d = 1.0 if toward > 0.0 else (-1.0 if toward < 0.0 else 0.0)
        # (F d - c) d is F - c d for a moving mass and 0 for one that sticks (d = 0).
        level = (d * f.sliding_half[i] + f.sliding[i]) * f.variation[i]
        net = (force * d - level - f.resistance[i]) * d
        j = n + i
        speed = (d * f.velocity_half[i] + f.velocity_mean[i]) * velocity + (d * f.force_half[i] + f.force_mean[i]) * net
        way = (d * f.velocity_half[j] + f.velocity_mean[j]) * velocity + (d * f.force_half[j] + f.force_mean[j]) * net
        f.fresh[i] = speed
        f.fresh[j] = way + f.state[j]
        if speed * d < 0.0:
            stop_and_reverse(f, i, net)
            count += 1
    return count


@step
def keep(f: Friction) -> int:
    """Make the step that was worked out the state."""
    for i in range(2 * f.n):
        f.state[i] = f.fresh[i]
    return 0
