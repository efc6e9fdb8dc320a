"""Search for the missing effects of an axis: one view; fits are kept, laws of friction are enriched and begun afresh,
gaps bounce.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from sioms.reconcile import selection
from sioms.reconcile.blocks import better, heldout
from sioms.reconcile.bounces import POLISHED, UNPOLISHED, bent, has_impacts, polish, rough, spread
from sioms.reconcile.effect import Array
from sioms.reconcile.effects import known, library
from sioms.reconcile.engine.search import AND, Added, Saving, Search, Start, Tried
from sioms.reconcile.fit import Fit, Problem, block_ids, closed_errors, refit, shifted
from sioms.reconcile.model import AxisModel
from sioms.reconcile.plausible import (
    formulas_of,
    physical,
    plainer,
    replaced,
    size,
    small,
    swapped,
    unspecific,
    vacant,
)
from sioms.reconcile.rules import negligible
from sioms.reconcile.screen import screen
from sioms.reconcile.thresholds import AXIS, CLEAR, GAIN, LOOSE, PERIODIC_SURE, SPECIFIC, SURE, WAVES
from sioms.reconcile.variation import accompanied, exchanged, named

PASSES = 4  # at most so many times more for a new gap, while it gains
BEST = 2  # of the candidates beside a gap are judged with its numbers searched anew
#: What the levels of laws of dry friction are called.
LEVELS = ("Fc", "Fs", "f")
WORTH = 2.0  # and not where another candidate leaves less by this factor
#: Fits are kept in memory up to this size: a second search, with terms beside the library, retraces the first.
KEPT_BYTES = 128_000_000


Step = selection.Step[AxisModel]
Found = selection.Found[Fit, AxisModel]


@dataclass(slots=True)
class Searcher(Search[AxisModel]):
    """Search over one problem. Not thread-safe.

    Attributes:
        problem: as given; beside a gap, bent for its bounces.
        frozen: effects measured by a channel of their own; they stay, with their values.
        excluded: effects that must not be tried (ruled out by a channel, or not applicable).
        progress: told what is being done.
    """

    problem: Problem
    frozen: tuple[str, ...] = ()
    names: tuple[str, ...] = ()
    progress: Callable[[str], None] = lambda text: None
    footing: ClassVar = AXIS
    ids: NDArray[np.int64] = field(init=False)
    _given: Problem = field(init=False)
    _fits: dict[Hashable, Fit] = field(init=False, default_factory=dict)
    _losses: dict[Hashable, Array] = field(init=False, default_factory=dict)
    _starts: dict[Hashable, list[Start]] = field(init=False, default_factory=dict)
    _polished: set[Hashable] = field(init=False, default_factory=set)
    _rough: set[Hashable] = field(init=False, default_factory=set)
    _loops: dict[Hashable, float] = field(init=False, default_factory=dict)

    def __post_init__(self) -> None:
        """Number the blocks."""
        self.ids, self._given = np.empty(0, dtype=np.int64), self.problem

    def fit(self, model: AxisModel, iterations: int = 8, best: float = np.inf) -> Fit:
        """Refit with the channel effects frozen; what was fitted before is looked up.

        Args:
            best: cost of what the model competes with; a gap that is far from it is not polished to the end.
        """
        key = (values_of(model), iterations)
        if key not in self._fits or (key in self._rough and self._fits[key].cost < WORTH * best):
            self._fits[key] = fit = self._fit(model, iterations, best)
            most = KEPT_BYTES // (8 * len(fit.residual) * (len(fit.free) + 1))
            while len(self._fits) > max(most, 1):
                del self._fits[next(iter(self._fits))]
        return self._fits[key]

    def screen(self, fit: Fit, names: Sequence[str], levels: Mapping[str, float] | None = None) -> list[Start]:
        """Screen as ``sioms.reconcile.screen.screen`` does; what was screened before is looked up."""
        key = (values_of(fit.model), tuple(sorted((levels or {}).items())))
        fresh = [n for n in names if (key, n) not in self._starts]
        found = screen(self.problem, fit, fresh, levels) if fresh else []
        self._starts.update({(key, n): [s for s in found if s.effect == n] for n in fresh})
        return sorted((s for n in names for s in self._starts[key, n]), key=lambda s: -s.gain)

    def _fit(self, model: AxisModel, iterations: int, best: float) -> Fit:
        gap = next((n for n in model.effects if known()[n].mechanism.bounces), None)
        if gap is None or iterations <= 4:
            return refit(self.problem, model, self.frozen, iterations)
        new = tuple(model.effects[gap].values()) not in self._polished
        fit = polish(self._given, self.problem, model, self.frozen, UNPOLISHED if new else POLISHED)
        if new:
            fit = self.searched(fit, best)
            if fit.cost > WORTH * best:
                self._rough.add((values_of(model), iterations))
                return fit
        self._rough.discard((values_of(model), iterations))
        self._polished.add(tuple(fit.model.effects[gap].values()))
        return fit

    def searched(self, fit: Fit, best: float = np.inf) -> Fit:
        """Search the numbers of a gap, if there is one, until that no longer gains, or is too far from the best."""
        for _ in range(PASSES if has_impacts(fit.model) else 0):
            if fit.cost > WORTH * best:
                break
            again = polish(self._given, self.problem, fit.model, self.frozen, UNPOLISHED)
            scale = spread(fit.residual)
            gained = rough(again.residual, scale) < (1.0 - GAIN) * rough(fit.residual, scale)
            fit = min(fit, again, key=lambda f: rough(f.residual, scale))
            if not gained:
                break
        return fit

    def loss(self, fit: Fit) -> Array:
        """Held-out loss per block; what was asked before is looked up."""
        key = (values_of(fit.model), fit.free)
        if key not in self._losses:
            self._losses[key] = self._loss(fit)
        return self._losses[key]

    def _loss(self, fit: Fit) -> Array:
        """Score a fit; beside a gap, whose rough cost has no slope to go by, with all numbers as they are."""
        if len(self.ids) != len(fit.residual):
            self.ids = block_ids(self.problem, fit.model.sample_time_s)
        losses = heldout(
            replace(fit, jacobian=fit.jacobian[:, :0]) if has_impacts(fit.model) else fit,
            self.ids,
            moved=lambda d: self.problem.residual(shifted(fit.model, fit.free, d)),
        )
        return (
            losses
            if self.problem.weights is None
            else losses[np.bincount(self.ids, weights=self.problem.weights) > 0.0]
        )

    def follows(self, model: AxisModel, before: AxisModel) -> bool:
        """Say whether the closed loop agrees with the records about as well as that of another model, where it can be
        simulated.

        A model that hardly listens to its force (a huge inertia) predicts short windows by the measured motion alone.
        """
        if model.controller is None or any(r.command is None for r in self.problem.session.records):
            return True
        for m in (model, before):
            if (key := values_of(m)) not in self._loops:
                self._loops[key] = closed_errors(self.problem, m)[0]
        return self._loops[values_of(model)] <= LOOSE * self._loops[values_of(before)]

    def done(self, fit: Fit) -> bool:
        """Stop at the floor."""
        return fit.ratio <= AXIS.floor

    def levelled(self, model: AxisModel) -> Fit:
        """Bend the residual as the bounces of this model ask for; where there is no gap, leave it straight."""
        return self._straight(self.fit(model))

    def _straight(self, fit: Fit) -> Fit:
        if not has_impacts(fit.model) and self.problem is self._given:
            return fit
        self.problem = bent(self._given, fit.model) if has_impacts(fit.model) else self._given
        self._fits.clear()
        self._losses.clear()
        self._starts.clear()
        self._rough.clear()
        return self.fit(fit.model)

    def settle_step(self, added: Added[AxisModel]) -> tuple[Fit, Array]:
        """Search the numbers of a gap again: beside what is new they may be others."""
        fit, losses, _ = added
        if has_impacts(fit.model):
            fit = self._straight(self.searched(fit))
            losses = self.loss(fit)
        return fit, losses

    def settle_model(self, fit: Fit, losses: Array) -> tuple[Fit, Array]:
        """Straighten the residual where a gap has left."""
        if not has_impacts(fit.model) and self.problem is not self._given:
            fit = self._straight(fit)
            losses = self.loss(fit)
        return fit, losses

    def plainly(self, found: Found) -> Found:
        """Take back what a searched order enriched, unless it saves half: where much is unexplained some order always
        fits.
        """
        fit, losses, steps = found.fit, found.losses, list(found.path)
        for name in [n for n in fit.model.effects if n not in self.frozen and self._enrichment(n)]:
            other = next(o for o in plainer(name, self.names) if o in known()[name].replaces)
            new = self.fit(swapped(fit.model, name, other), 6)
            loss = self.loss(new)
            lost, _ = better(losses, loss)
            if lost < CLEAR:
                fit, losses = new, loss
                steps.append(Step("simplify", f"{name} to {other}", fit.ratio, -lost, fit.model))
        return Found(fit, losses, tuple(steps))

    def candidates(self, fit: Fit, passed: int = 0) -> list[Start]:
        """Screen what may be added: the best few after so many, and their confounders."""
        names = [
            n
            for n in self.names
            if n not in fit.model.effects
            and n not in self.frozen
            and not any(f in known()[n].replaces for f in self.frozen)
            and accompanied(fit.model, n)
        ]
        fresh = [n for n in names if not replaced(fit.model, n) and not self._enrichment(n) and not known()[n].joins]
        starts = [s for s in self.screen(fit, fresh) if s.gain > 0.5 * GAIN]
        starts += self._upgrades(fit, [n for n in names if replaced(fit.model, n)])
        starts.sort(key=lambda s: -s.gain)
        chosen, further = starts[passed : passed + AXIS.tries], starts[passed + AXIS.tries :]
        if chosen:
            alike = known()[chosen[0].effect].confounders
            chosen += [s for s in further if s.effect in alike and s.gain > 0.3 * chosen[0].gain]
        return chosen

    def _enrichment(self, name: str) -> bool:
        """Say whether an effect with a searched order only enriches a plainer one, which goes first."""
        effect = known()[name]
        return any(p.fixed for p in effect.parameters) and any(o in effect.replaces for o in plainer(name, self.names))

    def _upgrades(self, fit: Fit, names: list[str]) -> list[Start]:
        """Screen richer forms of an effect in the model, on top of the level it has."""
        out = []
        for name in names:
            joins = known()[name].joins
            if joins and not any(n in fit.model.effects for n in joins):
                continue
            if name in fit.model.effects:  # what it enriches became it, by what varies beside it
                continue
            old = next(n for n in known()[name].replaces if n in fit.model.effects)
            given = fit.model.effects[old]
            level = next((given[s] for s in LEVELS if s in given), None)
            levels = {p.symbol: level for p in known()[name].parameters if level is not None and p.symbol in LEVELS}
            out += self.screen(fit, [name], levels)
        return out

    def trials(self, fit: Fit, losses: Array) -> dict[str, Tried[AxisModel]]:
        """Refit the best candidates.

        A rich friction law may have bent itself to stand in for the next effect; so the best candidates are tried
        with it started afresh too.
        """
        tried: dict[str, Tried[AxisModel]] = {}
        chosen = self.candidates(fit)
        for s in sorted(chosen, key=lambda s: known()[s.effect].mechanism.bounces):
            best = min((t.fit.cost for t in tried.values()), default=np.inf)
            self._try(tried, s.effect, self._with(fit, s, 8 if s is chosen[0] else 5, best), losses)
        for effect, new in self._enriched(tried):
            self._try(tried, effect, new, losses)
        for effect in sorted(tried, key=lambda n: -tried[n].saved.share)[:BEST] if has_impacts(fit.model) else ():
            self._try(tried, effect, self.searched(tried[effect].fit), losses)
        if max((t.saved.share for t in tried.values()), default=0.0) < CLEAR:
            for effect, new in self._afresh(fit):
                self._try(tried, effect, new, losses)
        return tried

    def good(self, tried: dict[str, Tried[AxisModel]], fit: Fit, losses: Array) -> dict[str, Tried[AxisModel]]:
        """Pick those that save enough and can be; where what cannot be has taken the places of what can, try more."""
        sure, good = self._good(tried, fit, losses)
        if sure and not good:
            for s in self.candidates(fit, AXIS.tries):
                self._try(tried, s.effect, self._with(fit, s, 5), losses)
            _, good = self._good(tried, fit, losses)
        return good

    def confirmed(self, new: Fit, fit: Fit) -> Fit | None:
        """Settle what is to be added; settled, it may be what cannot be."""
        new = self.fit(new.model)
        return new if self.sound(new, fit) else None

    def unspecific(self, name: str, tried: Mapping[str, Tried[AxisModel]], fit: Fit, losses: Array) -> bool:
        """Say whether an effect of quite another kind saves nearly as much."""
        return unspecific(name, {n: t.saved.share for n, t in tried.items()})

    def order(self, name: str, tried: Tried[AxisModel], best: Fit) -> tuple[bool, int, float]:
        """Go by the number of parameters, less those that may leave beside it; a named effect goes before a nameless
        term that does no better.
        """
        names = name.split(AND)
        count = sum(map(size, names)) - self._spared(tried, names)
        return any(n not in library() for n in names), count, -tried.saved.share

    def _spared(self, tried: Tried[AxisModel], names: Sequence[str]) -> int:
        """Return how many parameters a candidate makes dispensable: the most of an effect that may leave beside it."""
        most = 0
        for name in [n for n in tried.fit.model.effects if n not in (*self.frozen, *names)]:
            without = self.bare(tried.fit, name)
            gap = self.lost(self.loss(without), tried.losses)
            if negligible(gap.share, gap.errors) and self.may_leave(without, tried.fit):
                most = max(most, size(name))
        return most

    def _good(
        self, tried: dict[str, Tried[AxisModel]], fit: Fit, losses: Array
    ) -> tuple[dict[str, Tried[AxisModel]], dict[str, Tried[AxisModel]]]:
        """Pick those that save enough, surely; and of them those that can be.

        Beside a gap, whose bounces fall out otherwise with any other number, a small saving says nothing.
        """
        least = SPECIFIC if has_impacts(fit.model) else GAIN
        sure = {n: t for n, t in tried.items() if self.surely(t.saved, least, n)}
        good = {n: t for n, t in sure.items() if self.sound(t.fit, fit)}
        best = max(sure, key=lambda n: sure[n].saved.share, default=None)
        if best is not None and best not in good:
            for new in self._plainer_beside(sure[best].fit, fit):
                if self.sound(new, fit):
                    self._try(good, best, new, losses)
        return sure, {n: t for n, t in good.items() if self.surely(t.saved, least, n)}

    def _plainer_beside(self, new: Fit, fit: Fit) -> list[Fit]:
        """Put a plainer effect, or none, in the place of each that can no longer be beside a new one: it stood for
        both.
        """
        out = []
        for name in [n for n in new.model.effects if n in fit.model.effects and not self._stays(new, fit, n)]:
            others = [o for o in plainer(name, self.names) if vacant(new.model, name, o)]
            out += [self.fit(swapped(new.model, name, o), 6) for o in others]
            out.append(self.fit(named(new.model.without_effect(name)), 6))
        return out

    def beside(self, middle: Fit, first: Start) -> list[Start]:
        """Return what is tried beside the first of a pair."""
        both = known()[first.effect].replaces
        found = (s for s in self.candidates(middle) if s.effect not in both or first.effect in known()[s.effect].joins)
        return list(found)[: AXIS.tries]

    def pair(self, first: str, second: str, new: Fit) -> str | None:
        """Name a pair; an effect that joins the first with another counts as both."""
        return second if first in known()[second].joins else Search.pair(self, first, second, new)

    def sound(self, new: Fit, fit: Fit, name: str = "") -> bool:
        """Say whether a model can be, and the closed loop does not suffer by it."""
        return self.may_leave(new, fit) and self.follows(new.model, fit.model)

    def may_leave(self, new: Fit, fit: Fit) -> bool:
        """Say whether what is new can be, and what could be before still can, or vanishes: it stood for the new."""
        kept = [n for n in new.model.effects if n not in self.frozen]
        return all(self._stays(new, fit, n) for n in kept)

    def _stays(self, new: Fit, fit: Fit, name: str) -> bool:
        return (physical(new, name) and self._repeats(new.model, name)) or (
            name in fit.model.effects and (small(new.model, name) or not physical(fit, name))
        )

    def _repeats(self, model: AxisModel, name: str) -> bool:
        """Say whether the travel holds enough periods of what repeats with place to have a name for it."""
        effect = known()[name]
        orders = [model.effects[name][p.symbol] for p in effect.parameters if p.fixed and p.unit == "1/pitch"]
        return name not in library() or all(n * self._travel >= WAVES * model.pitch for n in orders)

    @cached_property
    def _travel(self) -> float:
        places = [r.position[self._given.span(r)] for r in self._given.session.records]
        return float(max(x.max() for x in places) - min(x.min() for x in places))

    def _with(self, fit: Fit, start: Start, iterations: int, best: float = np.inf) -> Fit:
        """Switch a candidate on, what it replaces off, and refit."""
        return self.fit(self.switched_on(fit, start), iterations, best)

    def switched_on(self, fit: Fit, start: Start) -> AxisModel:
        """Switch a candidate on, and off what it replaces."""
        return exchanged(fit.model, start.effect, start.values)

    def _try(self, tried: dict[str, Tried[AxisModel]], effect: str, new: Fit, losses: Array) -> None:
        """Score a refitted candidate; keep the better of two ways to the same effect."""
        loss = self.loss(new)
        saved = self.saving(loss, losses)
        if effect not in tried or saved.share > tried[effect].saved.share:
            tried[effect] = Tried(new, loss, saved)

    def _enriched(self, tried: Mapping[str, Tried[AxisModel]]) -> list[tuple[str, Fit]]:
        """Start rich effects from their plain form too, where both were tried: from far the speed of a drop is not
        found.
        """
        pairs = [(n, o) for n in tried for o in plainer(n, self.names) if o in tried and o in known()[n].replaces]
        return [
            (name, self._with(tried[other].fit, start, 5))
            for name, other in pairs
            for start in self._upgrades(tried[other].fit, [name])[:1]
        ]

    def _afresh(self, fit: Fit) -> list[tuple[str, Fit]]:
        """Add the best candidates to the plain form of each rich friction law, then enrich it afresh."""
        out = []
        for name in [n for n in fit.model.effects if n not in self.frozen]:
            for other in [o for o in plainer(name, self.names) if o in known()[name].replaces]:
                base = self.fit(swapped(fit.model, name, other), 5)
                starts = [s for s in self.candidates(base) if name not in (s.effect, *known()[s.effect].replaces)]
                for s in starts[:2]:
                    middle = self._with(base, s, 5)
                    out += [(s.effect, self._with(middle, again, 6)) for again in self._upgrades(middle, [name])[:1]]
        return out

    def hopeless(self, new: Fit, losses: Array, least: float) -> bool:
        """Say whether a fit leaves too much of all blocks, to which it was fitted, to save a share of held-out ones."""
        return new.cost > (1.0 - least) * float(losses.sum())

    def surely(self, saved: Saving, least: float, name: str) -> bool:
        """Say whether an effect saves at least a share, surely; one whose order is searched must do so more surely."""
        searched = name and any(p.fixed for p in known()[name].parameters)
        return saved.share >= least and saved.errors >= (PERIODIC_SURE if searched else SURE)

    def bare(self, fit: Fit, name: str) -> Fit:
        """Fit without an effect; what varied beside it is named as it is named without."""
        return self.searched(self.fit(named(fit.model.without_effect(name)), 6), fit.cost)

    def vanished(self, fit: Fit, name: str) -> bool:
        """Say whether an effect has become smaller than it may be to be named."""
        return small(fit.model, name)

    def simpler(self, fit: Fit, name: str) -> Iterator[tuple[str, str, Fit]]:
        """Yield confounders of fewer parameters in the place of an effect, and formulas in that of a law that is one of
        them.
        """
        for model, other in formulas_of(fit.model, name, self.names):
            yield name, other, self.fit(model, 6)
        for other in plainer(name, self.names):
            if vacant(fit.model, name, other):
                yield name, other, self.fit(swapped(fit.model, name, other), 6)


def values_of(model: AxisModel) -> Hashable:
    """Return all that a search may change of a model, to look it up by."""
    return (
        (model.inertia, model.viscous, model.refine, tuple(model.within.items())),
        tuple((n, *v.items()) for n, v in model.effects.items()),
    )
