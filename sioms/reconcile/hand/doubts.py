"""What is named of a hand, and what else it could be: two effects that together are a third, effects that too few
grasps tell from each other, and effects beside the named ones that a search by stated noise cannot see.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np

from sioms.reconcile.effect import TERM_PREFIX
from sioms.reconcile.hand.grasps import Floats
from sioms.reconcile.hand.rows import HandData
from sioms.reconcile.sensors.effect import SensorModel
from sioms.reconcile.sensors.fit import Fit, half_intervals, ratios, refit
from sioms.reconcile.sensors.plausible import physical
from sioms.reconcile.sensors.screen import screening_columns
from sioms.reconcile.sensors.verdict import Proposal, SensorVerdict
from sioms.reconcile.thresholds import AMBIGUOUS, SENSOR
from sioms.reconcile.verdict import Outcome

#: Sets of effects that look like each other while nothing tells the loads by themselves.
SCALES = tuple(
    (frozenset({f"load_gain_{i}"}), frozenset({f"joint_stiffness_{i}", f"drive_stiffness_{i}"})) for i in (1, 2)
)

SCALED = frozenset().union(*(names for pair in SCALES for names in pair))
PATIENCE = 30  # steps of a fit
CERTAIN = 4.5
"""Logarithm of the likelihood by which a confounder must be worse: three standard deviations. A grasp counts once, for
its rows under several loads have their errors in common."""
POSSIBLE = 0.5  # times its natural size that an effect may have before it is said that it is not excluded
UNTOLD = 1e-6  # times its noise by which a row must change to tell of an effect
UNDOES = 0.7  # cosine of what two effects change, from which on they are tried together
SLIGHT = 1.0  # times the stated noise of one row by which an effect must change at least one


def doubted(
    v: SensorVerdict, data: HandData, propose: Callable[[Sequence[SensorModel]], tuple[Proposal, ...]]
) -> SensorVerdict:
    """List other sets of effects that explain the records as well as the named one, and call the verdict ambiguous.

    Without forces of the wrists a finger's load scales everything that bends: a load that is told a quarter too large
    and two springs that are a fifth too soft leave the same records.

    Args:
        v: the verdict; data: all rows.
        propose: what decides between models.
    """
    if v.outcome not in (Outcome.NAMED, Outcome.UNEXPLAINED) or not v.effects or data.grasps.weighed.any():
        return v
    sets = alternatives(frozenset(e.name for e in v.effects))
    others = [m for m in (_fitted(v.model, names, data) for names in sets) if m is not None]
    if not others:
        return v
    said = Outcome.AMBIGUOUS if v.outcome is Outcome.NAMED else v.outcome
    return replace(
        v, outcome=said, alternatives=(*v.alternatives, *(tuple(m.effects) for m in others)),
        experiments=propose([v.model, *others]),
    )  # fmt: skip


def unsure(
    v: SensorVerdict, data: HandData, propose: Callable[[Sequence[SensorModel]], tuple[Proposal, ...]]
) -> SensorVerdict:
    """List effects that could be in the place of a named one, and call the verdict ambiguous.

    By its share a confounder is ruled out where it misses a few per cent of what an effect explains. Of thousands of
    samples that is sure; of a dozen grasps, in which a turned finger 1 and a turned finger 2 leave nearly the same, it
    is a hundredth of their scatter.

    Args:
        v: the verdict; data: all rows.
        propose: what decides between models.
    """
    if v.outcome not in (Outcome.NAMED, Outcome.AMBIGUOUS):
        return v
    good, weights = _by_scatter(data, v.model)
    known = {frozenset(names) for names in (*v.alternatives, tuple(v.model.effects))}
    open_ = []
    for effect in v.effects:
        rest = good.model.without_effect(effect.name)
        for name in [n for n, one in rest.library.items() if one.rankable and not n.startswith(TERM_PREFIX)]:
            if name == effect.name or name in rest.effects or frozenset({*rest.effects, name}) in known:
                continue
            rival = refit(data, rest.with_effect(name, rest.plain(name)), weights, (), PATIENCE)
            if physical(rival.model, name) and _worse(data, good.model, rival.model) < CERTAIN:
                open_.append(rival.model)
    if not open_:
        return v
    return replace(
        v, outcome=Outcome.AMBIGUOUS, alternatives=(*v.alternatives, *(tuple(m.effects) for m in open_)),
        experiments=propose([v.model, *open_]),
    )  # fmt: skip


def overlooked(
    v: SensorVerdict,
    data: HandData,
    scatter: Sequence[float],
    propose: Callable[[Sequence[SensorModel]], tuple[Proposal, ...]],
) -> SensorVerdict:
    """List effects that beside the named ones explain more than chance does, and say how large others may be.

    The search counts by the stated noise where rows are too few to tell their scatter. Where they scatter a third of
    it, as a dozen grasps of a quiet hand do, an effect well above what they scatter is below its floor. Here it counts
    by the likelihood with each view's own scatter, as confounders do, and by an interval that does not hold zero.

    Args:
        v: the verdict; data: all rows; scatter: by how many times its stated noise each view is taken to scatter.
        propose: what decides between models.
    """
    if v.outcome is Outcome.UNEXPLAINED:
        return v
    good, weights = _by_scatter(data, v.model)
    shown, wide = dict[str, SensorModel](), list[str]()
    for name, effect in v.model.library.items():
        if not effect.rankable or name.startswith(TERM_PREFIX) or name in v.model.effects:
            continue
        if not np.any(np.abs(screening_columns(data, good.model, effect)) > UNTOLD):
            continue
        more = refit(data, good.model.with_effect(name, good.model.plain(name)), weights, (), PATIENCE)
        q = effect.primary
        at = next(i for i, f in enumerate(more.free) if (f.effect, f.symbol) == (name, q.symbol))
        half, value = float(half_intervals(data, more, weights)[at]), float(more.model.effects[name][q.symbol][0])
        unit = "" if q.unit == "1" else f" {q.unit}"
        told = f"{effect.title}, {q.symbol} {value - half:.3g} to {value + half:.3g}{unit}"
        sure = abs(value - effect.neutral) > half and _worse(data, more.model, good.model) > CERTAIN
        if sure and physical(more.model, name) and not slight(data, scatter, more.model, name):
            shown[told] = more.model
        elif abs(value - effect.neutral) + half > POSSIBLE * q.size:
            wide.append(told)
    best = max(shown.values(), key=lambda m: _worse(data, m, good.model), default=good.model)
    shown = {told: m for told, m in shown.items() if _worse(data, best, m) < CERTAIN}
    return _doubting(v, shown, "not excluded by these rows", wide, propose)


def _doubting(
    v: SensorVerdict,
    shown: dict[str, SensorModel],
    what: str,
    wide: Sequence[str],
    propose: Callable[[Sequence[SensorModel]], tuple[Proposal, ...]],
) -> SensorVerdict:
    """Return a verdict with what is not excluded as a note, ambiguous where rows show something beside it.

    Args:
        v: the verdict; shown: models that rows show, by what is told of each.
        what: in words, what ``wide`` lists.
        propose: what decides between models.
    """
    notes = v.notes + (f"{what}: {'; '.join(wide)}",) * bool(wide)
    if not shown:
        return replace(v, notes=notes)
    return replace(
        v, outcome=Outcome.AMBIGUOUS, alternatives=(*v.alternatives, *(tuple(m.effects) for m in shown.values())),
        experiments=v.experiments or propose([v.model, *shown.values()]),
        notes=(*notes, f"these rows show, too few to name it: {' or '.join(shown)}"),
    )  # fmt: skip


def cancelling(
    v: SensorVerdict,
    data: HandData,
    scatter: Sequence[float],
    propose: Callable[[Sequence[SensorModel]], tuple[Proposal, ...]],
) -> SensorVerdict:
    """List pairs of effects that undo each other in these rows: each alone is excluded, both together are not.

    One finger turned by a degree and the other by a degree the other way leave next to nothing in a dozen grasps of
    disks, in whose rows either of them alone would show.

    Args:
        v: the verdict; data: all rows; scatter: by how many times its stated noise each view is taken to scatter.
        propose: what decides between models.
    """
    if v.outcome is Outcome.UNEXPLAINED:
        return v
    good, weights = _by_scatter(data, v.model)
    columns = dict[str, Floats]()
    for name, effect in v.model.library.items():
        if effect.rankable and not name.startswith(TERM_PREFIX) and name not in v.model.effects:
            column = weights * screening_columns(data, good.model, effect)[:, 0]
            if np.any(np.abs(column) > UNTOLD):
                columns[name] = column / np.linalg.norm(column)
    shown, wide = dict[str, SensorModel](), list[str]()
    for one, other in combinations(columns, 2):
        if abs(columns[one] @ columns[other]) < UNDOES:
            continue
        start = good.model.with_effect(one, good.model.plain(one))
        both = refit(data, start.with_effect(other, start.plain(other)), weights, (), PATIENCE)
        halves, told, sure, large = half_intervals(data, both, weights), [], True, True
        for name in (one, other):
            effect = v.model.library[name]
            q = effect.primary
            at = next(i for i, f in enumerate(both.free) if (f.effect, f.symbol) == (name, q.symbol))
            half, value = float(halves[at]), float(both.model.effects[name][q.symbol][0])
            told.append(f"{effect.title}, {q.symbol} {value - half:.3g} to {value + half:.3g}")
            sure &= abs(value - effect.neutral) > half and physical(both.model, name)
            sure &= not slight(data, scatter, both.model, name)
            large &= abs(value - effect.neutral) + half > POSSIBLE * q.size
        if sure and _worse(data, both.model, good.model) > CERTAIN:
            shown[" with ".join(told)] = both.model
        elif large and not all(any(f"{v.model.library[n].title}," in note for note in v.notes) for n in (one, other)):
            wide.append(" with ".join(told))
    return _doubting(v, shown, "not excluded by these rows, both at once", wide, propose)


def slight(data: HandData, scatter: Sequence[float], model: SensorModel, name: str) -> bool:
    """Say whether an effect of a model changes no row by as much as one reading of it is stated to scatter."""
    change = np.abs(data.miss(data.predict(model)) - data.miss(data.predict(model.without_effect(name))))
    return bool(np.max(change * np.array(scatter)[data.view]) < SLIGHT)


def _by_scatter(data: HandData, model: SensorModel) -> tuple[Fit, Floats]:
    """Fit a model with each view weighed by its own scatter; return the weights, too."""
    weights = 1.0 / np.maximum(ratios(data, model), 1e-9)[data.view]
    return refit(data, model, weights, (), PATIENCE), weights


def _worse(data: HandData, good: SensorModel, rival: SensorModel) -> float:
    """Return by how much a rival's logarithm of the likelihood is less, each view with its own scatter."""
    grasps = np.array([len(np.unique(data.grasps.grasp[data.row[data.view == i]])) for i in range(len(data.views))])
    least = np.maximum(ratios(data, good), 1e-9)
    return float(np.sum(grasps * np.log(np.maximum(ratios(data, rival), 1e-9) / least)))


def alternatives(named: frozenset[str]) -> list[frozenset[str]]:
    """Return the sets of effects that look like the named ones while nothing tells the loads."""
    out = {named}
    for one, two in SCALES:
        for names in list(out):
            for here, there in ((one, two), (two, one)):
                if here & names and not there <= names:
                    out.add((names - here) | there)
    return sorted(out - {named}, key=sorted)


def _fitted(model: SensorModel, names: frozenset[str], data: HandData) -> SensorModel | None:
    """Fit other effects; None where they miss more than next to nothing of what the named ones explain, or one view."""
    bare = replace(model, effects={})
    gone = {n: v for n, v in model.effects.items() if n not in names}
    other = bare
    for name in sorted(names):  # a scale of the load and a softer spring have the same number: begin with it
        like = [v for n, v in gone.items() if n[-1] == name[-1] and name in SCALED]
        first = model.library[name].primary.symbol
        start = {first: next(iter(like[0].values()))} if like else bare.plain(name)
        other = other.with_effect(name, model.effects.get(name, start))
    ones = np.ones(len(data.view))
    good, fit = (refit(data, m, ones, (), PATIENCE) for m in (model, other))
    contribution = refit(data, bare, ones).cost - good.cost
    near = np.all(ratios(data, fit.model) <= SENSOR.floor * ratios(data, good.model))
    return fit.model if near and fit.cost - good.cost < AMBIGUOUS * contribution else None
