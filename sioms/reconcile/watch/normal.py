"""What is normal of an axis: its numbers in the commissioning phase, and how they vary there by themselves.

All vectors have the numbers of ``rows`` and then those of the reference: its place, its scale, the play there
and how late it is told [s].
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from sioms.reconcile.thresholds import (
    CARRIED,
    DAY_S,
    DEPENDENT,
    FEW_PUSHED,
    FEW_STEADY,
    FEWEST_BLOCKS,
    HEAT_DRY,
    HEAT_VISCOUS,
    IDLE_PLACE,
    IDLE_SCALE,
    IDLE_SHARE,
    IDLE_STEPS,
    MODEL_SHARE,
    MOST_LATE_S,
    MOST_PLACE,
    MOST_SCALE,
    SPEED_KNOWN,
    STUDENT,
    UNSEEN,
)

from .blocks import Block, solved
from .moves import Array
from .rows import CONSTANT, DRY, GAP, MASS, NAMES, SIZE, VISCOUS

ALL_NAMES = (*NAMES, "place", "scale", "play", "late")
TOTAL = len(ALL_NAMES)
PLACE, SCALE, PLAY, LATE = range(SIZE, SIZE + 4)
#: Blocks whose numbers together are compared, and the least number of such groups.
GROUP, LEAST_GROUPS = 6, 10
#: Numbers by which blocks from before and after a change differ.
FRICTIONS = (VISCOUS, DRY, CONSTANT)
#: A variance beyond all: the number is not known.
UNKNOWN = 1e12
#: Crossings within this share of the travel are of one edge.
ONE_EDGE = 0.01


@dataclass(frozen=True, slots=True)
class Normal:
    """What is normal.

    Attributes:
        theta: numbers, shape (TOTAL,), those of the reference zero.
        own: covariance of their own variation, and of how well they are known, shape (TOTAL, TOTAL).
        noise: variance of a force that the model leaves, with its correlation, [N^2].
        force: root mean square of the force that moves the axis [N].
        per: force of each number's unit: root mean squares of the columns, shape (SIZE,).
        loads: whether moves carry different masses; least, most: of the masses.
        edges: places of the reference's edges; scatter: of a crossing.
        error: mean square following error.
        blocks: learnt from; until_s: of the axis's clock.
        turned: play that crossings show in which inertia pushes one way or the other; loose: how far apart an edge is
            passed at steady speeds; NaN where none tell it.
    """

    theta: Array
    own: Array
    noise: float
    force: float
    per: Array
    loads: bool
    least: float
    most: float
    edges: tuple[float, ...]
    scatter: float
    error: float
    blocks: int
    until_s: float
    turned: float = np.nan
    loose: float = np.nan


@dataclass(frozen=True, slots=True)
class Estimate:
    """Numbers of some blocks and their covariance, without the axis's own variation.

    A number that no move tells has UNKNOWN, one of the reference that no crossing tells the most that it may be.
    ``left`` is the mean square of force that the model leaves; ``gram`` and ``rows`` are of the blocks. ``turned`` is
    where edges are passed while inertia pushes the load back and forth, off their places, and the standard deviation of
    the difference; ``by_way``: share of what sets edges apart by the way of the motion that is in it, and ``by_speed``
    what a reference that is late by a second makes of it. ``loose``: how far apart an edge is passed at steady speeds;
    ``pace``: root mean square of these.
    """

    theta: Array
    noise: Array
    left: float
    gram: Array
    rows: int
    turned: tuple[float, float, float] = (np.nan, np.nan, np.inf)
    loose: float = np.nan
    by_way: float = 0.0
    by_speed: float = 0.0
    pace: float = np.nan


def estimate(
    blocks: Sequence[Block], loads: bool, edges: Sequence[float], scatter: float, noise: float, travel: float
) -> Estimate:
    """Return the numbers of some blocks.

    Args:
        loads: each move has a mass of its own; that of the lightest is told.
        edges, scatter: of the reference; travel: of the axis.
        noise: variance of a row; what these blocks leave, or by how much they differ, counts if it is more.
    """
    gram, rows = np.sum([b.gram for b in blocks], axis=0), sum(b.rows for b in blocks)
    theta, cover = np.zeros(TOTAL), np.zeros((TOTAL, TOTAL))
    if loads:
        kept = np.arange(SIZE) != MASS
        found, inverse, left = solved(np.sum([b.freed for b in blocks], axis=0))
        at = np.flatnonzero(kept)
        theta[at] = found
        masses = np.array([b.least for b in blocks if np.isfinite(b.least)])
        theta[MASS] = float(np.mean(masses)) if len(masses) else 0.0
        told = float(np.var(masses)) / len(masses) if len(masses) > 2 else UNKNOWN
    else:
        found, inverse, left = solved(gram)
        at = np.arange(SIZE)
        theta[:SIZE] = found
    left = left / max(rows - SIZE, 1)
    row = max(noise, DEPENDENT * left) + MODEL_SHARE**2 * float(gram[-1, -1])
    cover[np.ix_(at, at)] = row * inverse
    if loads:  # a move's mass is what the other numbers leave: their errors are in it
        beside = gram[MASS, at] / gram[MASS, MASS] if gram[MASS, MASS] > 0.0 else np.zeros(len(at))
        cover[MASS, at] = cover[at, MASS] = -row * (inverse @ beside)
        cover[MASS, MASS] = told + row * float(beside @ inverse @ beside)
    few = [int(np.flatnonzero(at == number)[0]) for number in FRICTIONS]
    apart = max(_apart(blocks, loads, theta[list(FRICTIONS)]) - row, 0.0)
    cover[np.ix_(FRICTIONS, FRICTIONS)] += apart * inverse[np.ix_(few, few)]
    _refer(blocks, edges, scatter, travel, theta, cover)
    turned, by_way, by_speed = _turned(blocks, edges, scatter)
    loose = _loose(blocks, edges)
    return Estimate(theta, cover, left, gram, rows, turned, loose, by_way, by_speed, _pace(blocks))


def _pace(blocks: Sequence[Block]) -> float:
    """Return the root mean square speed at which edges are passed steadily, NaN where none are."""
    speeds = [c.speed for b in blocks for c in b.crossings if abs(c.way) == 1]
    return float(np.sqrt(np.mean(np.square(speeds)))) if speeds else np.nan


def _loose(blocks: Sequence[Block], edges: Sequence[float]) -> float:
    """Return how far apart an edge is passed at steady speeds; NaN where there are too few.

    A load that one flank pushes and the other brakes is passed at both, whichever way the axis goes; the mean of each
    way lies between them.
    """
    places = np.array([c.place for b in blocks for c in b.crossings if abs(c.way) == 1])
    if not edges or not len(places):
        return np.nan
    off = places[:, None] - np.array(edges)
    nearest = np.abs(off).argmin(axis=1)
    sides = [np.sort(off[nearest == k, k]) for k in range(len(edges))]
    return max((float(side[-2] - side[1]) for side in sides if len(side) >= FEW_STEADY), default=np.nan)


def _turned(
    blocks: Sequence[Block], edges: Sequence[float], scatter: float
) -> tuple[tuple[float, float, float], float, float]:
    """Return how far off edges are passed while the axis is accelerated backwards and forwards, the standard deviation
    of the difference, and what of a difference by the way, and by the speed, of the motion would be in it.

    Inertia then holds the load at one flank or the other, whatever bears at steady speed; a shift of the reference is
    the same for both.
    """
    pushed = [(c.place, np.sign(c.way), c.speed) for b in blocks for c in b.crossings if abs(c.way) == 2]
    if not edges or not pushed:
        return (np.nan, np.nan, np.inf), 0.0, 0.0
    places, ways, speeds = np.array(pushed, dtype=np.float64).T
    off = places - np.array(edges)[np.abs(places[:, None] - np.array(edges)).argmin(axis=1)]
    sides = [off[ways == way] for way in (-1.0, 1.0)]
    if min(map(len, sides)) < FEW_PUSHED:
        return (np.nan, np.nan, np.inf), 0.0, 0.0
    by_way, by_speed = (
        float(np.mean(each[ways == 1.0]) - np.mean(each[ways == -1.0])) for each in (0.5 * np.sign(speeds), speeds)
    )
    free = sum(map(len, sides)) - 2
    left = float(np.sum(np.concatenate([s - np.mean(s) for s in sides]) ** 2)) / free
    spread = max(float(np.sqrt(left)), scatter) * (1.0 + STUDENT / free)
    back, forth = (float(np.mean(side)) for side in sides)
    return (back, forth, spread * float(np.sqrt(sum(1.0 / len(s) for s in sides)))), by_way, by_speed


def _apart(blocks: Sequence[Block], loads: bool, together: Array) -> float:
    """Return the variance of a row that would make blocks as different as they are, in frictions and constant force.

    Blocks from before and after a change, of moves at different speeds, have sums of which neither friction comes out,
    and that with a small error; it is seen by each block alone.

    Args:
        together: FRICTIONS of all of them.
    """
    n = len(blocks)
    if n < 2:
        return 0.0
    few = [number - 1 if loads else number for number in FRICTIONS]
    squares = []
    for block in blocks:
        theta, inverse, _ = solved(block.freed if loads else block.gram)
        off = theta[few] - together
        squares.append(float(off @ np.linalg.solve(inverse[np.ix_(few, few)], off)) / len(few))
    return float(np.mean(squares)) * n / (n - 1)


def _refer(
    blocks: Sequence[Block], edges: Sequence[float], scatter: float, travel: float, theta: Array, cover: Array
) -> None:
    """Fill in the numbers of the reference; what its crossings do not tell apart stays so, by covariance.

    One edge tells the place and so much times the scale together, crossings in one way the place and half the play,
    crossings at one speed the play and how late the reference is told.
    """
    most = _most(travel)
    cover[SIZE:, SIZE:] = np.diag(most**2)
    steady = [(c.place, c.way, c.speed) for b in blocks for c in b.crossings if abs(c.way) == 1]
    places = np.array(steady, dtype=np.float64).reshape(-1, 3)
    if not edges or len(places) < 4:
        return
    marks = np.array(edges)[np.abs(places[:, :1] - np.array(edges)).argmin(axis=1)]
    off = places[:, 0] - marks
    error = np.sqrt(max(scatter, 1e-12) ** 2 + (SPEED_KNOWN * off) ** 2)
    x = np.column_stack([np.ones(len(off)), marks, 0.5 * places[:, 1], places[:, 2]]) / error[:, None]
    q, r = np.linalg.qr(np.vstack([x, np.diag(1.0 / most)]))
    back = np.linalg.inv(r)
    theta[SIZE:] = back @ (q[: len(off)].T @ (off / error))
    cover[SIZE:, SIZE:] = back @ back.T


def _most(travel: float) -> Array:
    return np.array([MOST_PLACE * travel, MOST_SCALE, MOST_PLACE * travel, MOST_LATE_S])


def _limits(travel: float) -> Array:
    """Return the variances from which on numbers are not told."""
    return np.concatenate([np.full(SIZE, 0.5 * UNKNOWN), 0.25 * _most(travel) ** 2])


def learn(blocks: Sequence[Block], travel: float, step: float) -> Normal:
    """Learn what is normal from the blocks of the commissioning phase.

    Args:
        travel: of the axis [m or rad]; step: of its encoder.

    Raises:
        ValueError: there are too few.
    """
    if len(blocks) < FEWEST_BLOCKS:
        raise ValueError(f"learn what is normal: {len(blocks)} blocks of motion; needs {FEWEST_BLOCKS} or more")
    least = np.array([b.least for b in blocks if np.isfinite(b.least)])
    most = np.array([b.most for b in blocks if np.isfinite(b.most)])
    low, high = (float(np.min(least)), float(np.max(most))) if len(least) else (0.0, 0.0)
    spread = float(np.median(most - least)) if len(least) else 0.0
    loads = len(least) > 0 and spread > CARRIED * abs(float(np.median(least)))
    edges, scatter = _edges(blocks, travel, step)
    whole = estimate(blocks, loads, edges, scatter, 0.0, travel)
    noise = _noise(blocks, loads, edges, scatter, whole.left)
    whole = estimate(blocks, loads, edges, scatter, noise, travel)
    theta = whole.theta.copy()
    per = np.sqrt(np.diag(whole.gram)[:SIZE] / whole.rows)
    force = float(np.sqrt(whole.gram[-1, -1] / whole.rows))
    own = _own(blocks, loads, edges, scatter, noise, travel, theta)
    floor = np.zeros(TOTAL)
    floor[:SIZE] = IDLE_SHARE * force / np.maximum(per, 1e-300)
    floor[[PLACE, PLAY]] = IDLE_PLACE * travel + IDLE_STEPS * step + scatter
    floor[SCALE] = IDLE_SCALE
    floor[LATE] = floor[PLAY] / whole.pace if whole.pace > 0.0 else 0.0
    back, forth, _ = whole.turned
    told = np.diag(whole.noise) < _limits(travel)  # what the reference does not tell is nothing by definition
    told[[PLACE, PLAY, LATE]] |= bool(edges)  # together they are told, for the ways and speeds of these crossings
    unseen = max(0.0, 1.0 - (blocks[-1].end_s - blocks[0].start_s) / DAY_S)
    heat = np.zeros(TOTAL)
    heat[[VISCOUS, DRY]] = HEAT_VISCOUS * theta[VISCOUS], HEAT_DRY * theta[DRY]
    known = whole.noise * np.outer(told, told)
    return Normal(
        theta, known + UNSEEN * own + np.diag(floor**2 + unseen * heat**2), noise, force, per, loads, low, high,
        edges, scatter, float(np.mean([b.error for b in blocks])), len(blocks), blocks[-1].end_s,
        forth - back, whole.loose,
    )  # fmt: skip


def _edges(blocks: Sequence[Block], travel: float, step: float) -> tuple[tuple[float, ...], float]:
    """Return the places of the reference's edges and the scatter of a crossing about its side of an edge."""
    all_ = sorted((c.place, c.way, c.speed) for b in blocks for c in b.crossings if abs(c.way) == 1)
    if len(all_) < 8:
        return (), 0.0
    places, ways, speeds = np.array(all_, dtype=np.float64).T
    groups = np.split(np.arange(len(places)), np.flatnonzero(np.diff(places) > ONE_EDGE * travel) + 1)
    edges, left = [], []
    for group in groups:
        if len(group) < 4:
            continue
        sides = _at_mean_speed([(places[group][on], speeds[group][on]) for on in (ways[group] < 0, ways[group] > 0)])
        means = [float(np.median(side)) for side in sides if len(side)]
        edges.append(float(np.mean(means)))
        left += [side - np.median(side) for side in sides if len(side)]
    scatter = float(np.std(np.concatenate(left))) if left else 0.0
    return tuple(edges), max(scatter, 0.3 * step)


def _at_mean_speed(sides: list[tuple[Array, Array]]) -> list[Array]:
    """Return where an edge is passed either way, as at the mean speed of that way: a late reference tells it the later
    in place, the faster the axis goes.

    Args:
        sides: places and speeds of each way.
    """
    off = [(p - np.mean(p), v - np.mean(v)) if len(p) else (p, v) for p, v in sides]
    known = sum(float(v @ v) for _, v in off)
    late_s = sum(float(p @ v) for p, v in off) / known if known > 0.0 else 0.0
    return [place - late_s * v for (place, _), (_, v) in zip(sides, off, strict=True)]


def _noise(blocks: Sequence[Block], loads: bool, edges: Sequence[float], scatter: float, left: float) -> float:
    """Return the variance of a row that makes neighbouring blocks as different as they are."""
    each = [estimate([b], loads, edges, scatter, 0.0, 1.0) for b in blocks]
    ratios = []
    for one, two in pairwise(each):
        change = (two.theta - one.theta)[:GAP]
        expected = (np.diag(one.noise) + np.diag(two.noise))[:GAP]
        ratios.append(change[1:4] ** 2 / np.maximum(expected[1:4], 1e-300))
    return DEPENDENT * left * max(1.0, float(np.median(ratios)) / 0.45)  # the median of a squared normal deviate


def _own(
    blocks: Sequence[Block],
    loads: bool,
    edges: Sequence[float],
    scatter: float,
    noise: float,
    travel: float,
    theta: Array,
) -> Array:
    """Return the covariance of how the numbers vary by themselves, over minutes, beyond what noise explains."""
    few = GROUP if len(blocks) >= LEAST_GROUPS * GROUP else max(len(blocks) // LEAST_GROUPS, 1)
    groups = [blocks[i : i + few] for i in range(0, len(blocks) - few + 1, few)]
    each = [estimate(g, loads, edges, scatter, noise, travel) for g in groups]
    covers = np.stack([e.noise for e in each])
    told = np.stack([np.diag(c) < _limits(travel) for c in covers])
    off = np.where(told, np.stack([e.theta for e in each]) - theta, 0.0)
    spread = np.where(told, np.stack([np.diag(c) for c in covers]), np.nan)
    with np.errstate(invalid="ignore"):
        usual = np.array([np.median(c[np.isfinite(c)]) if np.isfinite(c).any() else np.inf for c in spread.T])
        poor = np.nanmax(np.where(told, spread / usual, 1.0), axis=1)
    # groups that hardly tell a number do not tell how it varies
    weight = 1.0 / np.maximum(poor, 1.0) ** 2
    both = told[:, :, None] & told[:, None, :]
    share = np.where(both, weight[:, None, None], 0.0)
    total = np.maximum(share.sum(axis=0), 1e-300)
    excess = np.sum(share * (off[:, :, None] * off[:, None, :] - np.where(both, covers, 0.0)), axis=0) / total
    size = np.sqrt(np.maximum(np.diag(np.sum(share * off[:, :, None] * off[:, None, :], axis=0) / total), 1e-300))
    values, vectors = np.linalg.eigh(excess / np.outer(size, size))
    return np.asarray((vectors * np.maximum(values, 0.0)) @ vectors.T * np.outer(size, size))
