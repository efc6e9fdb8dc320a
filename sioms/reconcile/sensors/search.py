"""Search for the missing effects of a sensor: screen, refit nested, let earlier ones leave again.

The rules are those of the axis (``sioms.reconcile.search``); evidence comes in views (touches, courses in
time, untouched frames ...), every view is brought to the floor on one footing, and an effect is judged in the
view where it shows most.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from sioms.reconcile import rules
from sioms.reconcile.ambiguity import ALIKE, AMBIGUOUS, SWAPS
from sioms.reconcile.blocks import better, heldout
from sioms.reconcile.rules import GAIN, NEARLY, SPECIFIC, SURE, negligible
from sioms.reconcile.sensors.effect import TERM_PREFIX, Array, SensorEffect, SensorModel
from sioms.reconcile.sensors.fit import Data, Fit, half_intervals, on_one_footing, ratios, refit
from sioms.reconcile.sensors.screen import Start, screen

FLOOR = 1.15  # stop at this multiple of the noise floor, which is of a sensor's own rows
TRIES = 5
STEPS = 8
MOST_INSIDE = 0.7  # share of the elements whose own number must be one that the effect can have
DEEP = 3.0  # standard errors, over all blocks, of a saving below the floor
FEWER = 2  # times as few numbers has a nameless rule that takes the place of elements' own numbers
CLEAR = 0.95  # share of a view that a name must save where the view stays above its floor
#: Two effects are tried at once only where a view is above this multiple of its floor, so many firsts and seconds.
PAIRED, PAIRS = 1.3, 3


@dataclass(frozen=True, slots=True)
class Saving:
    """What one model saves against another: share and standard errors in its best view, and those of all views together."""

    share: float
    errors: float
    view: str
    total: float
    surely: float

    @property
    def weight(self) -> float:
        """How much and how surely it saves; below zero where it loses."""
        sure = min(abs(self.errors), 10.0)
        return min(self.share, 1.0) * sure if self.errors > 0.0 else -abs(self.share) * sure


@dataclass(frozen=True, slots=True)
class Rung:
    """One step of the search."""

    action: str
    effect: str
    ratio: float
    saved: float
    model: SensorModel
    rivals: dict[str, float] = field(default_factory=dict)


Rival = rules.Rival[Fit]


@dataclass(frozen=True, slots=True)
class Found:
    """Result of a search."""

    fit: Fit
    losses: Array
    ladder: tuple[Rung, ...]


@dataclass(slots=True)
class Searcher:
    """Search over one set of data. Not thread-safe.

    Attributes:
        names: effects that are tried; frozen: those that stay as they are.
        terms: nameless terms that a name which saves little is measured against.
    """

    data: Data
    names: tuple[str, ...]
    frozen: tuple[str, ...] = ()
    progress: Callable[[str], None] = lambda text: None
    terms: tuple[str, ...] = ()
    weights: Array = field(init=False)

    def __post_init__(self) -> None:
        self.weights = np.ones(len(self.data.view))

    # -- fits and losses

    def fit(self, model: SensorModel, iterations: int = 6) -> Fit:
        """Refit all free numbers."""
        return refit(self.data, model, self.weights, self.frozen, iterations)

    def loss(self, fit: Fit) -> Array:
        """Held-out loss per block."""
        return heldout(fit, self.data.block)

    def ratios(self, model: SensorModel) -> Array:
        """Return the root mean square of each view in units of its floor."""
        return ratios(self.data, model)

    def saving(self, new: Array, old: Array, among: Collection[str] = ()) -> Saving:
        """Compare held-out losses by view: of all views, or of some."""
        of_block = np.zeros(len(new), dtype=np.int64)
        of_block[self.data.block] = self.data.view
        best = Saving(-np.inf, 0.0, "", *better(new, old))
        for i, view in enumerate(self.data.views):
            mine = of_block == i
            if np.count_nonzero(mine) < 2 or (among and view not in among):
                continue
            share, errors = better(new[mine], old[mine])
            new_one = Saving(share, errors, view, best.total, best.surely)
            if best.view == "" or new_one.weight > best.weight:
                best = new_one
        return best

    def lost(self, worse: Array, good: Array) -> Saving:
        """Return what a worse model gives away, in the view where it gives away most."""
        return self.saving(good, worse)

    # -- search

    def run(self, start: SensorModel) -> Found:
        """Search from a model; where the floor is not reached, again without the first step, which led astray if that reaches it."""
        found = self._run(start)
        steps = [r for r in found.ladder if r.action == "add"]
        if len(steps) < 2 or not self._loud(found.fit) or set(self.terms) & set(self.names):
            return found
        names, footing = self.names, self.weights
        self.names = tuple(n for n in names if n != steps[0].effect)
        other = self._run(start)
        self.names = names
        if not self._loud(other.fit):
            self.progress(f"{steps[0].effect} led astray: what is found without it reaches the floor")
            return other
        self.weights = footing
        return found

    def _run(self, start: SensorModel) -> Found:
        fit = self._levelled(start)
        losses = self.loss(fit)
        ladder = [Rung("start", "", self._ratio(fit), 0.0, fit.model)]
        for _ in range(STEPS):
            step = self._add(fit, losses) or self._add_pair(fit, losses) or self._restart(fit)
            if step is None:
                break
            ladder.append(step)
            fit = self._levelled(step.model)
            losses = self.loss(fit)
            self.progress(f"{step.action} {step.effect}: residual {self._ratio(fit):.2f} of the floor")
            fit, losses = self._simplify(fit, losses, ladder)
            fit, losses = self._eliminate(fit, losses, ladder)
        return Found(fit, losses, tuple(ladder))

    def _levelled(self, model: SensorModel) -> Fit:
        """Fit, bring the views to one footing, and fit again."""
        self.weights = on_one_footing(self.data, model)
        fit = self.fit(model)
        self.weights = on_one_footing(self.data, fit.model)
        return self.fit(fit.model)

    def _loud(self, fit: Fit) -> list[str]:
        """Views that are above their floor."""
        return [v for v, ratio in zip(self.data.views, self.ratios(fit.model), strict=True) if ratio > FLOOR]

    def _ratio(self, fit: Fit) -> float:
        """Root mean square over all rows, in units of the floor."""
        return float(np.sqrt(np.mean((fit.residual / self.weights) ** 2)))

    def _add(self, fit: Fit, losses: Array) -> Rung | None:
        """Refit the best candidates and take the simplest of those that save most.

        Below the floor, which is an estimate, only what saves much on blocks held out is no noise.
        """
        tried: dict[str, tuple[Fit, Array, Saving]] = {}
        loud = self._loud(fit)
        for start in self.candidates(fit):
            new = self.fit(self._with(fit, start))
            loss = self.loss(new)
            tried[start.effect] = (new, loss, self.saving(loss, losses, loud))
        good = {
            n: t
            for n, t in tried.items()
            if (_sure(t[2], GAIN) if loud else _beyond_noise(t[2]) and not _termed(t[0].model))
            and physical(t[0].model, n)
        }
        if not good:
            return None
        name = self._simplest(good)
        new, _, saved = good[name]
        others = {n: t[2].share for n, t in tried.items() if n != name}
        if saved.share < SPECIFIC and any(
            t[2].share > NEARLY * saved.share and t[2].view == saved.view and n not in family(new.model, name)
            for n, t in tried.items()
            if n != name
        ):
            return None
        if saved.share < SPECIFIC and (_termed(new.model) or self._nameless(fit, losses, saved)):
            return None  # what is left where a term stands may be what the term does not fit
        return Rung("add", name, self._ratio(new), saved.share, new.model, others)

    def _add_pair(self, fit: Fit, losses: Array) -> Rung | None:
        """Add two effects at once where neither is sure alone: each hides what the other would save.

        Both must save much together, and each much beside the other; less than that has no name yet.
        """
        if np.max(self.ratios(fit.model)) < PAIRED:
            return None
        best: tuple[Saving, Fit, str] | None = None
        for first in self.candidates(fit)[:PAIRS]:
            middle = self.fit(self._with(fit, first), 4)
            inner = self.loss(middle)
            for second in self.candidates(middle)[:PAIRS]:
                new = self.fit(self._with(middle, second))
                if first.effect not in new.model.effects or second.effect in family(new.model, first.effect):
                    continue
                loss = self.loss(new)
                saved, more = self.saving(loss, losses), self.saving(loss, inner)
                sure = _sure(saved, SPECIFIC) and _sure(more, SPECIFIC)
                good = sure and physical(new.model, first.effect) and physical(new.model, second.effect)
                if good and (best is None or new.cost < best[1].cost):
                    best = saved, new, f"{first.effect} and {second.effect}"
        if best is None or self._nameless(fit, losses, best[0]):
            return None
        saved, new, name = best
        return Rung("add", name, self._ratio(new), saved.share, new.model)

    def _restart(self, fit: Fit) -> Rung | None:
        """Let shapes of the elements' own, of which some may have stuck, begin again; each keeps what is best for it."""
        count = fit.model.count
        own = [
            (name, q.symbol, start)
            for name in fit.model.effects
            if name not in self.frozen and self._loud(fit)
            for q in fit.model.library[name].parameters[1:]
            for start in (q.starts if q.each else ())
        ]
        best = fit
        for name, symbol, start in own:
            held = best.model.effects[name]
            moved = self.fit(best.model.with_effect(name, {**held, symbol: np.full(count, start)}))
            better_there = self._squares(moved) < (1.0 - GAIN) * self._squares(best)
            values = {
                s: np.where(better_there, v, held[s]) if len(v) == count > 1 else v
                for s, v in moved.model.effects[name].items()
            }
            new = self.fit(best.model.with_effect(name, values))
            best = new if new.cost < (1.0 - GAIN) * best.cost else best
        if best is fit:
            return None
        return Rung("restart", "shapes", self._ratio(best), 1.0 - best.cost / fit.cost, best.model)

    def _squares(self, fit: Fit) -> Array:
        """Sum of squares of each element."""
        own = self.data.element >= 0
        out: Array = np.bincount(self.data.element[own], fit.residual[own] ** 2, fit.model.count).astype(
            np.float64
        )
        return out

    def _with(self, fit: Fit, start: Start) -> SensorModel:
        """Switch a candidate on, and off what it replaces."""
        model = without(fit.model, fit.model.library[start.effect].replaces)
        return model.with_effect(start.effect, start.values)

    def _nameless(self, fit: Fit, losses: Array, saved: Saving) -> bool:
        """Say whether a term without a name saves far more than the best name does: then the residual has no name yet."""
        free = [n for n in self.terms if n not in self.names and n not in fit.model.effects]
        starts = [
            s
            for n in free
            for s in screen(self.data, fit, self.weights, fit.model.library[n], self.frozen)[:1]
        ]
        best = max(starts, key=lambda s: s.gain, default=None)
        if best is None or NEARLY * best.gain < saved.share:
            return False
        other = self.saving(self.loss(self.fit(fit.model.with_effect(best.effect, best.values))), losses)
        return other.view == saved.view and NEARLY * other.share > saved.share

    def _simplest(self, good: dict[str, tuple[Fit, Array, Saving]]) -> str:
        """Of those within one standard error and ``GAIN`` of the best, the one with the fewest numbers."""
        best = max(good, key=lambda n: good[n][2].total)
        near = []
        for n, (_, loss, _) in good.items():
            gap = self.lost(loss, good[best][1])
            if negligible(gap.share, gap.errors):
                near.append(n)
        model = good[best][0].model
        named = not _termed(model)  # where something has no name, a name is no better than another term

        def order(n: str) -> tuple[bool, int, float]:
            return named and n.startswith(TERM_PREFIX), model.library[n].size(model.count), -good[n][2].total

        return min(near or [best], key=order)

    def _eliminate(self, fit: Fit, losses: Array, ladder: list[Rung]) -> tuple[Fit, Array]:
        """Let effects leave that no longer save their share."""
        for name in [n for n in fit.model.effects if n not in self.frozen]:
            if len(fit.model.effects) < 2:
                break
            bare = self.fit(fit.model.without_effect(name))
            loss = self.loss(bare)
            gap = self.lost(loss, losses)
            if negligible(gap.share, gap.errors):
                fit, losses = bare, loss
                ladder.append(Rung("leave", name, self._ratio(fit), -gap.share, fit.model))
        return fit, losses

    def _simplify(self, fit: Fit, losses: Array, ladder: list[Rung]) -> tuple[Fit, Array]:
        """Put a look-alike of fewer numbers in the place of an effect, or of all that it is like, where it does as well."""
        for name in [n for n in fit.model.effects if n not in self.frozen]:
            for other, gone in self._simpler(fit.model, name):
                bare = self.fit(
                    without(fit.model, gone), 0
                )  # the others stay where they are, or they make up for it
                start = next(
                    iter(screen(self.data, bare, self.weights, fit.model.library[other], self.frozen)), None
                )
                if start is None:
                    continue
                new = self.fit(bare.model.with_effect(other, start.values))
                loss = self.loss(new)
                gap = self.lost(loss, losses)
                if negligible(gap.share, gap.errors) and physical(new.model, other):
                    fit, losses = new, loss
                    said = f"{' and '.join(gone)} to {other}"
                    ladder.append(Rung("simplify", said, self._ratio(fit), -gap.share, fit.model))
                    break
        return fit, losses

    def _simpler(self, model: SensorModel, name: str) -> list[tuple[str, tuple[str, ...]]]:
        """Look-alikes of an effect with what each could take the place of, of more numbers in all."""
        lib, out = model.library, []
        if name not in model.effects:
            return []
        for other in [n for n in lib[name].lookalikes if n in self.names and n not in model.effects]:
            like = tuple(n for n in model.effects if n in lib[other].lookalikes and n not in self.frozen)
            for gone in ((name,), tuple(dict.fromkeys((name, *like)))):
                if lib[other].size(model.count) < sum(lib[n].size(model.count) for n in gone):
                    out.append((other, gone))
        return list(dict.fromkeys(out))

    def displaced(self, found: Found) -> bool:
        """Say whether a term without a name saves much beside what is named, or does surely better in the place of a name."""
        model, count = found.fit.model, found.fit.model.count
        loud = self._loud(found.fit)
        for term in self.terms if loud else ():
            new = self._tried(found.fit, term)
            if new and _sure(self.saving(self.loss(new), found.losses, loud), SPECIFIC):
                return True
        for gone, bare, term in self._nameless_alike(found, self.names):
            new = self._tried(bare, term) if len(gone) == 1 else None
            richer = model.library[term].size(count) > model.library[gone[0]].size(count) + 1
            if new and not richer and _sure(self.saving(self.loss(new), found.losses), GAIN):
                return True
        return False

    def ruled(self, found: Found, names: Sequence[str]) -> tuple[str, ...]:
        """Return those of these names in the place of which one nameless rule of far fewer numbers does as well."""
        model, count = found.fit.model, found.fit.model.count
        for gone, bare, term in self._nameless_alike(found, names):
            numbers = sum(model.library[n].size(count) for n in gone)
            if FEWER * model.library[term].size(count) > numbers:
                continue
            new = self._tried(bare, term)
            worse = self.lost(self.loss(new), found.losses) if new else None
            if new and worse and negligible(worse.share, worse.errors) and self._told(new, term):
                return gone
        return ()

    def _nameless_alike(
        self, found: Found, names: Sequence[str]
    ) -> Iterator[tuple[tuple[str, ...], Fit, str]]:
        """Yield names of a model, one or all that a nameless look-alike could take the place of, the fit without, and that."""
        model, lib = found.fit.model, found.fit.model.library
        held = [n for n in model.effects if n in names and n not in self.frozen]
        for term in [n for n in self.terms if n not in model.effects]:
            like = tuple(n for n in held if n in lib[term].lookalikes or term in lib[n].lookalikes)
            for gone in dict.fromkeys((*((n,) for n in like), like) if like else ()):
                yield gone, self.fit(without(model, gone), 4), term

    def _tried(self, fit: Fit, name: str) -> Fit | None:
        """Switch an effect on from its best start, and refit; None where there is none, or it is on."""
        starts = (
            []
            if name in fit.model.effects
            else screen(self.data, fit, self.weights, fit.model.library[name], self.frozen)
        )
        return self.fit(self._with(fit, starts[0])) if starts else None

    def _told(self, fit: Fit, name: str) -> bool:
        """Say whether the first number of an effect is surely not neutral."""
        half = half_intervals(self.data, fit, self.weights)
        effect = fit.model.library[name]
        own = [
            h for f, h in zip(fit.free, half, strict=True) if (f.effect, f.quantity) == (name, effect.primary)
        ]
        return bool(np.any(np.abs(fit.model.effects[name][effect.primary.symbol] - effect.neutral) > own))

    def credible(self, found: Found) -> Found:
        """Keep only names that explain nearly all of a view in which something has no name: less may be a part of that.

        What has no name in one view may have a part in all views of its footing, and a small one in any.
        """
        model, views, group = found.fit.model, self.data.views, self.data.footing
        odd = {group[views.index(view)] for view in self._loud(found.fit)}
        for name in [n for n in model.effects if n in self.names and n not in self.frozen]:
            gap = self.lost(self.loss(self.fit(found.fit.model.without_effect(name), 4)), found.losses)
            if gap.share < (CLEAR if group[views.index(gap.view)] in odd else SPECIFIC):
                model = model.without_effect(name)
        if model is found.fit.model:
            return found
        fit = self._levelled(model)
        fit, losses = self._eliminate(fit, self.loss(fit), [])  # what only served the others
        return Found(fit, losses, found.ladder)

    def candidates(self, fit: Fit) -> list[Start]:
        """Screen every effect that is not in the model; the best few, look-alikes of the best among them."""
        found: list[Start] = []
        for name in self.names:
            if name in fit.model.effects or name in self.frozen:
                continue
            if any(name in fit.model.library[n].replaces for n in fit.model.effects):
                continue
            starts = screen(self.data, fit, self.weights, fit.model.library[name], self.frozen)
            found += starts[:1]
        found = sorted((s for s in found if s.gain > 0.5 * GAIN), key=lambda s: -s.gain)
        chosen = found[:TRIES]
        if chosen:
            alike = family(fit.model, chosen[0].effect)
            chosen += [s for s in found[TRIES:] if s.effect in alike]
        return chosen

    def settle(self, found: Found, pairs: Sequence[tuple[str, str, float]]) -> tuple[Found, list[Rival]]:
        """Find the rivals; where one of no more numbers does better than what is named, search on from it."""
        others = self.rivals(found, pairs)
        lib, count = found.fit.model.library, found.fit.model.count
        for _ in range(SWAPS):
            best = next(
                (
                    r
                    for r in others
                    if r.missed < 0.0 and lib[r.rival].size(count) <= lib[r.effect].size(count)
                ),
                None,
            )
            if best is None:
                break
            self.progress(f"{best.rival} does better than {best.effect}: searching on from it")
            further = self.run(best.fit.model)
            step = Rung(
                "swap",
                f"{best.effect} to {best.rival}",
                self._ratio(best.fit),
                1.0 - best.fit.cost / found.fit.cost,
                best.fit.model,
            )
            found = Found(further.fit, further.losses, (*found.ladder, step, *further.ladder[1:]))
            others = self.rivals(found, pairs)
        return found, others

    def rivals(self, found: Found, pairs: Sequence[tuple[str, str, float]] = ()) -> list[Rival]:
        """Refit with each look-alike in the place of each named effect, also with those too weak by nature to be searched.

        Args:
            pairs: effects that leave the same trace, with the share in common, as the gate found them.
        """
        out = []
        same = {frozenset(p[:2]) for p in pairs}
        lib, count = found.fit.model.library, found.fit.model.count
        for name in [
            n for n in found.fit.model.effects if n not in self.frozen and not n.startswith(TERM_PREFIX)
        ]:
            bare = self.fit(found.fit.model.without_effect(name), 4)
            contribution = bare.cost - found.fit.cost
            if contribution <= 0.0:
                continue
            for other in alike(lib, name, count):
                if (
                    other.startswith(TERM_PREFIX)
                    or not lib[other].rankable
                    or other in found.fit.model.effects
                ):
                    continue
                for start in screen(self.data, bare, self.weights, lib[other], self.frozen)[:2]:
                    fit = self.fit(self._with(bare, start))
                    if physical(fit.model, other):
                        _, errors = better(found.losses, self.loss(fit))
                        out.append(
                            Rival(
                                name,
                                other,
                                (fit.cost - found.fit.cost) / contribution,
                                ALIKE if frozenset((name, other)) in same else AMBIGUOUS,
                                errors,
                                fit.cost / found.fit.cost - 1.0,
                                fit,
                            )
                        )
        best: dict[tuple[str, str], Rival] = {}
        for r in out:
            if (r.effect, r.rival) not in best or r.missed < best[r.effect, r.rival].missed:
                best[r.effect, r.rival] = r
        return sorted(best.values(), key=lambda r: r.missed)


def _sure(saved: Saving, least: float) -> bool:
    """Say whether at least a share is saved, surely there or in all views together, and nothing lost in all."""
    return saved.share >= least and max(saved.errors, saved.surely) >= SURE and saved.total > 0.0


def _beyond_noise(saved: Saving) -> bool:
    """Say whether what is saved of everything below the floor is too much, and too sure, for noise."""
    return saved.total >= GAIN and saved.surely >= DEEP


def _termed(model: SensorModel) -> bool:
    return any(n.startswith(TERM_PREFIX) for n in model.effects)


def alike(lib: Mapping[str, SensorEffect], name: str, count: int) -> list[str]:
    """Look-alikes in either direction that are not much richer, and the twins whatever their size."""
    own = lib[name]
    both = [n for n in lib if n in own.lookalikes or name in lib[n].lookalikes]
    return [
        n
        for n in both
        if n not in own.replaces and (lib[n].size(count) <= own.size(count) + 1 or n in own.twins)
    ]


def family(model: SensorModel, name: str) -> set[str]:
    """An effect, its look-alikes in either direction and what it replaces."""
    lib = model.library
    return {name, *lib[name].lookalikes, *lib[name].replaces, *(n for n in lib if name in lib[n].lookalikes)}


def without(model: SensorModel, names: tuple[str, ...]) -> SensorModel:
    """Switch some effects off."""
    for name in names:
        model = model.without_effect(name) if name in model.effects else model
    return model


def physical(model: SensorModel, name: str) -> bool:
    """Say whether the first parameter lies inside its bounds (of the elements' own, most) and away from doing nothing.

    A nameless term claims nothing physical.
    """
    if name.startswith(TERM_PREFIX):
        return True
    effect, q = model.library[name], model.library[name].primary
    value = model.effects[name][q.symbol]
    span = 1e-3 * (q.upper - q.lower)
    inside = (q.lower + span < value) & (value < q.upper - span)
    if q.each:
        return bool(np.mean(inside | (value == effect.neutral)) > MOST_INSIDE)
    return bool(inside[0] and abs(value[0] - effect.neutral) > 1e-3 * q.size)
