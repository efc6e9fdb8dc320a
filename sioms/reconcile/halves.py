"""What was named on interpolated records must stand on every other row alone.

Half the rows err by several times as much between them. So the differences bound the error of the interpolation: they
are added to the intervals. What is not found there is not named.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sioms.reconcile.axis_verdict import AxisVerdict
from sioms.reconcile.conclude import LAST, Searched
from sioms.reconcile.effects import known
from sioms.reconcile.fit import Fit, Problem, refit
from sioms.reconcile.records import Record, Session
from sioms.reconcile.thresholds import GAIN, STANDS
from sioms.reconcile.variation import named
from sioms.reconcile.verdict import Candidate, Estimate, NamedEffect, Outcome

WHY = "it is another one, or none, on every other row of the polled log: poll more often, or move more slowly"
SAID = (
    "the rows of the polled log are too few for what was found: every other one of them tells something else; poll "
    "twice as often, or move more slowly"
)
NOTHING = (
    "nothing that the rows of the polled log resolve is missing; what happens between them (play, sticking, a delay) "
    "they do not tell: log what the drive samples at a fixed rate"
)


def on_halves(verdict: AxisVerdict, s: Searched) -> AxisVerdict:
    """Refit what is named to every other row; widen the intervals by the differences, and refuse what does not stand.

    Where nothing was interpolated the verdict stays as it is. That nothing is missing no polled log tells.
    """
    whole = replace(s.ready.problem, weights=None)
    halves = whole.session.halves
    if not halves:
        return verdict
    if verdict.outcome is Outcome.NONE:
        return replace(verdict, outcome=Outcome.UNEXPLAINED, notes=(*verdict.notes, NOTHING))
    problems = [_half(whole, half) for half in halves]
    frozen = s.searcher.frozen
    fits = [refit(p, verdict.model, frozen, LAST) for p in problems]
    standing = [e for e in verdict.effects if _stands(e, verdict, problems, fits, frozen)]
    effects = tuple(_widened(e, fits) for e in standing)
    if len(standing) == len(verdict.effects):
        return replace(verdict, effects=effects)
    gone = [e for e in verdict.effects if e not in standing]
    candidates = (*verdict.candidates, *(Candidate(e.name, e.title, WHY) for e in gone))
    return replace(
        verdict, outcome=Outcome.UNEXPLAINED, effects=(), alternatives=(), decisive=None, others=(),
        candidates=(*candidates, *(Candidate(e.name, e.title, WHY) for e in standing)), notes=(*verdict.notes, SAID),
    )  # fmt: skip


def _half(problem: Problem, half: Session) -> Problem:
    """Return the problem on one half; what is known beside the records is that of the whole ones."""
    by_name = {r.name: r for r in half.records}

    def read(r: Record) -> Record:
        other = by_name[r.name]
        return replace(other, external=r.external, trust=r.trust)

    return replace(problem, session=replace(problem.session, records=tuple(map(read, problem.session.records))))


def _stands(
    effect: NamedEffect, verdict: AxisVerdict, problems: list[Problem], fits: list[Fit], frozen: tuple[str, ...]
) -> bool:
    """Say whether an effect is found on each half: it saves, and its size is about the same."""
    if effect.name in frozen:
        return True
    p = known()[effect.name].primary
    value = verdict.model.effects[effect.name][p.symbol] - known()[effect.name].neutral
    for problem, fit in zip(problems, fits, strict=True):
        other = fit.model.effects[effect.name][p.symbol] - known()[effect.name].neutral
        bare = refit(problem, named(fit.model.without_effect(effect.name)), frozen, 4)
        if abs(other - value) > STANDS * abs(value) or bare.cost < (1.0 + GAIN) * fit.cost:
            return False
    return True


def _widened(effect: NamedEffect, fits: list[Fit]) -> NamedEffect:
    turned = {p.symbol for p in known()[effect.name].parameters if p.phase}

    def wide(e: Estimate) -> Estimate:
        off = np.array([fit.model.effects[effect.name][e.symbol] for fit in fits]) - e.value
        off = np.angle(np.exp(1j * off)) if e.symbol in turned else off
        most = float(np.max(np.abs(off)))
        return replace(e, low=e.low - most, high=e.high + most)

    parameters = tuple(map(wide, effect.parameters))
    return replace(
        effect, parameters=parameters, evidence=(*effect.evidence, "it stands on every other row of the log")
    )
