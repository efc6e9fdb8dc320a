"""Search for the effects that are missing: screen, refit the best few nested, let earlier ones leave again.

A step adds the effect that saves most on held-out blocks, but the simplest one within a standard error of
it. After each step every effect must still earn its place, and a simpler look-alike that does as well takes
the place of a richer one. The search stops when nothing saves ``GAIN`` of what remains.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from sioms.reconcile.blocks import better, block_ids, heldout
from sioms.reconcile.effect import Array, Slot
from sioms.reconcile.effects import known, library
from sioms.reconcile.fit import Fit, Problem, refit
from sioms.reconcile.model import AxisModel
from sioms.reconcile.screen import Start, screen

GAIN = 0.05  # least share of what remains that an effect must save on held-out blocks
SURE = 2.0  # least number of standard errors of that saving
FLOOR = 1.15  # stop at this multiple of the expected innovation
TRIES = 4  # candidates refitted per step
STEPS = 6
#: A saving below ``SPECIFIC`` counts only where no unrelated effect saves ``NEARLY`` as much.
SPECIFIC = 0.3
NEARLY = 0.5
#: A larger loss than this is one, however unevenly it falls on the blocks.
DOUBTFUL = 0.2
#: A step that saves this much needs no second look at the friction law.
CLEAR = 0.5
#: Two effects are tried at once only above this multiple of the expected innovation, so many firsts and seconds.
PAIRED = 1.5
PAIRS = 3
PERIODIC_SURE = 3.0  # for effects whose order is searched over tens of values
#: Fits are kept in memory up to this size: a second search, with terms beside the library, retraces the first.
KEPT_BYTES = 128_000_000


@dataclass(frozen=True, slots=True)
class Step:
    """One step of the ladder: what was done, what it saved, what remained, in units of the expected innovation."""

    action: str
    effect: str
    ratio: float
    saved: float
    model: AxisModel
    rivals: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Found:
    """Result of a search."""

    fit: Fit
    losses: Array
    ladder: tuple[Step, ...]


@dataclass(slots=True)
class Searcher:
    """Search over one problem. Not thread-safe.

    Attributes:
        frozen: effects measured by a channel of their own; they stay, with their values.
        excluded: effects that must not be tried (ruled out by a channel, or not applicable).
        progress: told what is being done.
    """

    problem: Problem
    frozen: tuple[str, ...] = ()
    names: tuple[str, ...] = ()
    progress: Callable[[str], None] = lambda text: None
    ids: NDArray[np.int64] = field(init=False)
    _fits: dict[Hashable, Fit] = field(init=False, default_factory=dict)
    _starts: dict[Hashable, list[Start]] = field(init=False, default_factory=dict)

    def __post_init__(self) -> None:
        """Number the blocks."""
        self.ids = np.empty(0, dtype=np.int64)

    def fit(self, model: AxisModel, iterations: int = 8) -> Fit:
        """Refit with the channel effects frozen; what was fitted before is looked up."""
        key = (values_of(model), iterations)
        if key not in self._fits:
            self._fits[key] = fit = self._fit(model, iterations)
            most = KEPT_BYTES // (8 * len(fit.residual) * (len(fit.free) + 1))
            while len(self._fits) > max(most, 1):
                del self._fits[next(iter(self._fits))]
        return self._fits[key]

    def screen(
        self, fit: Fit, names: Sequence[str], levels: Mapping[str, float] | None = None
    ) -> list[Start]:
        """Screen as ``sioms.reconcile.screen.screen`` does; what was screened before is looked up."""
        key = (values_of(fit.model), tuple(sorted((levels or {}).items())))
        fresh = [n for n in names if (key, n) not in self._starts]
        found = screen(self.problem, fit, fresh, levels) if fresh else []
        self._starts.update({(key, n): [s for s in found if s.effect == n] for n in fresh})
        return sorted((s for n in names for s in self._starts[key, n]), key=lambda s: -s.gain)

    def _fit(self, model: AxisModel, iterations: int) -> Fit:
        effect = next((known()[n] for n in model.effects if known()[n].slot is Slot.BACKLASH), None)
        if effect is not None and iterations > 4:
            return polish(self.problem, model, self.frozen)
        return refit(self.problem, model, self.frozen, iterations)

    def loss(self, fit: Fit) -> Array:
        """Held-out loss per block."""
        if len(self.ids) != len(fit.residual):
            self.ids = block_ids(self.problem, fit.model.sample_time_s)
        losses = heldout(fit, self.ids)
        return (
            losses
            if self.problem.weights is None
            else losses[np.bincount(self.ids, weights=self.problem.weights) > 0.0]
        )

    def run(self, start: AxisModel) -> Found:
        """Search from a model."""
        fit = self.fit(start)
        losses = self.loss(fit)
        ladder = [Step("start", "", fit.ratio, 0.0, fit.model)]
        for _ in range(STEPS):
            if fit.ratio <= FLOOR:
                break
            step = self._add(fit, losses) or self._add_pair(fit, losses)
            if step is None:
                break
            ladder.append(step[2])
            fit, losses = step[0], step[1]
            self.progress(
                f"{ladder[-1].action} {ladder[-1].effect}: residual {fit.ratio:.2f} of the expected"
            )
            fit, losses = self._simplify(fit, losses, ladder)
            fit, losses = self._eliminate(fit, losses, ladder)
        return Found(fit, losses, tuple(ladder))

    def _candidates(self, fit: Fit) -> list[Start]:
        names = [
            n
            for n in self.names
            if n not in fit.model.effects
            and n not in self.frozen
            and not any(f in known()[n].replaces for f in self.frozen)
        ]
        fresh = [n for n in names if not replaced(fit.model, n) and not self._enrichment(n)]
        starts = [s for s in self.screen(fit, fresh) if s.gain > 0.5 * GAIN]
        starts += self._upgrades(fit, [n for n in names if replaced(fit.model, n)])
        starts.sort(key=lambda s: -s.gain)
        chosen = starts[:TRIES]
        if chosen:
            alike = known()[chosen[0].effect].lookalikes
            chosen += [s for s in starts[TRIES:] if s.effect in alike and s.gain > 0.3 * chosen[0].gain]
        return chosen

    def _enrichment(self, name: str) -> bool:
        """Say whether an effect with a searched order only enriches a plainer one, which goes first."""
        effect = known()[name]
        return any(p.fixed for p in effect.parameters) and any(
            o in effect.replaces for o in plainer(name, self.names)
        )

    def _upgrades(self, fit: Fit, names: list[str]) -> list[Start]:
        """Screen richer forms of an effect in the model, on top of the level it has."""
        out = []
        for name in names:
            old = next(n for n in known()[name].replaces if n in fit.model.effects)
            level = next(iter(fit.model.effects[old].values()))
            levels = {p.symbol: level for p in known()[name].parameters if p.symbol in ("Fc", "Fs", "f")}
            out += self.screen(fit, [name], levels)
        return out

    def _add(self, fit: Fit, losses: Array) -> tuple[Fit, Array, Step] | None:
        """Refit the best candidates and take the simplest of those that save most.

        A rich friction law may have bent itself to stand in for the next effect; so the best candidates are tried
        with it started afresh too.
        """
        tried: dict[str, tuple[Fit, Array, float, float]] = {}
        for i, s in enumerate(self._candidates(fit)):
            self._try(tried, s.effect, self._with(fit, s, 8 if i == 0 else 5), losses)
        if max((t[2] for t in tried.values()), default=0.0) < CLEAR:
            for effect, new in self._afresh(fit):
                self._try(tried, effect, new, losses)
        good = {
            n: t for n, t in tried.items() if t[2] >= GAIN and t[3] >= self._sure(n) and physical(t[0], n)
        }
        if not good:
            return None
        name = simplest(good)
        new, loss, gain, _ = good[name]
        if gain < SPECIFIC and unspecific(name, {n: t[2] for n, t in tried.items()}):
            return None
        rivals = {n: t[2] for n, t in tried.items() if n != name}
        return new, loss, Step("add", name, new.ratio, gain, new.model, rivals)

    def _add_pair(self, fit: Fit, losses: Array) -> tuple[Fit, Array, Step] | None:
        """Add two effects at once where neither saves enough alone: each hides what the other would save.

        Both must be sure together, and each must earn its place beside the other.
        """
        best: tuple[Fit, Array, Step] | None = None
        if fit.ratio < PAIRED:
            return None
        for first in self._candidates(fit)[:PAIRS]:
            middle = self._with(fit, first, 5)
            inner = self.loss(middle)
            for second in [
                s for s in self._candidates(middle) if s.effect not in known()[first.effect].replaces
            ][:PAIRS]:
                new = self._with(middle, second, 8)
                if first.effect not in new.model.effects:
                    continue
                loss = self.loss(new)
                gain, sure = better(loss, losses)
                more, surer = better(loss, inner)
                good = (
                    gain >= SPECIFIC
                    and sure >= SURE
                    and more >= SPECIFIC
                    and surer >= self._sure(second.effect)
                )
                if (
                    good
                    and physical(new, first.effect)
                    and physical(new, second.effect)
                    and (best is None or new.cost < best[0].cost)
                ):
                    best = (
                        new,
                        loss,
                        Step("add", f"{first.effect} and {second.effect}", new.ratio, gain, new.model),
                    )
        return best

    def _with(self, fit: Fit, start: Start, iterations: int) -> Fit:
        """Switch a candidate on, what it replaces off, and refit."""
        model = without(fit.model, known()[start.effect].replaces)
        return self.fit(model.with_effect(start.effect, start.values), iterations)

    def _try(
        self, tried: dict[str, tuple[Fit, Array, float, float]], effect: str, new: Fit, losses: Array
    ) -> None:
        """Score a refitted candidate; keep the better of two ways to the same effect."""
        loss = self.loss(new)
        gain, sure = better(loss, losses)
        if effect not in tried or gain > tried[effect][2]:
            tried[effect] = (new, loss, gain, sure)

    def _afresh(self, fit: Fit) -> list[tuple[str, Fit]]:
        """Add the best candidates to the plain form of each rich friction law, then enrich it afresh."""
        out = []
        for name in [n for n in fit.model.effects if n not in self.frozen]:
            for other in [o for o in plainer(name, self.names) if o in known()[name].replaces]:
                base = self.fit(swapped(fit.model, name, other), 5)
                starts = [
                    s for s in self._candidates(base) if name not in (s.effect, *known()[s.effect].replaces)
                ]
                for s in starts[:2]:
                    middle = self._with(base, s, 5)
                    out += [
                        (s.effect, self._with(middle, again, 6))
                        for again in self._upgrades(middle, [name])[:1]
                    ]
        return out

    def _sure(self, name: str) -> float:
        return PERIODIC_SURE if any(p.fixed for p in known()[name].parameters) else SURE

    def _eliminate(self, fit: Fit, losses: Array, ladder: list[Step]) -> tuple[Fit, Array]:
        """Let effects leave that no longer save their share."""
        for name in [n for n in fit.model.effects if n not in self.frozen]:
            if len([n for n in fit.model.effects if n not in self.frozen]) < 2:
                break
            without = self.fit(fit.model.without_effect(name), 6)
            loss = self.loss(without)
            gain, sure = better(losses, loss)
            if negligible(gain, sure):
                fit, losses = without, loss
                ladder.append(Step("leave", name, fit.ratio, -gain, fit.model))
        return fit, losses

    def _simplify(self, fit: Fit, losses: Array, ladder: list[Step]) -> tuple[Fit, Array]:
        """Put a simpler look-alike in the place of a richer effect where it does as well."""
        for name in [n for n in fit.model.effects if n not in self.frozen]:
            for other in plainer(name, self.names):
                if other in fit.model.effects:
                    continue
                new = self.fit(swapped(fit.model, name, other), 6)
                loss = self.loss(new)
                lost, sure = better(losses, loss)
                if negligible(lost, sure):
                    fit, losses = new, loss
                    ladder.append(Step("simplify", f"{name} to {other}", fit.ratio, -lost, fit.model))
                    break
        return fit, losses


def values_of(model: AxisModel) -> Hashable:
    """Return all that a search may change of a model, to look it up by."""
    return (
        tuple(getattr(model, symbol) for symbol in model.refine),
        tuple((n, *v.items()) for n, v in model.effects.items()),
    )


def plainer(name: str, names: Sequence[str]) -> list[str]:
    """List the look-alikes with fewer parameters."""
    return [o for o in known()[name].lookalikes if o in names and size(o) < size(name)]


def swapped(model: AxisModel, name: str, other: str) -> AxisModel:
    """Put another effect in the place of one, keeping the values of parameters that both have."""
    plain = {p.symbol: p.start * model.scale(p) for p in known()[other].parameters}
    shared = {k: v for k, v in model.effects[name].items() if k in plain}
    return model.without_effect(name).with_effect(other, {**plain, **shared})


def without(model: AxisModel, names: Sequence[str]) -> AxisModel:
    """Switch some effects off."""
    for name in names:
        model = model.without_effect(name) if name in model.effects else model
    return model


def replaced(model: AxisModel, name: str) -> bool:
    """Say whether an effect would take the place of one in the model."""
    return any(n in model.effects for n in known()[name].replaces)


def size(name: str) -> int:
    """Number of parameters of an effect."""
    return len(known()[name].parameters)


def unspecific(name: str, gains: dict[str, float]) -> bool:
    """Say whether an effect of quite another kind saves nearly as much: then the residual has no name yet."""
    lib = known()
    family = {
        name,
        *lib[name].lookalikes,
        *lib[name].replaces,
        *(n for n in lib if name in lib[n].lookalikes),
    }
    return any(g > NEARLY * gains[name] for n, g in gains.items() if n not in family)


def negligible(lost: float, errors: float) -> bool:
    """Say whether a loss counts for nothing: small, or not large and within one standard error."""
    return lost < GAIN or (errors < 1.0 and lost < DOUBTFUL)


def simplest(good: dict[str, tuple[Fit, Array, float, float]]) -> str:
    """Of the candidates within one standard error and ``GAIN`` of the best, the one with the fewest parameters.

    A named effect goes before a nameless term that does no better.
    """
    best = max(good, key=lambda n: good[n][2])
    near = []
    for n, (_, loss, _, _) in good.items():
        lost, sure = better(good[best][1], loss)
        if negligible(lost, sure):
            near.append(n)
    return min(near, key=lambda n: (n not in library(), size(n), -good[n][2]))


def physical(fit: Fit, name: str) -> bool:
    """Say whether an effect stays within its bounds: a number that leans on one belongs to something else.

    The stiffness and damping of a contact may: harder than what is seen is as good as hard. So may a time constant.
    """
    effect, given = known()[name], fit.model.effects[name]
    free = [q for q in effect.parameters if not q.phase and not q.fixed]
    for q in [effect.primary] if effect.slot in (Slot.BACKLASH, Slot.THERMAL) else free:
        low, high = (bound * fit.model.scale(q) for bound in (q.lower, q.upper))
        if given[q.symbol] > 0.98 * high or (q.lower < 0.0 and given[q.symbol] < 0.98 * low):
            return False
    p, scale = effect.primary, fit.model.scale(effect.primary)
    if p.lower < 0.0 or effect.slot in (Slot.SCALE, Slot.LIMIT, Slot.ELASTIC):
        return True
    return given[p.symbol] > max(p.lower, 1e-4 * p.start) * scale * 1.01


def polish(problem: Problem, model: AxisModel, frozen: Sequence[str]) -> Fit:
    """Fit a backlash: its cost is rough, so search the gap by golden steps before the smooth fit of the rest."""
    name = next(n for n in model.effects if known()[n].slot is Slot.BACKLASH)
    best, cost = model, np.inf
    for spread in (0.25, 0.08, 0.025, 0.008):
        for symbol, width in (
            ("gap", spread),
            ("load_fraction", spread),
            ("zeta", 2.0 * spread),
            ("f_contact", spread),
        ):
            here = best.effects[name]
            trials = [best] if cost == np.inf else []
            trials += [
                best.with_effect(name, {**here, symbol: here[symbol] * (1.0 + width * sign)})
                for sign in (1.0, -1.0, 0.4, -0.4)
            ]
            trials = [t for t in trials if _inside(t, name)]
            costs = list(problem.mapper(lambda t: float(np.sum(problem.residual(t) ** 2)), trials))
            if costs and min(costs) < cost:
                best, cost = trials[int(np.argmin(costs))], min(costs)
    return refit(problem, best, frozen, 4)


def _inside(model: AxisModel, name: str) -> bool:
    return all(
        p.lower * model.scale(p) <= model.effects[name][p.symbol] <= p.upper * model.scale(p)
        for p in known()[name].parameters
    )
