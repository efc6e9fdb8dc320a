"""Moves of some twenty seconds of motion together: sums of squares, from which the numbers of an axis follow by
themselves.

Sums add up, so any run of blocks gives its numbers without a look at samples again. What is carried may differ from
move to move: of each block there is a second set of sums in which every move has a mass of its own.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from sioms.reconcile.thresholds import MASS_TOLD

from .moves import Array
from .rows import MASS, SIZE, Rows

#: Motion and moves of a block, and the longest time one may take [s].
MOTION_S, MOVES, LONGEST_S = 20.0, 6, 3600.0
#: Share of the moves that tell the least and the greatest mass; crossings that are kept of a block.
EXTREME, MOST_CROSSINGS = 0.25, 64


@dataclass(frozen=True, slots=True)
class Crossing:
    """The edge of a reference, as the axis reads its place: [m or rad].

    ``way``: -1 or 1, the way of the motion, at a steady speed; -2 or 2 where the axis accelerates that way, so that a
    load behind a play is pushed that way. ``speed``: of the axis, with its sign [m/s or rad/s].
    """

    place: float
    way: int
    speed: float


@dataclass(frozen=True, slots=True)
class Block:
    """Sums over some moves.

    Attributes:
        start_s, end_s, motion_s: when, and how long the axis moved.
        rows: how many.
        gram: of columns and force, shape (SIZE + 1, SIZE + 1).
        freed: the same without what the mass of each move explains, shape (SIZE, SIZE): no mass in it.
        least, most: mean mass of the lightest and of the heaviest moves; NaN where no move tells it.
        error: mean square following error.
        crossings: of the reference.
    """

    start_s: float
    end_s: float
    motion_s: float
    rows: int
    gram: Array
    freed: Array
    least: float
    most: float
    error: float
    crossings: tuple[Crossing, ...] = ()


@dataclass(slots=True)
class Collector:
    """Adds moves up to blocks. Use from one thread."""

    moves: list[tuple[Rows, Array]] = field(default_factory=list)
    crossings: list[Crossing] = field(default_factory=list)

    def cross(self, crossing: Crossing) -> None:
        """Take a crossing."""
        if len(self.crossings) < MOST_CROSSINGS:
            self.crossings.append(crossing)

    def add(self, rows: Rows) -> Block | None:
        """Take a move; return the block that it completes."""
        table = np.column_stack([rows.x, rows.y])
        self.moves.append((rows, table.T @ table))
        first, motion = self.moves[0][0], sum(r.seconds for r, _ in self.moves)
        enough = motion >= MOTION_S and len(self.moves) >= MOVES
        if not enough and rows.at_s - first.at_s < LONGEST_S:
            return None
        block = _block([r for r, _ in self.moves], [g for _, g in self.moves], tuple(self.crossings))
        self.moves, self.crossings = [], []
        return block


def _block(moves: list[Rows], grams: list[Array], crossings: tuple[Crossing, ...]) -> Block:
    all_ = np.stack(grams)
    freed, told = np.zeros((SIZE, SIZE)), []
    keep = np.arange(SIZE + 1) != MASS
    for gram in all_:
        own, cross = gram[MASS, MASS], gram[MASS, keep]
        freed += gram[np.ix_(keep, keep)] - (np.outer(cross, cross) / own if own > 0.0 else 0.0)
    others = solved(freed)[0]
    for rows, gram in zip(moves, all_, strict=True):
        own = gram[MASS, MASS]
        free = gram[MASS, keep]
        mass = (free[-1] - free[:-1] @ others) / own if own > 0.0 else np.nan
        left = (
            float(np.mean((rows.y - rows.x[:, keep[:-1]] @ others - mass * rows.x[:, MASS]) ** 2)) if own > 0 else 1.0
        )
        if own > 0.0 and mass * mass * own > MASS_TOLD * left:
            told.append(float(mass))
    told.sort()
    few = max(1, round(EXTREME * len(told)))
    seconds = sum(r.seconds for r in moves)
    return Block(
        moves[0].at_s - moves[0].seconds, moves[-1].at_s, seconds, sum(len(r.y) for r in moves), all_.sum(axis=0),
        freed,
        float(np.mean(told[:few])) if told else np.nan, float(np.mean(told[-few:])) if told else np.nan,
        sum(r.error * r.seconds for r in moves) / seconds, crossings,
    )  # fmt: skip


def solved(gram: Array, weak: float = 1e-9) -> tuple[Array, Array, float]:
    """Return the numbers that sums of squares tell, the inverse of their normal matrix, and the squares that are left.

    Args:
        gram: of columns and force, shape (n + 1, n + 1).
        weak: weight with which every number is held at nothing, against what its column carries: what is not excited
            at all has a large but finite variance.
    """
    a, r = gram[:-1, :-1], gram[:-1, -1]
    size = np.sqrt(np.maximum(np.diag(a), 1e-300))
    n = len(a)
    inverse = np.linalg.inv(a / np.outer(size, size) + weak * np.eye(n)) / np.outer(size, size)
    theta = inverse @ r
    left = float(gram[-1, -1] - 2.0 * theta @ r + theta @ a @ theta)
    return theta, inverse, max(left, 0.0)
