"""What speaks for the effects of a model: intervals of their numbers, what each saves, and the look-alikes it was told from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sioms.reconcile.ambiguity import Rival
from sioms.reconcile.blocks import better, block_ids, formal, intervals
from sioms.reconcile.channels import Finding
from sioms.reconcile.effect import Array, Slot
from sioms.reconcile.effects import known
from sioms.reconcile.fit import BASE, Fit, Problem, get, jacobian, refit
from sioms.reconcile.rules import GAIN, told_apart
from sioms.reconcile.search import Found, Searcher
from sioms.reconcile.verdict import Estimate, NamedEffect, apart

#: Multiples of a parameter of the bounces in a gap that are tried for its interval.
ROUGH_GRID = tuple(float(x) for x in np.linspace(0.9, 1.1, 17))


def spans_of(
    problem: Problem, fit: Fit, replicates: int, rng: np.random.Generator
) -> dict[tuple[str, str], tuple[float, float]]:
    """Return the 95 % interval of every free number by (effect, symbol): by leaving out each block of time, within its bounds.

    Bounces that count little in a fit say how uncertain it is: the residual is taken as it is.
    """
    if problem.bend < np.inf:
        problem = replace(problem, bend=np.inf)
        r = problem.residual(fit.model)
        fit = replace(
            fit, residual=r, jacobian=jacobian(problem, fit.model, fit.free, get(fit.model, fit.free), r)
        )
    half = np.maximum(intervals(fit, block_ids(problem, fit.model.sample_time_s)), formal(fit))
    spread = half * np.array([f.scale for f in fit.free])
    out = {}
    for f, s in zip(fit.free, spread, strict=True):
        value = getattr(fit.model, f.symbol) if f.effect == BASE else fit.model.effects[f.effect][f.symbol]
        if f.effect != BASE and known()[f.effect].slot is Slot.BACKLASH:
            s = max(float(s), value * _rough_spread(problem, fit, f.effect, f.symbol, replicates, rng))
        out[f.effect, f.symbol] = (
            max(value - float(s), min(f.lower, value)),
            min(value + float(s), max(f.upper, value)),
        )
    return out


def _rough_spread(
    problem: Problem, fit: Fit, name: str, symbol: str, replicates: int, rng: np.random.Generator
) -> float:
    """95 % half-width, relative, of a parameter whose cost is rough: where the best of a grid falls, over bootstrap replicates."""
    here = fit.model.effects[name]
    ids = block_ids(problem, fit.model.sample_time_s)
    count = int(ids.max()) + 1

    def energy(factor: float) -> Array:
        e = problem.residual(fit.model.with_effect(name, {**here, symbol: here[symbol] * factor}))
        return np.asarray(np.bincount(ids, weights=e**2, minlength=count), dtype=np.float64)

    costs = np.stack(list(problem.mapper(energy, ROUGH_GRID)))
    draws = rng.multinomial(count, np.full(count, 1.0 / count), size=replicates)
    best = np.asarray(ROUGH_GRID)[np.argmin(draws @ costs.T, axis=1)]
    step = ROUGH_GRID[1] - ROUGH_GRID[0]
    return float(1.96 * np.sqrt(np.mean((best - 1.0) ** 2) + step**2 / 12.0))


def describe(
    findings: Sequence[Finding],
    fit: Fit,
    found: Found,
    searcher: Searcher,
    others: Sequence[Rival],
    given: dict[tuple[str, str], tuple[float, float]],
    rng: np.random.Generator,
) -> tuple[list[NamedEffect], list[NamedEffect]]:
    """Describe every effect of the model.

    Args:
        findings: of the channels, whose effects have errors of their own.
        given: intervals by (effect, symbol).

    Returns:
        The named effects, the largest first, and the nameless terms.
    """
    named: list[NamedEffect] = []
    for name in fit.model.effects:
        saved, errors, frequency = _worth(found, searcher, name, rng)
        effect = known()[name]
        finding = next((f for f in findings if f.effect == name), None)
        spans = dict(given)
        if finding is not None:
            spans.update(
                {
                    (name, s): (finding.values[s] - 1.96 * e, finding.values[s] + 1.96 * e)
                    for s, e in finding.errors.items()
                }
            )
        estimates = tuple(
            Estimate(
                p.symbol,
                fit.model.effects[name][p.symbol],
                *spans.get((name, p.symbol), (fit.model.effects[name][p.symbol],) * 2),
                fit.model.unit(p),
                p.text,
            )
            for p in effect.parameters
        )
        evidence = [finding.evidence] if finding is not None else []
        evidence.append(
            f"without it {100 * saved:.1f} % of the residual energy would come back ({errors:.1f} standard errors)"
        )
        ruled, still = told_apart(name, effect.lookalikes, others, found.ladder, fit.model.effects)
        still = {rival: f"{text}, with {_numbers(name, rival, others)}" for rival, text in still.items()}
        named.append(
            NamedEffect(
                name,
                effect.title,
                effect.equation,
                effect.channel.value,
                estimates,
                saved,
                errors,
                frequency,
                tuple(evidence),
                ruled,
                still,
            )
        )
    return apart(sorted(named, key=lambda e: -e.saved))


def _numbers(name: str, rival: str, others: Sequence[Rival]) -> str:
    """Say with which numbers a look-alike stands in the place of an effect."""
    model = next(r.fit.model for r in others if (r.effect, r.rival) == (name, rival))
    return ", ".join(
        f"{p.symbol} = {model.effects[rival][p.symbol]:.4g}"
        + ("" if model.unit(p) == "1" else f" {model.unit(p)}")
        for p in known()[rival].parameters
    )


def _worth(
    found: Found, searcher: Searcher, name: str, rng: np.random.Generator
) -> tuple[float, float, float]:
    """How much an effect saves beyond the others, in how many standard errors and bootstrap replicates."""
    bare = refit(searcher.problem, found.fit.model.without_effect(name), searcher.frozen, 4)
    loss = searcher.loss(bare)
    saved, errors = better(found.losses, loss)
    d, n = loss - found.losses, len(loss)
    draws = rng.integers(0, n, (200, n))
    frequency = float(np.mean(d[draws].sum(1) > GAIN * loss[draws].sum(1)))
    return saved, errors, frequency
