"""Draw the position commands of an axis, each from rest at zero."""

from __future__ import annotations

import numpy as np
from numba import njit

from sioms.reconcile_selftest.axis import Array, Axis

#: The travel to either side [rad | m].
REACH = {True: 3.0 * np.pi, False: 0.12}
#: Amplitudes of the small swings, in pitches.
SWINGS = {True: (0.06, 0.03, 0.015, 0.008), False: (0.12, 0.06, 0.03, 0.015)}


def commands(axis: Axis, seconds: float) -> list[Array]:
    """Draw the commands of the four records, and a fifth like the second for what is held out."""
    rng, dt = axis.rng(1), axis.sample_s
    t: Array = np.arange(round(seconds / dt), dtype=np.float64) * dt
    a, reach = 0.45 * axis.rated / axis.inertia, REACH[axis.rotary]
    waves = [_waves(t, dt, 0.6 * reach, 0.9 * axis.speed, rng) for _ in range(2)]
    if axis.excitation == "cruise":
        v = 0.35 * axis.speed
        cruise = _profile(np.where(np.sin(2 * np.pi * t / 4.0) >= 0, v, -v), dt, a)
        return [*[cruise] * 4, waves[1]]
    if axis.excitation == "oneway":
        return [*(_oneway(t, dt, 0.4 * axis.speed, rng) for _ in range(4)), waves[1]]
    if axis.excitation == "small":
        return [*(_waves(t, dt, 0.2, 0.3 * axis.speed, rng) for _ in range(4)), waves[1]]
    legs, signs = rng.uniform(0.3, 0.9, 24), np.where(np.arange(24) % 2 == 0, 1.0, -1.0)
    steps = np.repeat(signs * rng.choice([0.0, 1.0, 1.0], 24), (legs / dt).astype(int))[: len(t)]
    ladder = np.repeat([0.2, -0.35, 0.6, -0.8, 0.95, -0.15, 0.45, -0.6], len(t) // 8 + 1)[: len(t)]
    return [
        _fold(_profile(steps * 0.8 * axis.speed, dt, a), reach),
        waves[0],
        _slowly(t, axis, a),
        _fold(_profile(ladder * axis.speed, dt, a), reach),
        waves[1],
    ]


def _slowly(t: Array, axis: Axis, acceleration: float) -> Array:
    """Reverse slowly, swing by less and less, reverse more slowly still."""
    share = t / (t[-1] + axis.sample_s)
    v = 0.05 * axis.speed * np.sign(np.sin(2 * np.pi * t / 2.2 + 0.1)) * np.where(share < 0.3, 1.0, 0.4)
    x = _profile(np.where((share >= 0.3) & (share < 0.6), 0.0, v), axis.sample_s, acceleration)
    part = (share - 0.3) / 0.3 * 4.0
    inside = (part >= 0.0) & (part < 4.0)
    size = np.array(SWINGS[axis.rotary])[np.clip(part, 0, 3).astype(int)] * axis.pitch
    # one and a half periods each, from and to rest at the middle
    swing = size * np.sin(1.5 * 2 * np.pi * (part % 1.0)) * np.sin(np.pi * (part % 1.0))
    return np.asarray(x + np.where(inside, swing, 0.0))


@njit(cache=True)
def _profile(speed: Array, dt: float, acceleration: float) -> Array:
    """Follow a speed with limited acceleration."""
    v, out, step = 0.0, np.empty_like(speed), acceleration * dt
    for i, goal in enumerate(speed):
        v += min(max(goal - v, -step), step)
        out[i] = v
    return np.cumsum(out) * dt


def _oneway(t: Array, dt: float, speed: float, rng: np.random.Generator) -> Array:
    """Move forward with a speed that swings."""
    turn = 2 * np.pi * np.cumsum(rng.uniform(0.5, 2.0, len(t))) * dt + rng.uniform(0, 6)
    v = speed * (1.0 + 0.5 * np.sin(turn)) * np.minimum(t / 0.15, 1.0)
    return np.asarray(np.cumsum(v) * dt)


def _fold(x: Array, reach: float) -> Array:
    """Shrink a path that leaves the range."""
    top = float(np.max(np.abs(x)))
    return x if top <= 2.0 * reach else x * 2.0 * reach / top


def _waves(t: Array, dt: float, reach: float, speed: float, rng: np.random.Generator) -> Array:
    f = rng.uniform(0.4, 6.0, 7)
    x = np.sum(np.sin(2 * np.pi * f[:, None] * t + rng.uniform(0, 6.28, 7)[:, None]) / f[:, None], axis=0)
    x = (x - x[0]) * np.minimum(t / 0.3, 1.0) ** 2
    top = np.max(np.abs(np.gradient(x, dt)))
    return np.asarray(x * min(speed / top, reach / np.max(np.abs(x))))
