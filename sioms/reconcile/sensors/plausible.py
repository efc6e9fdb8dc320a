"""Which effects of a sensor belong together, and which numbers can be."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from sioms.reconcile.effect import TERM_PREFIX
from sioms.reconcile.sensors.effect import SensorEffect, SensorModel
from sioms.reconcile.thresholds import MOST_INSIDE


def termed(model: SensorModel) -> bool:
    """Say whether something without a name is in a model."""
    return any(n.startswith(TERM_PREFIX) for n in model.effects)


def alike(lib: Mapping[str, SensorEffect], name: str, count: int) -> list[str]:
    """Confounders in either direction that are not much richer, and the twins whatever their size."""
    own = lib[name]
    both = [n for n in lib if n in own.confounders or name in lib[n].confounders]
    return [n for n in both if n not in own.replaces and (lib[n].size(count) <= own.size(count) + 1 or n in own.twins)]


def family(model: SensorModel, name: str) -> set[str]:
    """An effect, its confounders in either direction and what it replaces."""
    lib = model.library
    return {name, *lib[name].confounders, *lib[name].replaces, *(n for n in lib if name in lib[n].confounders)}


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
