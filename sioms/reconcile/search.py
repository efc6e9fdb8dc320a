"""Search for the effects that are missing: screen, refit the best few nested, let earlier ones leave again.

A step adds the effect that saves most on held-out blocks, but the simplest one within a standard error of
it. After each step every effect must still earn its place, and a simpler look-alike that does as well takes
the place of a richer one. The search stops when nothing saves ``GAIN`` of what remains.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from sioms.reconcile import ladder
from sioms.reconcile.blocks import better, block_ids, heldout
from sioms.reconcile.bounces import POLISHED, UNPOLISHED, bent, polish, rattles, rough, spread
from sioms.reconcile.effect import Array
from sioms.reconcile.effects import known
from sioms.reconcile.fit import Fit, Problem, closed_errors, refit, shifted
from sioms.reconcile.model import AxisModel
from sioms.reconcile.plausible import (
    AND,
    Tried,
    physical,
    plainer,
    replaced,
    simplest,
    small,
    swapped,
    unspecific,
    vacant,
)
from sioms.reconcile.rules import negligible
from sioms.reconcile.screen import Start, screen
from sioms.reconcile.thresholds import AXIS, CLEAR, GAIN, LOOSE, PAIRS, PERIODIC_SURE, SPECIFIC, SURE
from sioms.reconcile.variation import accompanied, exchanged, named

PASSES = 4  # at most so many times more for a new gap, while it gains
BEST = 2  # of the candidates beside a gap are judged with its numbers searched anew
#: What the levels of laws of dry friction are called.
LEVELS = ("Fc", "Fs", "f")
WORTH = 2.0  # and not where another candidate leaves less by this factor
#: Fits are kept in memory up to this size: a second search, with terms beside the library, retraces the first.
KEPT_BYTES = 128_000_000


Step = ladder.Step[AxisModel]
Found = ladder.Found[Fit, AxisModel]


@dataclass(slots=True)
class Searcher:
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
    ids: NDArray[np.int64] = field(init=False)
    _given: Problem = field(init=False)
    _fits: dict[Hashable, Fit] = field(init=False, default_factory=dict)
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
        for _ in range(PASSES if rattles(fit.model) else 0):
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
        """Held-out loss per block; beside a gap, whose rough cost has no slope to go by, with all numbers as they
        are.
        """
        if len(self.ids) != len(fit.residual):
            self.ids = block_ids(self.problem, fit.model.sample_time_s)
        losses = heldout(
            replace(fit, jacobian=fit.jacobian[:, :0]) if rattles(fit.model) else fit,
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

    def run(self, start: AxisModel) -> Found:
        """Search from a model."""
        fit, losses = self._on_one_footing(self.fit(start))
        steps = [Step("start", "", fit.ratio, 0.0, fit.model)]
        for _ in range(AXIS.steps):
            if fit.ratio <= AXIS.floor:
                break
            step = self._add(fit, losses) or self._add_pair(fit, losses)
            if step is None:
                break
            steps.append(step[2])
            fit, losses = step[0], step[1]
            if rattles(fit.model):  # beside what is new its numbers may be others
                fit, losses = self._on_one_footing(self.searched(fit))
            self.progress(f"{steps[-1].action} {steps[-1].effect}: residual {fit.ratio:.2f} of the expected")
            fit, losses = self._simplify(fit, losses, steps)
            fit, losses = self._eliminate(fit, losses, steps)
            if not rattles(fit.model) and self.problem is not self._given:
                fit, losses = self._on_one_footing(fit)
        return Found(fit, losses, tuple(steps))

    def _on_one_footing(self, fit: Fit) -> tuple[Fit, Array]:
        """Bend the residual as the bounces of this model ask for; where there is no gap, leave it straight."""
        if rattles(fit.model) or self.problem is not self._given:
            self.problem = bent(self._given, fit.model) if rattles(fit.model) else self._given
            self._fits.clear()
            self._starts.clear()
            self._rough.clear()
            fit = self.fit(fit.model)
        return fit, self.loss(fit)

    def plainly(self, found: Found) -> Found:
        """Take back what a searched order enriched, unless it saves half: where much is unexplained some order always
        fits.
        """
        fit, losses, steps = found.fit, found.losses, list(found.ladder)
        for name in [n for n in fit.model.effects if n not in self.frozen and self._enrichment(n)]:
            other = next(o for o in plainer(name, self.names) if o in known()[name].replaces)
            new = self.fit(swapped(fit.model, name, other), 6)
            loss = self.loss(new)
            lost, _ = better(losses, loss)
            if lost < CLEAR:
                fit, losses = new, loss
                steps.append(Step("simplify", f"{name} to {other}", fit.ratio, -lost, fit.model))
        return Found(fit, losses, tuple(steps))

    def _candidates(self, fit: Fit, passed: int = 0) -> list[Start]:
        """Screen what may be added: the best few after so many, and their look-alikes."""
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
            alike = known()[chosen[0].effect].lookalikes
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

    def _add(self, fit: Fit, losses: Array) -> tuple[Fit, Array, Step] | None:
        """Refit the best candidates and take the simplest of those that save most.

        A rich friction law may have bent itself to stand in for the next effect; so the best candidates are tried
        with it started afresh too.
        """
        tried: dict[str, Tried] = {}
        chosen = self._candidates(fit)
        for s in sorted(chosen, key=lambda s: known()[s.effect].mechanism.bounces):
            best = min((t[0].cost for t in tried.values()), default=np.inf)
            self._try(tried, s.effect, self._with(fit, s, 8 if s is chosen[0] else 5, best), losses)
        for effect, new in self._enriched(tried):
            self._try(tried, effect, new, losses)
        for effect in sorted(tried, key=lambda n: -tried[n][2])[:BEST] if rattles(fit.model) else ():
            self._try(tried, effect, self.searched(tried[effect][0]), losses)
        if max((t[2] for t in tried.values()), default=0.0) < CLEAR:
            for effect, new in self._afresh(fit):
                self._try(tried, effect, new, losses)
        sure, good = self._good(tried, fit, losses)
        if sure and not good:  # what cannot be has taken the places of what can
            for s in self._candidates(fit, AXIS.tries):
                self._try(tried, s.effect, self._with(fit, s, 5), losses)
            sure, good = self._good(tried, fit, losses)
        while good:
            name = simplest(good)
            new = self.fit(good[name][0].model)  # settled, it may be what cannot be
            if self._sound(new, fit):
                break
            del good[name]
        else:
            return None
        loss = self.loss(new)
        gain, _ = better(loss, losses)
        if gain < SPECIFIC and unspecific(name, {n: t[2] for n, t in tried.items()}):
            return None
        rivals = {n: t[2] for n, t in tried.items() if n != name}
        return new, loss, Step("add", name, new.ratio, gain, new.model, rivals)

    def _good(self, tried: dict[str, Tried], fit: Fit, losses: Array) -> tuple[dict[str, Tried], dict[str, Tried]]:
        """Pick those that save enough, surely; and of them those that can be.

        Beside a gap, whose bounces fall out otherwise with any other number, a small saving says nothing.
        """
        least = SPECIFIC if rattles(fit.model) else GAIN
        sure = {n: t for n, t in tried.items() if t[2] >= least and t[3] >= self._sure(n)}
        good = {n: t for n, t in sure.items() if self._sound(t[0], fit)}
        best = max(sure, key=lambda n: sure[n][2], default=None)
        if best is not None and best not in good:
            for new in self._plainer_beside(sure[best][0], fit):
                if self._sound(new, fit):
                    self._try(good, best, new, losses)
        return sure, {n: t for n, t in good.items() if t[2] >= least and t[3] >= self._sure(n)}

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

    def _add_pair(self, fit: Fit, losses: Array) -> tuple[Fit, Array, Step] | None:
        """Add two effects at once where neither saves enough alone: each hides what the other would save.

        Both must be sure together, and each must earn its place beside the other. One that joins the first with another
        counts as both.
        """
        pairs: dict[str, Tried] = {}
        if fit.ratio < AXIS.paired:
            return None
        for first in self._candidates(fit)[:PAIRS]:
            middle = self._with(fit, first, 5, fit.cost)
            if middle.cost > fit.cost:  # it only takes the place of something better
                continue
            inner = self.loss(middle)
            beside = [
                s
                for s in self._candidates(middle)
                if s.effect not in known()[first.effect].replaces or first.effect in known()[s.effect].joins
            ]
            for second in beside[: AXIS.tries]:
                new = self._with(middle, second, 8, min((t[0].cost for t in pairs.values()), default=middle.cost))
                joined = first.effect in known()[second.effect].joins
                if first.effect not in new.model.effects and not joined:
                    continue
                loss = self.loss(new)
                gain, sure = better(loss, losses)
                more, surer = better(loss, inner)
                good = gain >= SPECIFIC and sure >= SURE and more >= SPECIFIC and surer >= self._sure(second.effect)
                if good and self._sound(new, fit):
                    name = second.effect if joined else f"{first.effect}{AND}{second.effect}"
                    pairs[name] = new, loss, gain, sure
        if not pairs:
            return None
        both = simplest(pairs)
        new, loss, gain, _ = pairs[both]
        return new, loss, Step("add", both, new.ratio, gain, new.model)

    def _sound(self, new: Fit, fit: Fit) -> bool:
        """Say whether a model can be, and the closed loop does not suffer by it."""
        return self._possible(new, fit) and self.follows(new.model, fit.model)

    def _possible(self, new: Fit, fit: Fit) -> bool:
        """Say whether what is new can be, and what could be before still can, or vanishes: it stood for the new."""
        kept = [n for n in new.model.effects if n not in self.frozen]
        return all(self._stays(new, fit, n) for n in kept)

    def _stays(self, new: Fit, fit: Fit, name: str) -> bool:
        return physical(new, name) or (
            name in fit.model.effects and (small(new.model, name) or not physical(fit, name))
        )

    def _with(self, fit: Fit, start: Start, iterations: int, best: float = np.inf) -> Fit:
        """Switch a candidate on, what it replaces off, and refit."""
        return self.fit(exchanged(fit.model, start.effect, start.values), iterations, best)

    def _try(self, tried: dict[str, Tried], effect: str, new: Fit, losses: Array) -> None:
        """Score a refitted candidate; keep the better of two ways to the same effect."""
        loss = self.loss(new)
        gain, sure = better(loss, losses)
        if effect not in tried or gain > tried[effect][2]:
            tried[effect] = (new, loss, gain, sure)

    def _enriched(self, tried: Mapping[str, Tried]) -> list[tuple[str, Fit]]:
        """Start rich effects from their plain form too, where both were tried: from far the speed of a drop is not
        found.
        """
        pairs = [(n, o) for n in tried for o in plainer(n, self.names) if o in tried and o in known()[n].replaces]
        return [
            (name, self._with(tried[other][0], start, 5))
            for name, other in pairs
            for start in self._upgrades(tried[other][0], [name])[:1]
        ]

    def _afresh(self, fit: Fit) -> list[tuple[str, Fit]]:
        """Add the best candidates to the plain form of each rich friction law, then enrich it afresh."""
        out = []
        for name in [n for n in fit.model.effects if n not in self.frozen]:
            for other in [o for o in plainer(name, self.names) if o in known()[name].replaces]:
                base = self.fit(swapped(fit.model, name, other), 5)
                starts = [s for s in self._candidates(base) if name not in (s.effect, *known()[s.effect].replaces)]
                for s in starts[:2]:
                    middle = self._with(base, s, 5)
                    out += [(s.effect, self._with(middle, again, 6)) for again in self._upgrades(middle, [name])[:1]]
        return out

    def _sure(self, name: str) -> float:
        return PERIODIC_SURE if any(p.fixed for p in known()[name].parameters) else SURE

    def _eliminate(self, fit: Fit, losses: Array, steps: list[Step]) -> tuple[Fit, Array]:
        """Let effects leave that no longer save their share."""
        for name in [n for n in fit.model.effects if n not in self.frozen]:
            if len([n for n in fit.model.effects if n not in self.frozen]) < 2:
                break
            if name not in fit.model.effects:  # it left with what it stood beside
                continue
            without = self.searched(self.fit(named(fit.model.without_effect(name)), 6), fit.cost)
            loss = self.loss(without)
            gain, sure = better(losses, loss)
            if (negligible(gain, sure) and self._possible(without, fit)) or small(fit.model, name):
                fit, losses = without, loss
                steps.append(Step("leave", name, fit.ratio, -gain, fit.model))
        return fit, losses

    def _simplify(self, fit: Fit, losses: Array, steps: list[Step]) -> tuple[Fit, Array]:
        """Put a simpler look-alike in the place of a richer effect where it does as well."""
        for name in [n for n in fit.model.effects if n not in self.frozen]:
            for other in plainer(name, self.names):
                if name not in fit.model.effects or not vacant(fit.model, name, other):
                    continue
                new = self.fit(swapped(fit.model, name, other), 6)
                loss = self.loss(new)
                lost, sure = better(losses, loss)
                if negligible(lost, sure):
                    fit, losses = new, loss
                    steps.append(Step("simplify", f"{name} to {other}", fit.ratio, -lost, fit.model))
                    break
        return fit, losses


def values_of(model: AxisModel) -> Hashable:
    """Return all that a search may change of a model, to look it up by."""
    return (
        tuple(getattr(model, symbol) for symbol in model.refine),
        tuple((n, *v.items()) for n, v in model.effects.items()),
    )
