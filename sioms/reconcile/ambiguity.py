"""Identifiability: could another effect, or another set, have made these data?

For every named effect the confounders take its place and everything is refitted. ``missed`` is the share of
the effect's contribution that the confounder cannot reproduce; below ``AMBIGUOUS`` (or within one standard
error on held-out blocks) these data do not tell the two apart, however small the formal intervals are:
what separates them then is a transient or two, where unmodelled effects live. Where the gate has found, before any
fit, that two effects leave one and the same trace, more than that is needed: ``ALIKE``.

A share says nothing of the noise: a force that makes sixty times the noise may be reproduced but for a hundredth, and
seven times the noise remain. Such a rival is ruled out where the named model comes down to the noise, what the rival
leaves more is far beyond all that the named model leaves, unmodelled or not, and nearly every block of time tells it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from sioms.reconcile import rules
from sioms.reconcile.blocks import better
from sioms.reconcile.bounces import has_impacts
from sioms.reconcile.effect import Array, Slot
from sioms.reconcile.effects import library
from sioms.reconcile.fit import Fit
from sioms.reconcile.noise import effective_samples
from sioms.reconcile.plausible import physical, size
from sioms.reconcile.search import Found, Searcher
from sioms.reconcile.thresholds import (
    ALIKE,
    AMBIGUOUS,
    EACH_BLOCK,
    FAR_WORSE,
    GAIN,
    LOUD,
    NEARLY_EACH,
    ROUGH,
    SAME_TRACE,
    SURE,
)
from sioms.reconcile.variation import accompanied, named

Rival = rules.Rival[Fit]
#: Of fewer blocks of time "nearly every one" says little.
FEWEST = 6


def _wins(r: Rival) -> bool:
    """Say whether the rival does better: with more numbers, surely and by as much as an effect must save."""
    if size(r.rival) <= size(r.effect):
        return r.missed < 0.0
    return r.excess < -GAIN and r.errors < -SURE


def rivals(searcher: Searcher, found: Found, pairs: Sequence[tuple[str, str, float]] = ()) -> list[Rival]:
    """Refit with each confounder in the place of each named effect, those not decided by a channel.

    Args:
        pairs: effects that leave the same trace, with the share in common, as of ``excitation.Gate``.
    """
    same = {frozenset(p[:2]) for p in pairs if p[2] > SAME_TRACE}
    model = found.fit.model
    lib = library()
    alike = {
        name: [n for n in confounders(name) if n in searcher.names and n not in model.effects]
        for name in model.effects
        if name not in searcher.frozen and name in lib
    }

    def replacements(bare: Fit, name: str, contribution: float) -> Iterator[tuple[str, Fit, float, None]]:
        for start in searcher.screen(bare, [n for n in alike[name] if accompanied(bare.model, n)]):
            if start.gain * bare.cost < 0.3 * contribution:
                continue
            fit = searcher.searched(searcher.fit(searcher.switched_on(bare, start)))
            if physical(fit, start.effect):
                allowed = ALIKE if frozenset((name, start.effect)) in same else AMBIGUOUS
                yield start.effect, fit, ROUGH if has_impacts(model) else allowed, None

    closest = rules.closest(
        [
            *rules.weighed(
                found,
                [n for n, others in alike.items() if others],
                lambda name: searcher.fit(named(model.without_effect(name)), 5),
                replacements,
                searcher.loss,
            ),
            *_for_several(searcher, found),
        ]
    )
    if has_impacts(model):
        return closest
    return [
        replace(r, told=told(found.fit, found.losses, r.fit, searcher.loss(r.fit)))
        if r.missed_little and r.allowed < ALIKE and not has_impacts(r.fit.model)
        else r
        for r in closest
    ]


def told(mine: Fit, losses: Array, other: Fit, others: Array) -> str:
    """Say how a rival is told by its remains from a model that comes down to the noise; empty: it is not.

    Args:
        losses, others: of both, held out, of each block of time.
    """
    far = float(np.sum(other.residual**2)) > (1.0 + FAR_WORSE) * float(np.sum(mine.residual**2))
    if mine.ratio > LOUD or not far or len(losses) < FEWEST:
        return ""
    per_row = effective_samples(mine.residual) / len(mine.residual)
    share = float(np.mean(0.5 * per_row * (others - losses) / mine.ratio**2 > EACH_BLOCK))
    if share < NEARLY_EACH:
        return ""
    return (
        f"leaves {other.ratio / mine.ratio:.2g} times as much as what is named, which is told in {100 * share:.0f} % "
        f"of {len(losses)} blocks of time"
    )


def _for_several(searcher: Searcher, found: Found) -> Iterator[Rival]:
    """Refit with one force in the place of several that it looks like: a law of the speed between two powers is either
    both of them or one with a power of its own.
    """
    lib, model = library(), found.fit.model
    for other in (n for n in searcher.names if n not in model.effects and lib[n].slot is Slot.FORCE):
        parts = [n for n in model.effects if n in lib[other].confounders and n not in searcher.frozen]
        if len(parts) < 2:
            continue
        bare = model
        for name in parts:
            bare = named(bare.without_effect(name))
        without = searcher.fit(bare, 5)
        contribution = without.cost - found.fit.cost
        for start in searcher.screen(without, [other]):
            if start.gain * without.cost < 0.3 * contribution:
                continue
            fit = searcher.searched(searcher.fit(searcher.switched_on(without, start)))
            if physical(fit, other):
                _, errors = better(found.losses, searcher.loss(fit))
                missed = (fit.cost - found.fit.cost) / contribution
                yield Rival(parts[0], other, missed, AMBIGUOUS, errors, fit.cost / found.fit.cost - 1.0, fit)


def settle(searcher: Searcher, found: Found, pairs: Sequence[tuple[str, str, float]]) -> tuple[Found, list[Rival]]:
    """Find the rivals; where one does better than what is named, and the closed loop agrees, search on from it."""
    return rules.settle(
        found,
        lambda f: rivals(searcher, f, pairs),
        lambda r, f: _wins(r) and searcher.follows(r.fit.model, f.fit.model),
        searcher.run,
        lambda fit: fit.ratio,
        searcher.progress,
    )


def confounders(name: str) -> list[str]:
    """List confounders in either direction, without those that merely contain the effect or are contained in it."""
    lib = library()
    both = [n for n in lib if n in lib[name].confounders or name in lib[n].confounders]
    contain = [n for n in both if name in lib[n].replaces and size(n) > size(name)]
    return [n for n in both if n not in (*lib[name].replaces, *contain) and size(n) <= size(name) + 1]
