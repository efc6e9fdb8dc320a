"""Look-alikes in the place of each named effect of a sensor: is it the one, and what else could it be?"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sioms.reconcile import rules
from sioms.reconcile.ambiguity import ALIKE, AMBIGUOUS, SWAPS
from sioms.reconcile.blocks import better
from sioms.reconcile.sensors.effect import TERM_PREFIX, SensorEffect
from sioms.reconcile.sensors.fit import Fit
from sioms.reconcile.sensors.plausible import alike, physical
from sioms.reconcile.sensors.screen import screen
from sioms.reconcile.sensors.search import Found, Searcher, Step

Rival = rules.Rival[Fit]

PATIENCE = 30  # steps of a look-alike's fit: one that stopped short would be ruled out
FELT = 3.0  # standard deviations that an element's own number must make
ELSEWHERE = (-3.0, -1.0, 1.0, 3.0)  # natural sizes at which numbers of the elements' own begin again


def settle(
    searcher: Searcher, found: Found, pairs: Sequence[tuple[str, str, float]]
) -> tuple[Found, list[Rival]]:
    """Find the rivals; where one of no more numbers does better than what is named, search on from it."""
    others = rivals(searcher, found, pairs)
    lib, count = found.fit.model.library, found.fit.model.count
    for _ in range(SWAPS):
        best = next(
            (r for r in others if r.missed < 0.0 and lib[r.rival].size(count) <= lib[r.effect].size(count)),
            None,
        )
        if best is None:
            break
        searcher.progress(f"{best.rival} does better than {best.effect}: searching on from it")
        further = searcher.run(best.fit.model)
        step = Step(
            "swap",
            f"{best.effect} to {best.rival}",
            searcher.ratio(best.fit),
            1.0 - best.fit.cost / found.fit.cost,
            best.fit.model,
        )
        found = Found(further.fit, further.losses, (*found.ladder, step, *further.ladder[1:]))
        others = rivals(searcher, found, pairs)
    return found, others


def rivals(searcher: Searcher, found: Found, pairs: Sequence[tuple[str, str, float]] = ()) -> list[Rival]:
    """Refit with each look-alike in the place of each named effect, also with those too weak by nature to be searched.

    Args:
        pairs: effects that leave the same trace, with the share in common, as the gate found them.
    """
    out = []
    same = {frozenset(p[:2]) for p in pairs}
    lib, count = found.fit.model.library, found.fit.model.count
    for name in [
        n for n in found.fit.model.effects if n not in searcher.frozen and not n.startswith(TERM_PREFIX)
    ]:
        bare = searcher.fit(found.fit.model.without_effect(name), 4)
        contribution = bare.cost - found.fit.cost
        if contribution <= 0.0:
            continue
        for other in alike(lib, name, count):
            if other.startswith(TERM_PREFIX) or not lib[other].rankable or other in found.fit.model.effects:
                continue
            for start in screen(searcher.data, bare, searcher.weights, lib[other], searcher.frozen)[:2]:
                fit = searcher.fit(searcher.switched_on(bare, start), PATIENCE)
                if frozenset((name, other)) in same:
                    fit = searcher.restarted(fit, _elsewhere(lib[other]))
                if physical(fit.model, other):
                    _, errors = better(found.losses, searcher.loss(fit))
                    missed = (fit.cost - found.fit.cost) / contribution
                    if (
                        frozenset((name, other)) in same
                        and lib[name].primary.each
                        and lib[other].primary.each
                    ):
                        missed = min(missed, max(_missed_by_most(searcher, found.fit, bare, fit), 0.0))
                    out.append(
                        Rival(
                            name,
                            other,
                            missed,
                            ALIKE if frozenset((name, other)) in same else AMBIGUOUS,
                            errors,
                            fit.cost / found.fit.cost - 1.0,
                            fit,
                        )
                    )
    return rules.closest(out)


def _missed_by_most(searcher: Searcher, good: Fit, bare: Fit, rival: Fit) -> float:
    """Return the share that a rival misses at the middle one of the elements: one that tells its kind does not for the others."""
    own = searcher.squares(bare) - searcher.squares(good)
    felt = own > FELT**2
    missed = (searcher.squares(rival) - searcher.squares(good))[felt] / own[felt]
    return float(np.median(missed)) if len(missed) else np.inf


def _elsewhere(effect: SensorEffect) -> list[tuple[str, str, float]]:
    """Return where numbers of the elements' own begin again: the side of a touch on which an element lies is either."""
    q = effect.primary
    return [(effect.name, q.symbol, effect.neutral + k * q.size) for k in ELSEWHERE] if q.each else []
