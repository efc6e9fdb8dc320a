"""The form of what is named: a name says how a force goes with its variable, and a law of any form must do no better.

Load-dependent friction may stand for friction with the square of the load, with another effect beside it that takes off
what is too much where the load is small. What is left is near the noise, and no smoother finds it. The broken line over
the variable itself does, for it takes the place of the name and asks nothing of the rest.
"""

from __future__ import annotations

import numpy as np

from sioms.reconcile.bounces import has_impacts
from sioms.reconcile.effect import Effect, Over
from sioms.reconcile.effects import known
from sioms.reconcile.effects.smooth import CONSTANT, LAWS, PLACES
from sioms.reconcile.engine.search import Start
from sioms.reconcile.fit import Fit
from sioms.reconcile.model import AxisModel
from sioms.reconcile.plausible import over
from sioms.reconcile.search import Searcher, Step
from sioms.reconcile.selection import Found
from sioms.reconcile.thresholds import GAIN, SURE


def of_any_form(searcher: Searcher, found: Found[Fit, AxisModel]) -> Found[Fit, AxisModel]:
    """Put a smooth law in the place of what is named of its variable where it does better, surely.

    Returns:
        What was found where every name has the form that its variable asks for, or nothing but noise is left.
    """
    model = found.fit.model
    if searcher.done(found.fit) or has_impacts(model):
        return found
    best, saved = None, 0.0
    for law in (law for law in LAWS if law.name not in model.effects and _parts(law, model, searcher.frozen)):
        for start in searcher.screen(found.fit, [law.name]):
            if start.gain < GAIN:
                continue
            fit = searcher.fit(searcher.switched_on(found.fit, _from_names(law, model, start)))
            loss = searcher.loss(fit)
            saving = searcher.saving(loss, found.losses)
            if saving.share > max(saved, GAIN) and saving.errors > SURE and searcher.follows(fit.model, model):
                best, saved = (fit, loss, law.name), saving.share
    if best is None:
        return found
    fit, loss, name = best
    steps = [*found.path, Step("form", name, fit.ratio, saved, fit.model)]
    fit, loss = searcher.eliminate(fit, loss, steps)
    return Found(fit, loss, tuple(steps))


def _from_names(law: Effect, model: AxisModel, start: Start) -> Start:
    """Start a law from the course of what it takes the place of, and what is missing of that."""
    middle, step = start.values["middle"], start.values["step"]
    values = dict(start.values)
    for name in (n for n in law.replaces if n in model.effects and known()[n].slot is law.slot):
        effect = known()[name]
        row = effect.row(effect.values(model.effects[name]), model.pitch)
        course = over(effect, law.over or Over.PLACE, middle + step * np.array([0, *PLACES], dtype=np.float64), row)
        for p, value in zip(law.parameters, course[1:] - course[0], strict=False):
            values[p.symbol] += float(value)
    return Start(start.effect, start.gain, values)


def _parts(law: Effect, model: AxisModel, frozen: tuple[str, ...]) -> bool:
    """Say whether the model names something that a law would be, or be the rest of."""
    mine = {*law.replaces, CONSTANT.get(law.name, "")}
    return model.applicable(law) and any(n in mine for n in model.effects if n not in frozen)
