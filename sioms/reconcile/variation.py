"""Dry friction that varies over the turn: one effect with Coulomb friction alone, a factor beside any other law of dry
friction.

Where one law takes the place of another, what varied goes on varying, and is named as it is named there (decision
0083).
"""

from __future__ import annotations

from collections.abc import Mapping

from sioms.reconcile.effects import known
from sioms.reconcile.model import AxisModel

PLAIN, WHOLE, FACTOR = "coulomb", "coulomb_position", "friction_variation"


def accompanied(model: AxisModel, name: str) -> bool:
    """Say whether a model has what an effect must stand beside, if it must."""
    beside = known()[name].beside
    return not beside or any(n in model.effects for n in beside)


def room_for(model: AxisModel, name: str) -> AxisModel:
    """Switch off what an effect replaces, but for the variation of it that the effect would have, too."""
    if WHOLE in model.effects and name in known()[FACTOR].beside:
        model = _parted(model)
    for other in known()[name].replaces:
        model = model.without_effect(other) if other in model.effects else model
    return model


def exchanged(model: AxisModel, name: str, values: Mapping[str, float]) -> AxisModel:
    """Switch an effect on in the place of what it replaces."""
    return named(room_for(model, name).with_effect(name, values))


def named(model: AxisModel) -> AxisModel:
    """Give a variation the name that it has beside the dry friction of the model; beside none there is no variation."""
    if FACTOR not in model.effects or accompanied(model, FACTOR):
        return model
    factor, bare = model.effects[FACTOR], model.without_effect(FACTOR)
    if PLAIN not in model.effects:
        return bare
    level = model.effects[PLAIN]["Fc"]
    whole = {"Fc": level, "Fm": factor["depth"] * level, "phase": factor["phase"], "n": factor["n"]}
    return bare.without_effect(PLAIN).with_effect(WHOLE, whole)


def _parted(model: AxisModel) -> AxisModel:
    """Part Coulomb friction that varies into its level and the factor on it."""
    whole = model.effects[WHOLE]
    most = known()[FACTOR].primary.upper
    depth = min(whole["Fm"] / max(whole["Fc"], 1e-300), most)
    bare = model.without_effect(WHOLE).with_effect(PLAIN, {"Fc": whole["Fc"]})
    return bare.with_effect(FACTOR, {"depth": depth, "phase": whole["phase"], "n": whole["n"]})
