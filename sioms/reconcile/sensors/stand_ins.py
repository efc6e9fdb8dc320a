"""Names of sensor effects that only stand in: a nameless rule does as well, or explains what is left beside them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from sioms.reconcile.rules import negligible
from sioms.reconcile.sensors.fit import Fit, half_intervals
from sioms.reconcile.sensors.plausible import without
from sioms.reconcile.sensors.screen import screen
from sioms.reconcile.sensors.search import Found, Searcher, beyond_noise, surely
from sioms.reconcile.thresholds import FEWER, GAIN, SPECIFIC, WHOLLY


def displaced(searcher: Searcher, found: Found) -> bool:
    """Say whether a term without a name saves much beside what is named, or does surely better in the place of a name.

    Much is three tenths of a view above its floor, or of everything what is no noise.
    """
    model, count = found.fit.model, found.fit.model.count
    loud = searcher.loud(found.fit)
    for term in searcher.terms:
        new = _tried(searcher, found.fit, term, 0.0 if loud else GAIN)
        if new:
            saved = searcher.saving(searcher.loss(new), found.losses, loud)
            if beyond_noise(saved) or (loud and surely(saved, SPECIFIC)):
                return True
    for gone, bare, term in _nameless_alike(searcher, found, searcher.names):
        new = _tried(searcher, bare, term) if len(gone) == 1 else None
        richer = model.library[term].size(count) > model.library[gone[0]].size(count) + 1
        if new and not richer and surely(searcher.saving(searcher.loss(new), found.losses), GAIN):
            return True
    return False


def ruled(searcher: Searcher, found: Found, names: Sequence[str]) -> tuple[str, ...]:
    """Return those of these names in the place of which one nameless rule of far fewer numbers does as well."""
    model, count = found.fit.model, found.fit.model.count
    for gone, bare, term in _nameless_alike(searcher, found, names):
        numbers = sum(model.library[n].size(count) for n in gone)
        if FEWER * model.library[term].size(count) > numbers:
            continue
        new = _tried(searcher, bare, term)
        worse = searcher.lost(searcher.loss(new), found.losses) if new else None
        if new and worse and negligible(worse.share, worse.errors) and _told(searcher, new, term):
            return gone
    return ()


def _nameless_alike(
    searcher: Searcher, found: Found, names: Sequence[str]
) -> Iterator[tuple[tuple[str, ...], Fit, str]]:
    """Yield names of a model, one or all that a nameless confounder could take the place of, the fit without, and
    that.
    """
    model, lib = found.fit.model, found.fit.model.library
    held = [n for n in model.effects if n in names and n not in searcher.frozen]
    for term in [n for n in searcher.terms if n not in model.effects]:
        like = tuple(n for n in held if n in lib[term].confounders or term in lib[n].confounders)
        for gone in dict.fromkeys((*((n,) for n in like), like) if like else ()):
            yield gone, searcher.fit(without(model, gone), 4), term


def _tried(searcher: Searcher, fit: Fit, name: str, least: float = 0.0) -> Fit | None:
    """Switch an effect on from its best start, and refit; None where there is none that saves the
    least, or it is on.
    """
    starts = (
        []
        if name in fit.model.effects
        else screen(searcher.data, fit, searcher.weights, fit.model.library[name], searcher.frozen)
    )
    return searcher.fit(searcher.switched_on(fit, starts[0])) if starts and starts[0].total >= least else None


def _told(searcher: Searcher, fit: Fit, name: str) -> bool:
    """Say whether the first number of an effect is surely not neutral."""
    half = half_intervals(searcher.data, fit, searcher.weights)
    effect = fit.model.library[name]
    own = [h for f, h in zip(fit.free, half, strict=True) if (f.effect, f.symbol) == (name, effect.primary.symbol)]
    return bool(np.any(np.abs(fit.model.effects[name][effect.primary.symbol] - effect.neutral) > own))


def credible(searcher: Searcher, found: Found) -> Found:
    """Keep only names that explain nearly all of a view in which something has no name: less may be a part of that.

    What has no name in one view may have a part in all views of its footing, and a small one in any.
    """
    model, views, group = found.fit.model, searcher.data.views, searcher.data.footing
    odd = {group[views.index(view)] for view in searcher.loud(found.fit)}
    for name in [n for n in model.effects if n in searcher.names and n not in searcher.frozen]:
        gap = searcher.lost(searcher.loss(searcher.fit(found.fit.model.without_effect(name), 4)), found.losses)
        if gap.share < (WHOLLY if group[views.index(gap.view)] in odd else SPECIFIC):
            model = model.without_effect(name)
    if model is found.fit.model:
        return found
    fit = searcher.levelled(model)
    fit, losses = searcher.eliminate(fit, searcher.loss(fit), [])  # what only served the others
    return Found(fit, losses, found.path)
