"""From the samples of a move to rows of a linear model of force.

    u = M a + b v + Fc sgn v + c + l j + g s - m w'' + (what the model file says beside)

a, v, j, s: derivatives of the measured position; w: where the motor stands in the play before the load, of three
sizes, so that m is the mass behind the play: that mass makes the gap's way beside the motor whenever the force turns.
l and g take up what a late drive and a transmission that yields leave, so that they pass for nothing else. All
columns and the force go through the same Gaussian filter, which keeps the equation true of the filtered ones; rows
are taken a width apart, at steady speed all together.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from .moves import Array, Flags, Samples

#: The numbers of an axis that moves tell, in the order of all vectors.
NAMES = ("mass", "viscous", "dry", "constant", "lag", "give", "gap0", "gap1", "gap2")
SIZE = len(NAMES)
MASS, VISCOUS, DRY, CONSTANT, LAG, GIVE, GAP = range(7)
#: Width of the filter [s], and the least in samples; it reaches so many widths to either side.
WIDTH_S, LEAST_WIDTH, REACH = 0.008, 3.0, 4.0
#: Rows are this share of a width apart.
APART = 1.0
#: Below this share of the greatest speed of a move nothing is said of friction; and below this one of the axis.
SLOW, SLOW_EVER = 0.06, 0.01
#: A flank pushes clearly where the acceleration passes this share of its greatest value in the move.
TURNS = 0.15
#: What is farther away than so many widths hardly counts.
NEAR = 2.5
#: A commanded speed that changes by less than this share of the greatest is steady.
STEADY = 0.01
#: Sizes of play that the columns are made for, of the travel of the axis.
PLAYS = np.array([2e-4, 6e-4, 1.8e-3])

Known = Callable[[Array, Array, Array], Array]


@dataclass(frozen=True, slots=True)
class Rows:
    """One move.

    Attributes:
        x: regressors by NAMES, shape (n, SIZE); y: forces, shape (n,).
        error: mean square of the following error [m^2 or rad^2].
        seconds: of motion.
        at_s: of its end; fastest: greatest speed; place: mean position.
    """

    x: Array
    y: Array
    error: float
    seconds: float
    at_s: float
    fastest: float
    place: float


@lru_cache(maxsize=8)
def kernels(width: float) -> Array:
    """Return a Gaussian and its four derivatives as weights of samples, shape (taps, 5).

    Args:
        width: standard deviation in samples.
    """
    reach = int(np.ceil(REACH * width))
    t = np.arange(-reach, reach + 1, dtype=np.float64)
    h = np.exp(-0.5 * (t / width) ** 2)
    powers = np.vander(t / width, 7, increasing=True)
    # weights h p(t), p a polynomial, that give the derivatives of all polynomials up to the sixth degree of t exactly
    # where a Gaussian's would: moments as of the continuous filter
    moments = powers.T @ (h[:, None] * powers)
    wanted = np.zeros((7, 5))
    even = [1.0, 0.0, 1.0, 0.0, 3.0, 0.0, 15.0]
    for order in range(5):
        for power in range(order, 7):
            falling = float(np.prod(np.arange(power - order + 1, power + 1)))
            wanted[power, order] = falling * even[power - order] / width**order
    weights = h[:, None] * (powers @ np.linalg.solve(moments, wanted))
    weights.setflags(write=False)
    return np.asarray(weights)


def rows_of(move: Samples, tick_s: float, greatest_speed: float, gaps: Array, known: Known | None) -> Rows | None:
    """Return the rows of a move, None where it is too short or too slow to tell anything.

    Args:
        greatest_speed: of the axis so far.
        gaps: sizes of play that the last columns are of [m or rad], shape (3,).
        known: (position, velocity, force) -> force that the model explains beside the columns, shape (n,).
    """
    width = max(WIDTH_S / tick_s, LEAST_WIDTH)
    k = kernels(width)
    taps, stride = len(k), max(round(APART * width), 1)
    if len(move) < 2 * taps:
        return None
    x = move.position - move.position[0]
    force = move.force.copy()
    force[1:] = 0.5 * (move.force[1:] + move.force[:-1])  # held over a tick: its middle is between two readings
    windows = np.lib.stride_tricks.sliding_window_view
    taken = windows(x, taps)[::stride] @ k
    taken[:, 1:] /= tick_s ** np.arange(1, 5)
    u = windows(force, taps)[::stride] @ k[:, 0]
    speed = np.convolve(x, k[::-1, 1], "valid") / tick_s
    acceleration = np.convolve(x, k[::-1, 2], "valid") / tick_s**2
    fastest = float(np.max(np.abs(speed)))
    least = max(SLOW * fastest, SLOW_EVER * greatest_speed)
    if fastest < 4.0 * SLOW_EVER * greatest_speed or fastest <= 0.0:
        return None
    half = taps // 2
    way = np.sign(_spread(speed, half))
    wind = wind_up(x, _spread(speed, half), _spread(acceleration, half), gaps, tick_s)
    bears = -(k[:, 2] @ windows(wind, taps, axis=0)[::stride].transpose(0, 2, 1)) / tick_s**2
    sign = windows(way, taps)[::stride] @ k[:, 0]
    v = taken[:, 1]
    table = np.column_stack([taken[:, 2], v, sign, np.ones(len(v)), taken[:, 3], taken[:, 4], bears])
    if known is not None:
        u = u - known(taken[:, 0] + move.position[0], v, u)
    # where the axis stood within the filter's reach, dry friction was whatever held it
    near = round(NEAR * width)
    slowest = np.abs(windows(_spread(speed, half), taps)[::stride, half - near : half + near + 1]).min(axis=1)
    good = (np.abs(v) > least) & (slowest > SLOW_EVER * greatest_speed)
    if np.count_nonzero(good) < SIZE + 1:
        return None
    error = move.command - move.position
    commanded = windows(move.speed, taps)[::stride]
    rows = _together(np.column_stack([table, u]), good, np.ptp(commanded, axis=1) < STEADY * fastest)
    return Rows(
        rows[:, :-1], rows[:, -1], float(np.mean(error**2)), len(move) * tick_s, float(move.time_s[-1]), fastest,
        float(np.mean(move.position)),
    )  # fmt: skip


def _together(rows: Array, good: Flags, steady: Flags) -> Array:
    """Make one row of each stretch of steady speed, with the weight of all of them.

    There only disturbances change the speed, and they change the force, too: row by row the one seems to follow from
    the other.
    """
    level = good & steady
    bounds = np.flatnonzero(np.diff(level.astype(np.int8), prepend=0, append=0)).reshape(-1, 2)
    means = [rows[first:last].sum(axis=0) / np.sqrt(last - first) for first, last in bounds.tolist()]
    return np.vstack([rows[good & ~steady], *means])


def _spread(values: Array, half: int) -> Array:
    """Give what was filtered its length again."""
    return np.concatenate([np.full(half, values[0]), values, np.full(half, values[-1])])


def wind_up(x: Array, speed: Array, acceleration: Array, gaps: Array, tick_s: float) -> Array:
    """Return where in its play the motor stands before the load, shape (n, gaps), [m or rad].

    One flank pushes the load until the acceleration turns. Then the load goes on by itself, until what the motor loses
    on it has passed the play and the other flank pushes. Before the first push that flank bears already.
    """
    clear = np.abs(acceleration) > TURNS * float(np.max(np.abs(acceleration)))
    sign = np.sign(acceleration)
    pushes = np.flatnonzero(clear)
    half = 0.5 * gaps
    wind = np.broadcast_to(half * sign[pushes[0]], (len(x), len(gaps))).copy()
    for before, after in zip(pushes[:-1].tolist(), pushes[1:].tolist(), strict=True):
        if sign[before] == sign[after]:
            continue
        start = after - int(np.argmax(sign[after::-1] != sign[after])) + 1
        lost = x[start:] - x[start] - speed[start] * tick_s * np.arange(len(x) - start)
        wind[start:] = np.clip(wind[start] + lost[:, None], -half, half)
    return wind
