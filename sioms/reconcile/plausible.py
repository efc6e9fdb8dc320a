"""What an effect in a model may be: its numbers possible, its saving its own, its form the simplest that does."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sioms.reconcile.effect import Array, Effect, Over, Ref
from sioms.reconcile.effects import known
from sioms.reconcile.effects.smooth import CENTRE, SIDE, STEP
from sioms.reconcile.fit import Fit
from sioms.reconcile.model import AxisModel
from sioms.reconcile.thresholds import FORMULA, NEARLY
from sioms.reconcile.variation import named


def plainer(name: str, names: Sequence[str]) -> list[str]:
    """List the confounders with fewer parameters."""
    return [o for o in known()[name].confounders if o in names and size(o) < size(name)]


def formulas_of(model: AxisModel, law: str, names: Sequence[str]) -> list[tuple[AxisModel, str]]:
    """Return the model with each formula of one number in the place of a smooth law that has its course, the nearest
    first, and the formula's name.
    """
    effect = known()[law]
    if effect.over is None:
        return []
    row = effect.row(effect.values(model.effects[law]), model.pitch)
    at = row[CENTRE] + row[STEP] * np.linspace(-SIDE, SIDE, 8 * SIDE + 1)
    curve = over(effect, effect.over, at, row)
    found: list[tuple[float, AxisModel, str]] = []
    for other in (o for o in effect.replaces if o in names and size(o) == 1 and vacant(model, law, o)):
        one = known()[other]
        if one.slot is not effect.slot:
            continue
        # the constant of a law is the offset's
        columns = np.column_stack([over(one, effect.over, at, one.row(np.ones(1), model.pitch)), np.ones_like(at)])
        number, constant = np.linalg.lstsq(columns, curve, rcond=1e-12)[0]
        left = float(np.sum((curve - columns @ (number, constant)) ** 2) / max(np.sum(curve**2), 1e-300))
        p = one.primary
        inside = p.lower * model.scale(p) <= number <= p.upper * model.scale(p)
        if left < FORMULA and inside:
            found.append((left, named(model.without_effect(law).with_effect(other, {p.symbol: float(number)})), other))
    return [(swap, other) for _, swap, other in sorted(found, key=lambda f: f[0])]


def over(effect: Effect, variable: Over, at: Array, row: Array) -> Array:
    """Return what the state function of an effect gives over one variable, at unit speed where that is the place."""
    x, v, u = (at if name == variable.value else np.zeros_like(at) for name in "xvu")
    return effect.evaluate(x, v + 1.0 if variable is Over.PLACE else v, u, np.zeros_like(at), row)


def swapped(model: AxisModel, name: str, other: str) -> AxisModel:
    """Put another effect in the place of one, keeping the values of parameters that both have."""
    plain = {p.symbol: p.start * model.scale(p) for p in known()[other].parameters}
    shared = {k: v for k, v in model.effects[name].items() if k in plain}
    shared |= {k: model.effects[name][o] for k, o in known()[other].takes if o in model.effects[name]}
    return named(model.without_effect(name).with_effect(other, {**plain, **shared}))


def replaced(model: AxisModel, name: str) -> bool:
    """Say whether an effect would take the place of one in the model."""
    return any(n in model.effects for n in known()[name].replaces)


def vacant(model: AxisModel, name: str, other: str) -> bool:
    """Say whether the place of an effect may be given to another: neither that nor what it excludes is in the model
    beside.
    """
    return other not in model.effects and not replaced(model.without_effect(name), other)


def size(name: str) -> int:
    """Number of parameters of an effect."""
    return len(known()[name].parameters)


def unspecific(name: str, gains: dict[str, float]) -> bool:
    """Say whether an effect of quite another kind saves nearly as much: then the residual has no name yet."""
    lib = known()
    family = {
        name,
        *lib[name].confounders,
        *lib[name].replaces,
        *(n for n in lib if name in lib[n].confounders),
    }
    return any(g > NEARLY * gains[name] for n, g in gains.items() if n not in family)


def physical(fit: Fit, name: str) -> bool:
    """Say whether an effect can be: within its bounds, and not too small to be told."""
    return not leans(fit.model, name) and not small(fit.model, name)


def leans(model: AxisModel, name: str) -> bool:
    """Say whether a number of an effect leans on its bound: then it belongs to something else.

    The stiffness and damping of a contact may: harder than what is seen is as good as hard. So may a time constant that
    is longer than the records. Of friction with a path of its own, a drop within no speed or a build-up within no path,
    or within a path that the encoder does not see, is another friction.
    """
    effect, given = known()[name], model.effects[name]
    if any(given[a] > most * given[b] for a, b, most in effect.ratios):
        return True
    free = [q for q in effect.parameters if not q.phase and not q.fixed]
    least = [q for q in free if q.vanishes or q.ref is Ref.TIME]
    if any(0.0 < given[q.symbol] < 1.02 * q.lower * model.scale(q) for q in least):
        return True
    if any(0.0 < given[q.symbol] < q.steps * model.resolution for q in free if q is not effect.primary):
        return True
    for q in [q for q in free if not q.soft]:
        low, high = model.bounds(name, q)
        signed = q.lower < 0.0 or effect.neutral != 0.0
        if given[q.symbol] > 0.98 * high or (signed and given[q.symbol] < low + 0.02 * abs(low)):
            return True
    return False


def small(model: AxisModel, name: str) -> bool:
    """Say whether an effect has become smaller than it may be to be named."""
    effect = known()[name]
    if not effect.sized:
        return False
    p = effect.primary
    if effect.neutral:
        return abs(model.effects[name][p.symbol] - effect.neutral) <= p.least
    least = max(max(p.lower, p.least, 1e-4 * p.start) * model.scale(p), p.steps * model.resolution)
    return abs(model.effects[name][p.symbol]) <= 1.01 * least
