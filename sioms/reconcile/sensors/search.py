"""Search for the missing effects of a sensor: screen, refit nested, let earlier ones leave again.

The rules are those of the axis (``sioms.reconcile.search``); evidence comes in views (touches, courses in
time, untouched frames ...), every view is brought to the floor on one footing, and an effect is judged in the
view where it shows most.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np

from sioms.reconcile import ladder
from sioms.reconcile.blocks import better, heldout
from sioms.reconcile.effect import TERM_PREFIX
from sioms.reconcile.rules import negligible
from sioms.reconcile.sensors.effect import Array, SensorModel
from sioms.reconcile.sensors.fit import Data, Fit, on_one_footing, ratios, refit
from sioms.reconcile.sensors.plausible import family, physical, termed, without
from sioms.reconcile.sensors.screen import Start, screen
from sioms.reconcile.thresholds import DEEP, GAIN, NEARLY, PAIRS, SENSOR, SPECIFIC, SURE


@dataclass(frozen=True, slots=True)
class Saving:
    """What one model saves against another: share and standard errors in its best view, and those of all views
    together.
    """

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


Step = ladder.Step[SensorModel]
Found = ladder.Found[Fit, SensorModel]


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
        """Search from a model; where the floor is not reached, again without the first step, which led astray if that
        reaches it.
        """
        found = self._run(start)
        steps = [r for r in found.ladder if r.action == "add"]
        if len(steps) < 2 or not self.loud(found.fit) or set(self.terms) & set(self.names):
            return found
        names, footing = self.names, self.weights
        self.names = tuple(n for n in names if n != steps[0].effect)
        other = self._run(start)
        self.names = names
        if not self.loud(other.fit):
            self.progress(f"{steps[0].effect} led astray: what is found without it reaches the floor")
            return other
        self.weights = footing
        return found

    def _run(self, start: SensorModel) -> Found:
        fit = self.levelled(start)
        losses = self.loss(fit)
        steps = [Step("start", "", self.ratio(fit), 0.0, fit.model)]
        for _ in range(SENSOR.steps):
            step = self._add(fit, losses) or self._add_pair(fit, losses) or self._restart(fit)
            if step is None:
                break
            steps.append(step)
            fit = self.levelled(step.model)
            losses = self.loss(fit)
            self.progress(f"{step.action} {step.effect}: residual {self.ratio(fit):.2f} of the floor")
            fit, losses = self._simplify(fit, losses, steps)
            fit, losses = self.eliminate(fit, losses, steps)
        return Found(fit, losses, tuple(steps))

    def levelled(self, model: SensorModel) -> Fit:
        """Fit, bring the views to one footing, and fit again."""
        self.weights = on_one_footing(self.data, model)
        fit = self.fit(model)
        self.weights = on_one_footing(self.data, fit.model)
        return self.fit(fit.model)

    def loud(self, fit: Fit) -> list[str]:
        """Views that are above their floor."""
        return [v for v, ratio in zip(self.data.views, self.ratios(fit.model), strict=True) if ratio > SENSOR.floor]

    def ratio(self, fit: Fit) -> float:
        """Root mean square over all rows, in units of the floor."""
        return float(np.sqrt(np.mean((fit.residual / self.weights) ** 2)))

    def _add(self, fit: Fit, losses: Array) -> Step | None:
        """Refit the best candidates and take the simplest of those that save most.

        Below the floor, which is an estimate, only what saves much on blocks held out is no noise.
        """
        tried: dict[str, tuple[Fit, Array, Saving]] = {}
        loud = self.loud(fit)
        for start in self.candidates(fit):
            new = self.fit(self.switched_on(fit, start))
            loss = self.loss(new)
            tried[start.effect] = (new, loss, self.saving(loss, losses, loud))
        good = {
            n: t
            for n, t in tried.items()
            if (surely(t[2], GAIN) if loud else beyond_noise(t[2]) and not termed(fit.model))
            and physical(t[0].model, n)
        }
        if not good:
            return None
        name = self._simplest(good)
        new, _, saved = good[name]
        if saved.share < SPECIFIC and self._may_be_another(fit, losses, name, tried):
            return None
        others = {n: t[2].share for n, t in tried.items() if n != name}
        return Step("add", name, self.ratio(new), saved.share, new.model, others)

    def _may_be_another(
        self, fit: Fit, losses: Array, name: str, tried: Mapping[str, tuple[Fit, Array, Saving]]
    ) -> bool:
        """Say whether what an effect saves may be a part of what another saves, of what a term does not fit, or of what
        has no name.

        Effects are compared on what they count by: their share of one view, below the floor that of everything.
        """
        new, _, saved = tried[name]
        if termed(new.model):
            return termed(fit.model) or not beyond_noise(saved)
        below, alike = not self.loud(fit), family(new.model, name)
        for n, (_, _, other) in tried.items():
            nearly = other.total / saved.total if below else (other.view == saved.view) * other.share / saved.share
            if n not in alike and nearly > NEARLY:
                return True
        return self._nameless(fit, losses, saved)

    def _add_pair(self, fit: Fit, losses: Array) -> Step | None:
        """Add two effects at once where neither is sure alone: each hides what the other would save.

        Both must save much together, and each much beside the other; less than that has no name yet.
        """
        if np.max(self.ratios(fit.model)) < SENSOR.paired:
            return None
        best: tuple[Saving, Fit, str] | None = None
        for first in self.candidates(fit)[:PAIRS]:
            middle = self.fit(self.switched_on(fit, first), 4)
            inner = self.loss(middle)
            for second in self.candidates(middle)[:PAIRS]:
                new = self.fit(self.switched_on(middle, second))
                if first.effect not in new.model.effects or second.effect in family(new.model, first.effect):
                    continue
                loss = self.loss(new)
                saved, more = self.saving(loss, losses), self.saving(loss, inner)
                sure = surely(saved, SPECIFIC) and surely(more, SPECIFIC)
                good = sure and physical(new.model, first.effect) and physical(new.model, second.effect)
                if good and (best is None or new.cost < best[1].cost):
                    best = saved, new, f"{first.effect} and {second.effect}"
        if best is None or self._nameless(fit, losses, best[0]):
            return None
        saved, new, name = best
        return Step("add", name, self.ratio(new), saved.share, new.model)

    def _restart(self, fit: Fit) -> Step | None:
        """Let shapes of the elements' own, of which some may have stuck, begin again."""
        own = [
            (name, q.symbol, start)
            for name in fit.model.effects
            if name not in self.frozen and self.loud(fit)
            for q in fit.model.library[name].parameters[1:]
            for start in (q.starts if q.each else ())
        ]
        best = self.restarted(fit, own)
        if best is fit:
            return None
        return Step("restart", "shapes", self.ratio(best), 1.0 - best.cost / fit.cost, best.model)

    def restarted(self, fit: Fit, own: Iterable[tuple[str, str, float]]) -> Fit:
        """Let numbers of the elements' own begin again at some values; each element keeps what is best for it.

        Args:
            own: effect, symbol and where all elements begin.

        Returns:
            The given fit where nothing is better by ``GAIN``.
        """
        count, best = fit.model.count, fit
        for name, symbol, start in own:
            held = best.model.effects[name]
            moved = self.fit(best.model.with_effect(name, {**held, symbol: np.full(count, start)}))
            better_there = self.squares(moved) < (1.0 - GAIN) * self.squares(best)
            values = {
                s: np.where(better_there, v, held[s]) if len(v) == count > 1 else v
                for s, v in moved.model.effects[name].items()
            }
            new = self.fit(best.model.with_effect(name, values))
            best = new if new.cost < (1.0 - GAIN) * best.cost else best
        return best

    def squares(self, fit: Fit) -> Array:
        """Sum of squares of each element, shape (count,)."""
        own = self.data.element >= 0
        out: Array = np.bincount(self.data.element[own], fit.residual[own] ** 2, fit.model.count).astype(np.float64)
        return out

    def switched_on(self, fit: Fit, start: Start) -> SensorModel:
        """Switch a candidate on, and off what it replaces."""
        model = without(fit.model, fit.model.library[start.effect].replaces)
        return model.with_effect(start.effect, start.values)

    def _nameless(self, fit: Fit, losses: Array, saved: Saving) -> bool:
        """Say whether a term without a name saves far more than the best name does: then the residual has no name
        yet.
        """
        free = [n for n in self.terms if n not in self.names and n not in fit.model.effects]
        starts = [s for n in free for s in screen(self.data, fit, self.weights, fit.model.library[n], self.frozen)[:1]]
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
        named = not termed(model)  # where something has no name, a name is no better than another term

        def order(n: str) -> tuple[bool, int, float]:
            return named and n.startswith(TERM_PREFIX), model.library[n].size(model.count), -good[n][2].total

        return min(near or [best], key=order)

    def eliminate(self, fit: Fit, losses: Array, steps: list[Step]) -> tuple[Fit, Array]:
        """Let effects leave that no longer save their share."""
        for name in [n for n in fit.model.effects if n not in self.frozen]:
            if len(fit.model.effects) < 2:
                break
            bare = self.fit(fit.model.without_effect(name))
            loss = self.loss(bare)
            gap = self.lost(loss, losses)
            if negligible(gap.share, gap.errors):
                fit, losses = bare, loss
                steps.append(Step("leave", name, self.ratio(fit), -gap.share, fit.model))
        return fit, losses

    def _simplify(self, fit: Fit, losses: Array, steps: list[Step]) -> tuple[Fit, Array]:
        """Put a look-alike of fewer numbers in the place of an effect, or of all that it is like, where it does as
        well.
        """
        for name in [n for n in fit.model.effects if n not in self.frozen]:
            for other, gone in self._simpler(fit.model, name):
                bare = self.fit(without(fit.model, gone), 0)  # the others stay where they are, or they make up for it
                start = next(iter(screen(self.data, bare, self.weights, fit.model.library[other], self.frozen)), None)
                if start is None:
                    continue
                new = self.fit(bare.model.with_effect(other, start.values))
                loss = self.loss(new)
                gap = self.lost(loss, losses)
                if negligible(gap.share, gap.errors) and physical(new.model, other):
                    fit, losses = new, loss
                    said = f"{' and '.join(gone)} to {other}"
                    steps.append(Step("simplify", said, self.ratio(fit), -gap.share, fit.model))
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
        chosen = found[: SENSOR.tries]
        if chosen:
            alike = family(fit.model, chosen[0].effect)
            chosen += [s for s in found[SENSOR.tries :] if s.effect in alike]
        return chosen


def surely(saved: Saving, least: float) -> bool:
    """Say whether at least a share is saved, surely there or in all views together, and nothing lost in all."""
    return saved.share >= least and max(saved.errors, saved.surely) >= SURE and saved.total > 0.0


def beyond_noise(saved: Saving) -> bool:
    """Say whether what is saved of everything below the floor is too much, and too sure, for noise."""
    return saved.total >= GAIN and saved.surely >= DEEP
