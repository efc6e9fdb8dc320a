"""What speaks for a name, and what a verdict says: alike for all subjects."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sioms.reconcile.effect import AnyEffect, Array
from sioms.reconcile.rules import Rival, told_apart
from sioms.reconcile.selection import Step
from sioms.reconcile.thresholds import GAIN
from sioms.reconcile.verdict import Estimate, NamedEffect, Outcome, Place

DRAWS = 200


def frequency(good: Array, bad: Array, rng: np.random.Generator) -> float:
    """Return the share of block bootstrap replicates in which an effect saves its share.

    Args:
        good, bad: held-out losses with and without it, shape (blocks,).
    """
    gain, n = bad - good, len(bad)
    draws = rng.integers(0, n, (DRAWS, n))
    return float(np.mean(gain[draws].sum(1) > GAIN * bad[draws].sum(1)))


def described(
    effect: AnyEffect,
    estimates: tuple[Estimate, ...],
    saved: tuple[float, float, float],
    evidence: Iterable[str],
    others: Sequence[Rival[Any]],
    path: Sequence[Step[Any]],
    present: Iterable[str],
    numbers: Mapping[str, str],
    wider: Iterable[str] = (),
) -> NamedEffect:
    """Describe an effect of a model.

    Args:
        saved: what it saves beyond all others, in how many standard errors, and in what share of replicates.
        others: confounders that were refitted.
        present: effects of the model.
        numbers: with which numbers a confounder stands in its place, for some.
        wider: effects that contain this one.
    """
    ruled, still = told_apart(effect.name, effect.confounders, others, path, set(present), set(wider))
    still = {rival: text + (f", with {numbers[rival]}" if rival in numbers else "") for rival, text in still.items()}
    return NamedEffect(
        effect.name,
        effect.title,
        effect.equation,
        effect.channel.value,
        estimates,
        *saved,
        tuple(evidence),
        ruled,
        still,
    )


def outcome(named: bool, unexplained: bool, ambiguous: bool) -> Outcome:
    """Return the verdict; what is unexplained goes before what is ambiguous."""
    if unexplained:
        return Outcome.UNEXPLAINED
    if ambiguous:
        return Outcome.AMBIGUOUS
    return Outcome.NAMED if named else Outcome.NONE


def alternative(rival: Rival[Any], effects: Iterable[str]) -> tuple[str, ...]:
    """Return the names of a model with a rival in the place of its effect, without what that made needless."""
    kept = (n for n in effects if n == rival.effect or n in rival.fit.model.effects)
    return tuple(rival.rival if n == rival.effect else n for n in kept)


def place(
    variable: str,
    unit: str,
    residual: Array,
    values: Array,
    bins: NDArray[np.int64],
    shuffled: Iterable[Array],
    scale: float = 1.0,
) -> Place:
    """Say how far a variable orders a residual.

    Args:
        values, bins: of the variable, and the number of its bin, for each row.
        shuffled: the residual in other orders that keep its memory.
        scale: what one of the residual is in the unit of the picture.
    """
    count, level = np.maximum(np.bincount(bins), 1), residual.mean()  # the same in any order
    whole = max(float(np.sum((residual - level) ** 2)), 1e-300)

    def explained(r: Array) -> float:
        """Return the share of the variance between bins."""
        return float(np.sum(count * (np.bincount(bins, weights=r) / count - level) ** 2)) / whole

    share = explained(residual)
    chance = [explained(r) for r in shuffled]
    p = (1 + sum(c >= share for c in chance)) / (len(chance) + 1)
    mean = np.bincount(bins, weights=residual) / count
    spread = np.sqrt(np.maximum(np.bincount(bins, weights=residual**2) / count - mean**2, 0.0))
    return Place(variable, unit, share, p, np.bincount(bins, weights=values) / count, mean * scale, spread * scale)


def unseen(columns: Array, r: Array, fold: NDArray[np.int64], ridges: Iterable[float]) -> Array:
    """Return what a regression leaves on blocks that it has not seen, shape (n,); r itself where it explains nothing.

    Args:
        columns: of the state, shape (n, k).
        fold: of each row, from 0.
        ridges: shares of the count of rows that are added to the squares of a column; the best is taken.
    """
    folds = range(int(fold.max()) + 1)
    grams = [(columns[fold == i].T @ columns[fold == i], columns[fold == i].T @ r[fold == i]) for i in folds]
    best = r
    for ridge in ridges:
        left = np.empty_like(r)
        for i in folds:
            h = sum((g[0] for k, g in enumerate(grams) if k != i), np.zeros_like(grams[0][0]))
            y = sum((g[1] for k, g in enumerate(grams) if k != i), np.zeros_like(grams[0][1]))
            c = np.linalg.solve(h + ridge * len(r) * np.eye(len(h)), y)
            left[fold == i] = r[fold == i] - columns[fold == i] @ c
        best = min(best, left, key=lambda e: float(e @ e))
    return best
