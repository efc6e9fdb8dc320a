"""What of a model is no finding, and why: names that stand for something else, for too little, or for a part of a law
without a name.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np

from sioms.reconcile.ambiguity import confounders
from sioms.reconcile.bends import Bend
from sioms.reconcile.effect import Over
from sioms.reconcile.effects import known
from sioms.reconcile.effects.smooth import CONSTANT, LAWS, SIDE
from sioms.reconcile.fit import Problem, refit
from sioms.reconcile.model import AxisModel
from sioms.reconcile.thresholds import AXIS, DWARFED, MISSED, PLACES_A_PERIOD, REMAINS
from sioms.reconcile.uneven import Uneven
from sioms.reconcile.variation import named as varied
from sioms.reconcile.verdict import Candidate, NamedEffect

#: A drop with the speed: beside a law of the speed it is a part of that.
DROPS = "stribeck"
#: Why an effect of the model is no finding.
REFUSED_FREE = "the model with it does not move as the machine did"
REFUSED_BEYOND = "too much remains beside it for a part to be told"
REFUSED_IDLE = "held-out samples are met as well without it: it may stand for a part of what remains"
REFUSED_SMALL = "beside a formula without a name that explains far more it may be what that formula lacks"
REFUSED_BOUND = "a number of it is at the end of what it can be: it stands for something else"
REFUSED_UNEVEN = "its numbers are not the same everywhere, they change with {}: its law is another one"
REFUSED_BENT = "its {} comes to another value than that of the law: its law is another one"
REFUSED_HANGS = "how large it is hangs on a law that is another one"
REFUSED_ALIKE = "the law of what it looks like is another one, and it may make up for that"


def another_law(
    named: Sequence[NamedEffect], changing: Sequence[Uneven], turned: Sequence[Bend] = ()
) -> tuple[Candidate, ...]:
    """Refuse the names whose numbers or exponents are others, those that look like them and what hangs on them."""
    laws = {c.effect: REFUSED_UNEVEN.format(c.variable) for c in changing}
    laws |= {b.effect: REFUSED_BENT.format(b.what) for b in turned}
    alike = {other: REFUSED_ALIKE for name in laws for other in confounders(name)}
    why = alike | {name: REFUSED_HANGS for b in turned for name in b.hangs} | laws
    return tuple(Candidate(e.name, e.title, why[e.name]) for e in named if e.name in why)


def doubted(effect: NamedEffect, ratio: float) -> bool:
    """Say whether an effect explains less than what remains above the noise: it may have taken a part of that.

    Args:
        ratio: of what remains to the noise.
    """
    explained = ratio**2 * effect.saved / max(1.0 - effect.saved, 1e-300)
    return ratio > AXIS.floor and explained < REMAINS * (ratio**2 - 1.0)


def dwarfed(effect: NamedEffect, terms: Sequence[NamedEffect]) -> bool:
    """Say whether an effect explains so much less than a nameless term beside it that it may be an error of its form.

    Both in units of what remains.
    """
    explained, most = (
        max((e.saved / max(1.0 - e.saved, 1e-300) for e in group), default=0.0) for group in ([effect], terms)
    )
    return explained < DWARFED * most


def formulas(
    named: Sequence[NamedEffect], terms: Sequence[NamedEffect], pitches: float = 0.0, changing: Collection[str] = ()
) -> tuple[list[NamedEffect], list[NamedEffect]]:
    """Take its name from an effect beside which a nameless term of the same variable stands: together they are one law
    of that variable, of which nobody can tell how much the effect is; so are a constant and a law without a zero of its
    own, and a force that repeats along the travel, but so seldom that a law could be what makes it.

    Args:
        pitches: travel of the records.
        changing: what may be a part of a number that changes in time.

    Returns:
        What is named, and the formulas without a name.
    """
    beside = {t.name for t in terms}
    laws = [law for law in LAWS if beside & {law.name, *law.replaces}]
    within = {n for law in laws for n in (*law.replaces, CONSTANT.get(law.name, ""))} | set(changing)
    if any(law.over is Over.PLACE for law in laws):
        within |= {e.name for e in named if _seldom(e, pitches)}
    if any(law.over is Over.SPEED for law in laws):
        within |= {e.name for e in named if e.name == DROPS}
    parts = [replace(e, title=e.equation) for e in named if e.name in within]
    return [e for e in named if e.name not in within], [*terms, *parts]


def _seldom(effect: NamedEffect, pitches: float) -> bool:
    """Say whether a force repeats along the travel, but with a period no shorter than what a smooth law shows."""
    orders = [q.symbol for q in known()[effect.name].parameters if q.fixed and q.unit == "1/pitch"]
    periods = [pitches * value.value for value in effect.parameters if value.symbol in orders]
    return bool(periods) and 2.0 * SIDE / max(periods[0], 1e-300) >= PLACES_A_PERIOD


def refused(
    named: Sequence[NamedEffect], leaning: Sequence[NamedEffect], freely_refused: bool, beyond: bool
) -> tuple[Candidate, ...]:
    """Return what is in the model without being found: all of it where the model is refused, else what leans."""
    if freely_refused:
        return tuple(Candidate(e.name, e.title, REFUSED_FREE) for e in named)
    if beyond:
        return tuple(Candidate(e.name, e.title, REFUSED_BEYOND) for e in named)
    return tuple(Candidate(e.name, e.title, REFUSED_BOUND) for e in leaning)


def idle(
    both: tuple[Problem, Problem], model: AxisModel, every: Sequence[NamedEffect], tried: Sequence[Candidate],
    frozen: Sequence[str],
) -> tuple[Candidate, ...]:  # fmt: skip
    """Return what the untouched samples do not need: beside a remainder it may have taken a part of that.

    Args:
        both: the samples that were searched, and the untouched ones.
    """
    kept = {*frozen, *(c.name for c in tried)}
    looked = [e for e in every if e.name in model.effects and e.name not in kept]
    return tuple(Candidate(e.name, e.title, REFUSED_IDLE) for e in looked if not needed(both, model, e.name, frozen))


def needed(problems: tuple[Problem, Problem], model: AxisModel, name: str, frozen: Sequence[str] = ()) -> bool:
    """Say whether untouched samples are met worse without an effect.

    Args:
        problems: the samples that were searched, to which what is left is fitted again, and the untouched ones.
    """
    bare = refit(problems[0], varied(model.without_effect(name)), frozen, 4).model
    left, more = (float(np.sum(problems[1].residual(m) ** 2)) for m in (model, bare))
    return more > (1.0 + MISSED) * left


def as_stated(model: AxisModel, nominal: AxisModel) -> AxisModel:
    """Give the numbers back that were refined: those of a refused model are no findings either."""
    return replace(model, **{symbol: getattr(nominal, symbol) for symbol in nominal.refine})
