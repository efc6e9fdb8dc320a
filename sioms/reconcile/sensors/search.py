"""Search for the missing effects of a sensor: screen, refit nested, let earlier ones leave again.

Evidence comes in views (touches, courses in time, untouched frames ...), every view is brought to the floor on one
footing, and an effect is judged in the view where it shows most.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from sioms.reconcile import selection
from sioms.reconcile.blocks import better, heldout
from sioms.reconcile.effect import TERM_PREFIX
from sioms.reconcile.engine.search import AND, Added, Saving, Search, Start, Tried
from sioms.reconcile.sensors.effect import Array, SensorModel
from sioms.reconcile.sensors.fit import Data, Fit, on_one_footing, ratios, refit
from sioms.reconcile.sensors.plausible import family, physical, termed, without
from sioms.reconcile.sensors.screen import screen
from sioms.reconcile.thresholds import BY_CHANCE, DEEP, GAIN, NEARLY, SENSOR, SURE

Step = selection.Step[SensorModel]
Found = selection.Found[Fit, SensorModel]


@dataclass(slots=True)
class Searcher(Search[SensorModel]):
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
    footing: ClassVar = SENSOR
    weights: Array = field(init=False)

    def __post_init__(self) -> None:
        self.weights = np.ones(len(self.data.view))

    # -- fits and losses

    def fit(self, model: SensorModel, iterations: int = 6, best: float = np.inf) -> Fit:
        """Refit all free numbers."""
        return refit(self.data, model, self.weights, self.frozen, iterations)

    def loss(self, fit: Fit) -> Array:
        """Held-out loss per block."""
        return heldout(fit, self.data.block)

    def ratios(self, model: SensorModel) -> Array:
        """Return the root mean square of each view in units of its floor."""
        return ratios(self.data, model)

    @property
    def of_block(self) -> NDArray[np.int64]:
        """Number of the view of each block, shape (blocks,)."""
        view = np.zeros(int(self.data.block.max()) + 1, dtype=np.int64)
        view[self.data.block] = self.data.view
        return view

    def saving(self, new: Array, old: Array, among: Collection[str] = ()) -> Saving:
        """Compare held-out losses by view: of all views, or of some."""
        best = Saving(-np.inf, 0.0, "", *better(new, old))
        of_block = self.of_block
        for i, view in enumerate(self.data.views):
            mine = of_block == i
            if np.count_nonzero(mine) < 2 or (among and view not in among):
                continue
            share, errors = better(new[mine], old[mine])
            new_one = Saving(share, errors, view, best.total, best.surely)
            if best.view == "" or new_one.weight > best.weight:
                best = new_one
        return best

    # -- search

    def run(self, start: SensorModel) -> Found:
        """Search from a model; where the floor is not reached, again without the first step, which led astray if that
        reaches it.
        """
        found = Search.run(self, start)
        steps = [r for r in found.path if r.action == "add"]
        if len(steps) < 2 or not self.loud(found.fit) or set(self.terms) & set(self.names):
            return found
        names, footing = self.names, self.weights
        self.names = tuple(n for n in names if n != steps[0].effect)
        other = Search.run(self, start)
        self.names = names
        if not self.loud(other.fit):
            self.progress(f"{steps[0].effect} led astray: what is found without it reaches the floor")
            return other
        self.weights = footing
        return found

    def levelled(self, model: SensorModel) -> Fit:
        """Fit, bring the views to one footing, and fit again."""
        self.weights = on_one_footing(self.data, model)
        fit = self.fit(model)
        self.weights = on_one_footing(self.data, fit.model)
        return self.fit(fit.model)

    def loud(self, fit: Fit) -> list[str]:
        """Views that are above their floor, further than chance brings so few rows."""
        above = self.ratios(fit.model) > self.beyond_chance(SENSOR.floor)
        return [v for v, is_above in zip(self.data.views, above, strict=True) if is_above]

    def beyond_chance(self, least: float) -> Array:
        """Return for each view the multiple of its floor, at least ``least``, that chance brings no such count of
        rows to.
        """
        rows = np.bincount(self.data.view, minlength=len(self.data.views))
        return np.maximum(least, 1.0 + BY_CHANCE / np.sqrt(2.0 * np.maximum(rows, 1)))

    def ratio(self, fit: Fit) -> float:
        """Root mean square over all rows, in units of the floor."""
        return float(np.sqrt(np.mean((fit.residual / self.weights) ** 2)))

    def trials(self, fit: Fit, losses: Array) -> dict[str, Tried[SensorModel]]:
        """Refit the best candidates."""
        tried = {}
        for start in self.candidates(fit):
            new = self.fit(self.switched_on(fit, start))
            loss = self.loss(new)
            tried[start.effect] = Tried(new, loss, self.judged(loss, losses, fit))
        return tried

    def judged(self, losses: Array, old: Array, fit: Fit) -> Saving:
        """Return what a candidate saves in the views above their floor, where there is one."""
        return self.saving(losses, old, self.loud(fit))

    def good(self, tried: dict[str, Tried[SensorModel]], fit: Fit, losses: Array) -> dict[str, Tried[SensorModel]]:
        """Pick those that save enough, surely.

        Below the floor, which is an estimate, only what saves much on blocks held out is no noise.
        """
        loud, taken = self.loud(fit), termed(fit.model)
        return {
            n: t
            for n, t in tried.items()
            if (surely(t.saved, GAIN) if loud else beyond_noise(t.saved) and not taken) and physical(t.fit.model, n)
        }

    def order(self, name: str, tried: Tried[SensorModel], best: Fit) -> tuple[bool, int, float]:
        """Go by the count of numbers; where something has no name, a name is no better than another term."""
        lib, count, names = best.model.library, best.model.count, name.split(AND)
        term = not termed(best.model) and any(n.startswith(TERM_PREFIX) for n in names)
        return term, sum(lib[n].size(count) for n in names), -tried.saved.total

    def unspecific(self, name: str, tried: Mapping[str, Tried[SensorModel]], fit: Fit, losses: Array) -> bool:
        """Say whether what an effect saves may be a part of what another saves, of what a term does not fit, or of what
        has no name.

        Effects are compared on what they count by: their share of one view, below the floor that of everything.
        """
        new, saved = tried[name].fit, tried[name].saved
        if termed(new.model):
            return termed(fit.model) or not beyond_noise(saved)
        below, alike = not self.loud(fit), family(new.model, name)
        for n, other in ((n, t.saved) for n, t in tried.items()):
            nearly = other.total / saved.total if below else (other.view == saved.view) * other.share / saved.share
            if n not in alike and nearly > NEARLY:
                return True
        return self._nameless(fit, losses, saved)

    def loudest(self, fit: Fit) -> float:
        """Return the largest root mean square of a view, in units of its floor."""
        return float(np.max(self.ratios(fit.model)))

    def surely(self, saved: Saving, least: float, name: str) -> bool:
        """Say whether an effect saves at least a share, surely."""
        return surely(saved, least)

    def pair(self, first: str, second: str, new: Fit) -> str | None:
        """Name a pair; two of a family are none."""
        return None if second in family(new.model, first) else Search.pair(self, first, second, new)

    def sound(self, new: Fit, fit: Fit, name: str) -> bool:
        """Say whether the numbers of new effects can be."""
        return all(physical(new.model, n) for n in name.split(AND))

    def named(self, best: Tried[SensorModel], fit: Fit, losses: Array) -> bool:
        """Say whether no term saves far more than a pair."""
        return not self._nameless(fit, losses, best.saved)

    def restart(self, fit: Fit) -> Added[SensorModel] | None:
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
        step = Step("restart", "shapes", self.ratio(best), 1.0 - best.cost / fit.cost, best.model)
        return best, self.loss(best), step

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

    def bare(self, fit: Fit, name: str) -> Fit:
        """Fit without an effect."""
        return self.fit(fit.model.without_effect(name))

    def simpler(self, fit: Fit, name: str) -> Iterator[tuple[str, str, Fit]]:
        """Yield confounders of fewer numbers in the place of an effect, or of all that it is like."""
        for other, gone in self._simpler(fit.model, name):
            bare = self.fit(without(fit.model, gone), 0)  # the others stay where they are, or they make up for it
            start = next(iter(screen(self.data, bare, self.weights, fit.model.library[other], self.frozen)), None)
            if start is not None:
                yield AND.join(gone), other, self.fit(bare.model.with_effect(other, start.values))

    def may_stand(self, new: Fit, name: str) -> bool:
        """Say whether the numbers of a confounder can be."""
        return physical(new.model, name)

    def _simpler(self, model: SensorModel, name: str) -> list[tuple[str, tuple[str, ...]]]:
        """Confounders of an effect with what each could take the place of, of more numbers in all."""
        lib, out = model.library, []
        if name not in model.effects:
            return []
        for other in [n for n in lib[name].confounders if n in self.names and n not in model.effects]:
            like = tuple(n for n in model.effects if n in lib[other].confounders and n not in self.frozen)
            for gone in ((name,), tuple(dict.fromkeys((name, *like)))):
                if lib[other].size(model.count) < sum(lib[n].size(model.count) for n in gone):
                    out.append((other, gone))
        return list(dict.fromkeys(out))

    def candidates(self, fit: Fit) -> list[Start]:
        """Screen every effect that is not in the model; the best few, confounders of the best among them."""
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
