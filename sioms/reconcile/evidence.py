"""What speaks for the effects of a model: intervals of their numbers, what each saves, and the confounders it was told
from.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.stats import t as student

from sioms.reconcile.ambiguity import Rival
from sioms.reconcile.blocks import better, formal, intervals
from sioms.reconcile.channels import Finding
from sioms.reconcile.effects import known
from sioms.reconcile.engine.evidence import described, frequency
from sioms.reconcile.engine.fit import get
from sioms.reconcile.fit import Fit, Problem, block_ids, refit
from sioms.reconcile.plausible import size
from sioms.reconcile.search import Found, Searcher
from sioms.reconcile.verdict import Estimate, NamedEffect, apart


def spans_of(problem: Problem, fit: Fit, others: Sequence[Fit] = ()) -> dict[tuple[str, str], tuple[float, float]]:
    """Return the 95 % interval of every free number by (effect, symbol), within its bounds.

    It is that of leaving out each block of time, and, where the cost is rough, of how far from this minimum others are.

    Args:
        others: minima that descent from elsewhere led to.
    """
    half = np.maximum(intervals(fit, block_ids(problem, fit.model.sample_time_s)), formal(fit))
    half = half * np.array([f.scale for f in fit.free])
    if others:
        at = get(fit.model, fit.free)
        off = np.array([get(o.model, fit.free) for o in others]) - at
        turned = np.array([f.phase for f in fit.free])
        off[:, turned] = np.angle(np.exp(1j * off[:, turned]))
        half = np.hypot(half, student.ppf(0.975, len(others)) * np.sqrt(np.mean(off**2, axis=0)))
    out = {}
    for f, value, s in zip(fit.free, get(fit.model, fit.free), half, strict=True):
        low, high = float(value - s), float(value + s)
        out[f.effect, f.symbol] = (
            max(low, min(f.lower, float(value))),
            min(high, max(f.upper, float(value))),
        )
    return out


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
        saved, errors, often = _worth(found, searcher, name, rng)
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
        evidence.append(f"explains {100 * saved:.1f} % of what remains without it ({errors:.1f} standard errors)")
        numbers = {r.rival: _numbers(r) for r in others if r.effect == name}
        worth = saved, errors, often
        wider = [n for n, other in known().items() if name in other.replaces and size(n) > size(name)]
        named.append(
            described(effect, estimates, worth, evidence, others, found.path, fit.model.effects, numbers, wider)
        )
    return apart(sorted(named, key=lambda e: -e.saved))


def _numbers(r: Rival) -> str:
    """Say with which numbers a confounder stands in the place of an effect."""
    model = r.fit.model
    return ", ".join(
        f"{p.symbol} = {model.effects[r.rival][p.symbol]:.4g}" + ("" if model.unit(p) == "1" else f" {model.unit(p)}")
        for p in known()[r.rival].parameters
    )


def _worth(found: Found, searcher: Searcher, name: str, rng: np.random.Generator) -> tuple[float, float, float]:
    """How much an effect saves beyond the others, in how many standard errors and bootstrap replicates."""
    bare = refit(searcher.problem, found.fit.model.without_effect(name), searcher.frozen, 4)
    loss = searcher.loss(bare)
    saved, errors = better(found.losses, loss)
    return saved, errors, frequency(found.losses, loss, rng)
