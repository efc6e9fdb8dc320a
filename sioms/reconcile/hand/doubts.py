"""What is named of a hand, and what else it could be: two effects that together are a third, and effects that too few
grasps tell from each other.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from sioms.reconcile.effect import TERM_PREFIX
from sioms.reconcile.hand.rows import HandData
from sioms.reconcile.sensors.effect import SensorModel
from sioms.reconcile.sensors.fit import ratios, refit
from sioms.reconcile.sensors.plausible import physical
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
"""Logarithm of the likelihood by which a look-alike must be worse: three standard deviations. A grasp counts once, for
its rows under several loads have their errors in common."""


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

    By its share a look-alike is ruled out where it misses a few per cent of what an effect explains. Of thousands of
    samples that is sure; of a dozen grasps, in which a turned finger 1 and a turned finger 2 leave nearly the same, it
    is a hundredth of their scatter.

    Args:
        v: the verdict; data: all rows.
        propose: what decides between models.
    """
    if v.outcome not in (Outcome.NAMED, Outcome.AMBIGUOUS):
        return v
    weights = 1.0 / np.maximum(ratios(data, v.model), 1e-9)[data.view]
    good = refit(data, v.model, weights, (), PATIENCE)
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
