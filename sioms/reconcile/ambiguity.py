"""Identifiability: could another effect, or another set, have made these data?

For every named effect the look-alikes take its place and everything is refitted. ``missed`` is the share of
the effect's contribution that the look-alike cannot reproduce; below ``AMBIGUOUS`` (or within one standard
error on held-out blocks) these data do not tell the two apart, however small the formal intervals are:
what separates them then is a transient or two, where unmodelled effects live. Where the gate has found, before any
fit, that two effects leave one and the same trace, more than that is needed: ``ALIKE``.
"""

from __future__ import annotations

from collections.abc import Sequence

from sioms.reconcile import rules
from sioms.reconcile.blocks import better
from sioms.reconcile.bounces import rattles
from sioms.reconcile.effects import library
from sioms.reconcile.fit import Fit
from sioms.reconcile.plausible import physical, size
from sioms.reconcile.search import Found, Searcher
from sioms.reconcile.thresholds import ALIKE, AMBIGUOUS, GAIN, ROUGH, SAME_TRACE, SURE
from sioms.reconcile.variation import accompanied, exchanged, named

Rival = rules.Rival[Fit]


def _wins(r: Rival) -> bool:
    """Say whether the rival does better: with more numbers, surely and by as much as an effect must save."""
    if size(r.rival) <= size(r.effect):
        return r.missed < 0.0
    return r.excess < -GAIN and r.errors < -SURE


def rivals(searcher: Searcher, found: Found, pairs: Sequence[tuple[str, str, float]] = ()) -> list[Rival]:
    """Refit with each look-alike in the place of each named effect, those not decided by a channel.

    Args:
        pairs: effects that leave the same trace, with the share in common, as of ``excitation.Gate``.
    """
    out = []
    same = {frozenset(p[:2]) for p in pairs if p[2] > SAME_TRACE}
    lib = library()
    for name in [n for n in found.fit.model.effects if n not in searcher.frozen and n in lib]:
        names = [n for n in _alike(name) if n in searcher.names and n not in found.fit.model.effects]
        if not names:
            continue
        bare = searcher.fit(named(found.fit.model.without_effect(name)), 5)
        contribution = bare.cost - found.fit.cost
        if contribution <= 0.0:
            continue
        for start in searcher.screen(bare, [n for n in names if accompanied(bare.model, n)]):
            if start.gain * bare.cost < 0.3 * contribution:
                continue
            fit = searcher.searched(searcher.fit(exchanged(bare.model, start.effect, start.values)))
            if not physical(fit, start.effect):
                continue
            _, errors = better(found.losses, searcher.loss(fit))
            allowed = ALIKE if frozenset((name, start.effect)) in same else AMBIGUOUS
            if rattles(found.fit.model):
                allowed = ROUGH
            out.append(
                Rival(
                    name,
                    start.effect,
                    (fit.cost - found.fit.cost) / contribution,
                    allowed,
                    errors,
                    fit.cost / found.fit.cost - 1.0,
                    fit,
                )
            )
    return rules.closest(out)


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


def _alike(name: str) -> list[str]:
    """Look-alikes in either direction, without those that merely contain the effect or are contained in it."""
    lib = library()
    both = [n for n in lib if n in lib[name].lookalikes or name in lib[n].lookalikes]
    return [n for n in both if n not in lib[name].replaces and size(n) <= size(name) + 1]
