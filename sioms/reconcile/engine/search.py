"""Search for the effects that are missing: screen, refit the best few nested, let earlier ones leave again.

A step adds the effect that saves most on held-out blocks, but the simplest one within a standard error of it. After
each step every effect must still earn its place, and a simpler confounder that does as well takes the place of a richer
one. The search stops when nothing saves ``GAIN`` of what remains. What a subject fits, screens and calls possible it
says in its own ``Searcher``.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Generic

import numpy as np

from sioms.reconcile import selection
from sioms.reconcile.blocks import better
from sioms.reconcile.effect import Array
from sioms.reconcile.engine.fit import Fit, M
from sioms.reconcile.rules import negligible
from sioms.reconcile.thresholds import PAIRS, SPECIFIC, SURE, Footing

#: Joins the names of effects that came at once.
AND = " and "


@dataclass(frozen=True, slots=True)
class Start:
    """A screened candidate.

    Attributes:
        gain: share of the squares that it would save, of the view in which it saves most.
        values: to start its fit from.
        total: the same share of all squares.
    """

    effect: str
    gain: float
    values: Mapping[str, Any]
    total: float = 0.0


@dataclass(frozen=True, slots=True)
class Saving:
    """What one model saves against another on held-out blocks: share and standard errors in its best view, and those of
    all views together.
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


@dataclass(frozen=True)  # without slots, as ``rules.Rival``
class Tried(Generic[M]):
    """A refitted candidate with its held-out losses and what it saves."""

    fit: Fit[M]
    losses: Array
    saved: Saving


Added = tuple[Fit[M], Array, selection.Step[M]]


class Search(ABC, Generic[M]):
    """Search over the data of one subject. Not thread-safe.

    Attributes:
        footing: thresholds of the kind of subject.
        names: effects that are tried; frozen: those that stay as they are.
        progress: told what is being done.
    """

    footing: ClassVar[Footing]
    names: tuple[str, ...]
    frozen: tuple[str, ...]
    progress: Callable[[str], None]

    # -- what a subject says

    @abstractmethod
    def fit(self, model: M, iterations: int = 8, best: float = np.inf) -> Fit[M]:
        """Refit all free numbers but those of frozen effects.

        Args:
            iterations: accepted steps at most.
            best: cost of what the model competes with: one that is far from it need not be fitted to the end.
        """

    @abstractmethod
    def loss(self, fit: Fit[M]) -> Array:
        """Return the held-out loss of each block, shape (blocks,)."""

    @abstractmethod
    def levelled(self, model: M) -> Fit[M]:
        """Fit a model on the footing that it asks for: weights of the views, a residual bent at bounces."""

    @abstractmethod
    def candidates(self, fit: Fit[M]) -> list[Start]:
        """Screen every effect that may be added; the best few."""

    @abstractmethod
    def switched_on(self, fit: Fit[M], start: Start) -> M:
        """Switch a candidate on, and off what it replaces."""

    @abstractmethod
    def trials(self, fit: Fit[M], losses: Array) -> dict[str, Tried[M]]:
        """Refit the candidates, by the names of their effects."""

    @abstractmethod
    def good(self, tried: dict[str, Tried[M]], fit: Fit[M], losses: Array) -> dict[str, Tried[M]]:
        """Pick those that save enough, surely, and that can be; more may be tried for it."""

    @abstractmethod
    def unspecific(self, name: str, tried: Mapping[str, Tried[M]], fit: Fit[M], losses: Array) -> bool:
        """Say whether the little that an effect saves may be a part of what another saves, or has no name."""

    @abstractmethod
    def order(self, name: str, tried: Tried[M], best: Fit[M]) -> tuple[Any, ...]:
        """Return by what the simplest of candidates is chosen that are about as good as the best; the least comes
        first.
        """

    @abstractmethod
    def simpler(self, fit: Fit[M], name: str) -> Iterable[tuple[str, str, Fit[M]]]:
        """Yield what a simpler confounder takes the place of, its name, and the fit with it there."""

    def ratio(self, fit: Fit[M]) -> float:
        """Return the root mean square over all rows, in units of the floor."""
        return fit.ratio

    def saving(self, new: Array, old: Array, among: Collection[str] = ()) -> Saving:
        """Compare held-out losses by view: of all views, or of some. Of one view that is all."""
        share, errors = better(new, old)
        return Saving(share, errors, "", share, errors)

    def lost(self, worse: Array, good: Array) -> Saving:
        """Return what a worse model gives away, in the view where it gives away most."""
        return self.saving(good, worse)

    def judged(self, losses: Array, old: Array, fit: Fit[M]) -> Saving:
        """Return what a candidate saves that was tried beside a fit."""
        return self.saving(losses, old)

    def bare(self, fit: Fit[M], name: str) -> Fit[M]:
        """Fit without an effect."""
        return self.fit(fit.model.without_effect(name), 6)

    def confirmed(self, new: Fit[M], fit: Fit[M]) -> Fit[M] | None:
        """Return the fit of what is to be added as it stays; None where it cannot be."""
        return new

    def vanished(self, fit: Fit[M], name: str) -> bool:
        """Say whether an effect has become too small to stay, whatever it saves."""
        return False

    def may_leave(self, without: Fit[M], fit: Fit[M]) -> bool:
        """Say whether what is left without an effect can be."""
        return True

    def surely(self, saved: Saving, least: float, name: str) -> bool:
        """Say whether an effect saves at least a share, surely."""
        return saved.share >= least and saved.errors >= SURE

    def hopeless(self, new: Fit[M], losses: Array, least: float) -> bool:
        """Say whether a fit cannot save a share on held-out blocks, for it does not on those that it was fitted to."""
        return False

    def loudest(self, fit: Fit[M]) -> float:
        """Return the largest root mean square of a view, in units of its floor."""
        return fit.ratio

    def beside(self, middle: Fit[M], first: Start) -> list[Start]:
        """Return what is tried beside the first of a pair."""
        return self.candidates(middle)[: self.footing.tries]

    def pair(self, first: str, second: str, new: Fit[M]) -> str | None:
        """Return the name of two effects at once; None where they are no pair."""
        return f"{first}{AND}{second}" if first in new.model.effects else None

    def sound(self, new: Fit[M], fit: Fit[M], name: str) -> bool:
        """Say whether a model with new effects, joined by ``AND``, can be."""
        return True

    def named(self, best: Tried[M], fit: Fit[M], losses: Array) -> bool:
        """Say whether nothing nameless saves far more than a pair."""
        return True

    def restart(self, fit: Fit[M]) -> Added[M] | None:
        """Let numbers begin again where descent may have stuck; None where that gains nothing."""
        return None

    def done(self, fit: Fit[M]) -> bool:
        """Say whether nothing is left to search for."""
        return False

    def settle_step(self, added: Added[M]) -> tuple[Fit[M], Array]:
        """Bring what a step found to the footing that it asks for."""
        fit = self.levelled(added[2].model)
        return fit, self.loss(fit)

    def settle_model(self, fit: Fit[M], losses: Array) -> tuple[Fit[M], Array]:
        """Bring what a step left to the footing that it asks for."""
        return fit, losses

    # -- the search

    def run(self, start: M) -> selection.Found[Fit[M], M]:
        """Search from a model."""
        fit = self.levelled(start)
        losses = self.loss(fit)
        steps = [selection.Step("start", "", self.ratio(fit), 0.0, fit.model)]
        for _ in range(self.footing.steps):
            if self.done(fit):
                break
            added = self._add(fit, losses) or self._add_pair(fit, losses) or self.restart(fit)
            if added is None:
                break
            steps.append(added[2])
            fit, losses = self.settle_step(added)
            self.progress(f"{steps[-1].action} {steps[-1].effect}: residual {self.ratio(fit):.2f} of the floor")
            fit, losses = self._simplify(fit, losses, steps)
            fit, losses = self.eliminate(fit, losses, steps)
            fit, losses = self.settle_model(fit, losses)
        return selection.Found(fit, losses, tuple(steps))

    def _add(self, fit: Fit[M], losses: Array) -> Added[M] | None:
        """Refit the best candidates and take the simplest of those that save most."""
        tried = self.trials(fit, losses)
        good = self.good(tried, fit, losses)
        new = None
        name = ""
        while good and new is None:
            name = self.simplest(good)
            new = self.confirmed(good.pop(name).fit, fit)
        if new is None:
            return None
        loss = self.loss(new)
        saved = self.judged(loss, losses, fit)
        if saved.share < SPECIFIC and self.unspecific(name, tried, fit, losses):
            return None
        rivals = {n: t.saved.share for n, t in tried.items() if n != name}
        return new, loss, selection.Step("add", name, self.ratio(new), saved.share, new.model, rivals)

    def _add_pair(self, fit: Fit[M], losses: Array) -> Added[M] | None:
        """Add two effects at once where neither saves enough alone: each hides what the other would save.

        Both must save much together, surely, and each much beside the other.
        """
        if self.loudest(fit) < self.footing.paired:
            return None
        pairs: dict[str, Tried[M]] = {}
        for first in self.candidates(fit)[:PAIRS]:
            middle = self.fit(self.switched_on(fit, first), 5, fit.cost)
            if middle.cost > fit.cost:  # it only takes the place of something better
                continue
            inner: Array | None = None
            for second in self.beside(middle, first):
                best = min((t.fit.cost for t in pairs.values()), default=middle.cost)
                new = self.fit(self.switched_on(middle, second), 8, best)
                name = self.pair(first.effect, second.effect, new)
                if name is None or self.hopeless(new, losses, SPECIFIC):
                    continue
                loss = self.loss(new)
                inner = self.loss(middle) if inner is None else inner
                saved = self.saving(loss, losses)
                much = self.surely(saved, SPECIFIC, "") and self.surely(
                    self.saving(loss, inner), SPECIFIC, second.effect
                )
                if much and self.sound(new, fit, name):
                    pairs[name] = Tried(new, loss, saved)
        if not pairs:
            return None
        both = self.simplest(pairs)
        found = pairs[both]
        if not self.named(found, fit, losses):
            return None
        return (
            found.fit,
            found.losses,
            selection.Step("add", both, self.ratio(found.fit), found.saved.share, found.fit.model),
        )

    def simplest(self, good: Mapping[str, Tried[M]]) -> str:
        """Of the candidates within one standard error and ``GAIN`` of the best, return the simplest."""
        best = max(good.values(), key=lambda t: t.saved.total)

        def near(t: Tried[M]) -> bool:
            gap = self.lost(t.losses, best.losses)
            return negligible(gap.share, gap.errors)

        about = [n for n, t in good.items() if t is best or near(t)]
        return about[0] if len(about) == 1 else min(about, key=lambda n: self.order(n, good[n], best.fit))

    def eliminate(self, fit: Fit[M], losses: Array, steps: list[selection.Step[M]]) -> tuple[Fit[M], Array]:
        """Let effects leave that no longer save their share; the last stays."""
        for name in [n for n in fit.model.effects if n not in self.frozen]:
            if len(set(fit.model.effects) - set(self.frozen)) < 2:
                break
            if name not in fit.model.effects:  # it left with what it stood beside
                continue
            without = self.bare(fit, name)
            loss = self.loss(without)
            gap = self.lost(loss, losses)
            spared = negligible(gap.share, gap.errors) and self.may_leave(without, fit)
            if spared or self.vanished(fit, name):
                fit, losses = without, loss
                steps.append(selection.Step("leave", name, self.ratio(fit), -gap.share, fit.model))
        return fit, losses

    def _simplify(self, fit: Fit[M], losses: Array, steps: list[selection.Step[M]]) -> tuple[Fit[M], Array]:
        """Put a simpler confounder in the place of a richer effect where it does as well."""
        for name in [n for n in fit.model.effects if n not in self.frozen]:
            for gone, other, new in self.simpler(fit, name):
                loss = self.loss(new)
                gap = self.lost(loss, losses)
                if negligible(gap.share, gap.errors) and self.may_stand(new, other):
                    fit, losses = new, loss
                    said = f"{gone} to {other}"
                    steps.append(selection.Step("simplify", said, self.ratio(fit), -gap.share, fit.model))
                    break
        return fit, losses

    def may_stand(self, new: Fit[M], name: str) -> bool:
        """Say whether a confounder can be in the place that it was given."""
        return True
