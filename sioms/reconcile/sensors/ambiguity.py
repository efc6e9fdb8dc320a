"""Confounders in the place of each named effect of a sensor: is it the one, and what else could it be?"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from sioms.reconcile import rules
from sioms.reconcile.effect import TERM_PREFIX
from sioms.reconcile.sensors.effect import SensorEffect
from sioms.reconcile.sensors.fit import Fit, refit
from sioms.reconcile.sensors.plausible import alike, physical
from sioms.reconcile.sensors.screen import screen
from sioms.reconcile.sensors.search import Found, Searcher
from sioms.reconcile.thresholds import ALIKE, AMBIGUOUS, FELT

Rival = rules.Rival[Fit]

PATIENCE = 30  # steps of a confounder's fit: one that stopped short would be ruled out
ELSEWHERE = (-3.0, -1.0, 1.0, 3.0)  # natural sizes at which numbers of the elements' own begin again


def settle(searcher: Searcher, found: Found, pairs: Sequence[tuple[str, str, float]]) -> tuple[Found, list[Rival]]:
    """Find the rivals; where one of no more numbers does better than what is named, search on from it."""
    lib, count = found.fit.model.library, found.fit.model.count

    def wins(r: Rival, found: Found) -> bool:
        return r.missed < 0.0 and lib[r.rival].size(count) <= lib[r.effect].size(count)

    return rules.settle(
        found,
        lambda f: rivals(searcher, f, pairs),
        wins,
        searcher.run,
        searcher.ratio,
        searcher.progress,
    )


def rivals(searcher: Searcher, found: Found, pairs: Sequence[tuple[str, str, float]] = ()) -> list[Rival]:
    """Refit with each confounder in the place of each named effect, also with those too weak by nature to be searched.

    Args:
        pairs: effects that leave the same trace, with the share in common, as the gate found them.
    """
    same = {frozenset(p[:2]) for p in pairs}
    good = found.fit
    lib, count = good.model.library, good.model.count

    def replacements(bare: Fit, name: str, contribution: float) -> Iterator[tuple[str, Fit, float, float | None]]:
        for other in alike(lib, name, count):
            if other.startswith(TERM_PREFIX) or not lib[other].rankable or other in good.model.effects:
                continue
            one_trace = frozenset((name, other)) in same
            for start in screen(searcher.data, bare, searcher.weights, lib[other], searcher.frozen)[:2]:
                fit = searcher.fit(searcher.switched_on(bare, start), PATIENCE)
                if one_trace:
                    fit = searcher.restarted(fit, _elsewhere(lib[other]))
                if not physical(fit.model, other):
                    continue
                missed = None
                if one_trace and lib[name].primary.each and lib[other].primary.each:
                    all_missed = (fit.cost - good.cost) / contribution
                    missed = min(all_missed, max(_missed_by_most(searcher, good, bare, fit, name, other), 0.0))
                yield other, fit, ALIKE if one_trace else AMBIGUOUS, missed

    return rules.weighed(
        found,
        [n for n in good.model.effects if n not in searcher.frozen and not n.startswith(TERM_PREFIX)],
        lambda name: searcher.fit(good.model.without_effect(name), 4),
        replacements,
        searcher.loss,
    )


def _missed_by_most(searcher: Searcher, good: Fit, bare: Fit, rival: Fit, name: str, other: str) -> float:
    """Return the share that a rival misses at the middle one of the elements: one that tells its kind does not for the
    others.

    What one element misses spoils the fit of its neighbours: while the middle one misses much, the worst keeps the
    number it was named with, and the others are fitted again.
    """
    least, own = searcher.squares(good), searcher.squares(bare) - searcher.squares(good)
    felt = own > FELT**2
    telling = np.zeros(len(own), dtype=bool)
    middle = np.inf
    while np.any(felt & ~telling):
        beyond = np.where(telling, np.inf, searcher.squares(rival) - least)
        middle = float(np.median(beyond[felt] / own[felt]))
        if middle < ALIKE or 2 * np.count_nonzero(telling) >= np.count_nonzero(felt):
            break
        telling[int(np.argmax(np.where(felt & ~telling, beyond, -np.inf)))] = True
        rival = _kept(searcher, good, rival, name, other, telling)
    return middle


def _kept(searcher: Searcher, good: Fit, rival: Fit, name: str, other: str, which: NDArray[np.bool_]) -> Fit:
    """Refit a rival beside what some of the elements keep of what was named."""
    model = rival.model
    for effect, values, here in (
        (name, good.model.effects[name], which),
        (other, model.effects[other], ~which),
    ):
        first = model.library[effect].primary.symbol
        kept = np.where(here, values[first], model.library[effect].neutral)
        model = model.with_effect(effect, {**values, first: kept})
    return refit(searcher.data, model, searcher.weights, (*searcher.frozen, name), PATIENCE)


def _elsewhere(effect: SensorEffect) -> list[tuple[str, str, float]]:
    """Return where numbers of the elements' own begin again: the side of a touch on which an element lies is either."""
    q = effect.primary
    return [(effect.name, q.symbol, effect.neutral + k * q.size) for k in ELSEWHERE] if q.each else []
