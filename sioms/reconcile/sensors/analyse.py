"""The workflow for a sensor: gate, search, refuse, doubt, show; the steps and their rules are those of the axis.

``analyse`` takes a prepared subject and returns a ``SensorVerdict``. It is deterministic by ``seed`` and reads and
writes nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from sioms.reconcile.engine.evidence import alternative, described, frequency, outcome
from sioms.reconcile.noise import effective_samples
from sioms.reconcile.rules import negligible
from sioms.reconcile.sensors.ambiguity import Rival, settle
from sioms.reconcile.sensors.effect import SensorEffect, SensorModel
from sioms.reconcile.sensors.excitation import gate
from sioms.reconcile.sensors.fit import Fit, half_intervals, on_one_footing, ratios, refit
from sioms.reconcile.sensors.locate import locate
from sioms.reconcile.sensors.plausible import termed
from sioms.reconcile.sensors.refuse import burst_share, smoother_shares
from sioms.reconcile.sensors.search import Found, Searcher
from sioms.reconcile.sensors.stand_ins import credible, displaced, ruled
from sioms.reconcile.sensors.steady import changes
from sioms.reconcile.sensors.subject import Subject
from sioms.reconcile.sensors.verdict import Curve, Proposal, SensorVerdict
from sioms.reconcile.thresholds import BURSTS, QUIET, REFUSED, SENSOR, SURELY, UNEXPLAINED, UNSTEADY
from sioms.reconcile.verdict import Estimate, Gap, NamedEffect, Outcome, Place, apart


@dataclass(frozen=True, slots=True)
class Options:
    """Settings of one analysis: seed of permutations and bootstrap, pictures, and who is told."""

    seed: int = 1
    pictures: bool = True
    progress: Callable[[str], None] = field(default=lambda text: None)


def analyse(subject: Subject, options: Options | None = None) -> SensorVerdict:
    """Find what the nominal model of a sensor lacks."""
    o = options or Options()
    frozen = tuple(e.name for e in subject.settled)
    o.progress("excitation: what can these records show")
    missing, pairs, names = gate(subject)
    searcher = Searcher(subject.training, names, frozen, o.progress, subject.terms)
    subject, found = _search(subject, searcher, subject.model)
    share, where = _smoothed(subject, searcher, found)
    bursts = _bursts(subject, searcher, found)
    before = tuple(found.fit.model.effects)
    if _odd(searcher, found, share, where) or displaced(searcher, found) or _stand_ins(subject, searcher, found, names):
        o.progress(f"what remains has no name (a smoother explains {100 * share:.0f} %): searching for a term")
        searcher.names = names + subject.terms
        subject, found = _search(subject, searcher, subject.model)
        found, names = _without_stand_ins(subject, searcher, found, names)
        searcher.names = names
    o.progress("identifiability: confounders in the place of each effect")
    found, others = settle(searcher, found, pairs)
    missing = {n: text for n, text in missing.items() if n not in found.fit.model.effects}
    share, where = _smoothed(subject, searcher, found)
    left = _odd(searcher, found, share, where)
    if not termed(found.fit.model):  # what looked like bursts may have been explained by names since
        bursts = min(bursts, _bursts(subject, searcher, found))
    if left:
        found = credible(searcher, found)
        others = [r for r in others if r.effect in found.fit.model.effects]
    rejected = tuple(n for n in before if n not in found.fit.model.effects)
    return _conclude(subject, o, searcher, found, others, missing, pairs, share, left, bursts, rejected)


def _search(subject: Subject, searcher: Searcher, start: SensorModel) -> tuple[Subject, Found]:
    """Search from a model; where the floor is lower beside what was found, search on."""
    found = searcher.run(start)
    shares = smoother_shares(subject.training, found.fit, searcher.weights, subject.features())
    sharper = subject.sharpened(found.fit.model, shares)
    if sharper is None:
        return subject, found
    searcher.data = sharper.training
    further = searcher.run(found.fit.model)
    return sharper, replace(further, path=(*found.path, *further.path[1:]))


def _smoothed(subject: Subject, searcher: Searcher, found: Found) -> tuple[float, str]:
    """Return the largest share of a view that a smoother explains, and the name of that view; one above its floor
    first.
    """
    shares = smoother_shares(subject.training, found.fit, searcher.weights, subject.features())
    above = searcher.ratios(found.fit.model) > searcher.beyond_chance(SENSOR.odd)
    view = max(shares, key=lambda v: (bool(above[v] and shares[v] > UNEXPLAINED), shares[v]))
    return shares[view], subject.training.views[view] if shares[view] > 0.0 else ""


def _without_stand_ins(
    subject: Subject, searcher: Searcher, found: Found, names: tuple[str, ...]
) -> tuple[Found, tuple[str, ...]]:
    """Search without names that may stand for something else; where that does as well, they are refused.

    Returns:
        What was found, and the names that were not refused.
    """
    asked = names
    for _ in range(REFUSED):
        bent = _stand_ins(subject, searcher, found, asked)
        if not bent:
            break
        searcher.progress(f"{' and '.join(bent)} may stand for something else: searching without")
        asked = tuple(n for n in asked if n not in bent)
        searcher.names = tuple(n for n in names if n not in bent) + subject.terms
        footing = searcher.weights
        other = searcher.run(subject.model)
        own, searcher.weights = searcher.weights, footing  # losses compare on one footing only
        worse = searcher.lost(searcher.loss(searcher.fit(other.fit.model)), found.losses)
        if negligible(worse.share, worse.errors):
            found, names, searcher.weights = other, tuple(n for n in names if n not in bent), own
    return found, names


def _stand_ins(subject: Subject, searcher: Searcher, found: Found, names: Sequence[str]) -> tuple[str, ...]:
    """Return those of these names that are not the same everywhere, or of which one nameless rule does as well."""
    return _unsteady(subject, searcher, found, names) or ruled(searcher, found, names)


def _unsteady(subject: Subject, searcher: Searcher, found: Found, names: Sequence[str]) -> tuple[str, ...]:
    """Return the one of these names that changes most surely with something, none where all are the same everywhere."""
    names = [n for n in names if n in found.fit.model.effects]
    seen = changes(subject.training, found.fit, searcher.weights, names, subject.variables(subject.training))
    sure = [c for c in seen if abs(c.share) > max(UNSTEADY, SURELY * c.half)]
    return (max(sure, key=lambda c: abs(c.share) / c.half).effect,) if sure else ()


def _odd(searcher: Searcher, found: Found, share: float, view: str) -> bool:
    """Say whether something is left: a view above its floor that the state explains, or one far above it whatever
    explains it; further than chance brings so few rows.
    """
    ratios, views = searcher.ratios(found.fit.model), searcher.data.views
    if view and share > UNEXPLAINED and (ratios > searcher.beyond_chance(SENSOR.odd))[views.index(view)]:
        return True
    return bool(np.any(ratios > searcher.beyond_chance(QUIET)))


def _bursts(subject: Subject, searcher: Searcher, found: Found) -> float:
    mine = subject.training.view == 0
    ratio = searcher.ratios(found.fit.model)[0]
    return burst_share(found.fit.residual[mine], subject.groups()) if ratio > QUIET else 0.0


def _conclude(
    subject: Subject,
    o: Options,
    searcher: Searcher,
    found: Found,
    others: Sequence[Rival],
    missing: dict[str, str],
    pairs: tuple[tuple[str, str, float], ...],
    share: float,
    left: bool,
    bursts: float,
    rejected: tuple[str, ...],
) -> SensorVerdict:
    rng = np.random.default_rng(o.seed)
    o.progress("untouched rows: gap before and after")
    start = found.path[0].model
    gaps = _gaps(subject, start, found.fit.model)
    weights = on_one_footing(subject.whole, found.fit.model)
    fit = refit(subject.whole, found.fit.model, weights, searcher.frozen)
    named, terms = _describe(subject, fit, found, searcher, others, rng)
    open_rivals = [r for r in others if r.open]
    disturbed = bursts > BURSTS and share < UNEXPLAINED
    unexplained = bool(terms) or left or disturbed
    ambiguous = bool(open_rivals)
    said = outcome(bool(named), unexplained, ambiguous)
    alternatives: tuple[tuple[str, ...], ...] = ()
    plan: tuple[Proposal, ...] = ()
    if said is Outcome.AMBIGUOUS:
        alternatives = tuple(alternative(r, fit.model.effects) for r in open_rivals)
        plan = subject.propose([fit.model, *(r.fit.model for r in open_rivals)])
    notes = list(subject.notes)
    if disturbed:
        notes.append(
            f"the residual comes in bursts ({100 * bursts:.0f} % of its energy in a tenth of the touches) that no "
            "state orders: a disturbance from outside, not an effect"
        )
    places: tuple[Place, ...] = ()
    curves: tuple[Curve, ...] = ()
    if o.pictures:
        o.progress("locating the disagreement")
        places = tuple(locate(subject, start, rng))
        curves = subject.curves(start, fit.model)
    floors = dict(zip(subject.whole.views, (float(v) for v in ratios(subject.whole, fit.model)), strict=True))
    mine = subject.whole.view == 0
    e = subject.whole.miss(subject.whole.predict(fit.model))
    return SensorVerdict(
        outcome=said,
        nominal=subject.model,
        model=fit.model,
        effects=tuple(named),
        alternatives=alternatives,
        symbolic=tuple(terms),
        gaps=gaps,
        path=found.path,
        floors=floors,
        missing=missing,
        pairs=pairs,
        places=places,
        experiments=plan,
        ratio=max(floors.values()),
        smoother_share=share,
        burst_share=bursts,
        effective_samples=effective_samples(e[mine]),
        samples=len(e),
        notes=tuple(notes),
        curves=curves,
        rejected=rejected,
    )


def _gaps(subject: Subject, before: SensorModel, after: SensorModel) -> tuple[Gap, ...]:
    """Compare on the rows that took no part in any choice; views of one footing together."""
    data, told, out = subject.final, subject.views(), []
    group = np.array(data.footing)[data.view]
    old, new = (data.miss(data.predict(m)) for m in (before, after))
    for i, name in enumerate(data.views):
        mine = group == i
        if mine.any():
            v = told[name]
            was, left = (v.floor * float(np.sqrt(np.mean(e[mine] ** 2))) for e in (old, new))
            out.append(Gap(v.title, v.unit, was, left, v.floor))
    return tuple(out)


def _describe(
    subject: Subject,
    fit: Fit,
    found: Found,
    searcher: Searcher,
    others: Sequence[Rival],
    rng: np.random.Generator,
) -> tuple[list[NamedEffect], list[NamedEffect]]:
    """Describe every effect, the largest first; terms apart."""
    half = half_intervals(subject.whole, fit, on_one_footing(subject.whole, found.fit.model))
    spread = {(f.effect, f.symbol, f.index): float(s) for f, s in zip(fit.free, half, strict=True)}
    out: list[tuple[float, NamedEffect]] = [(np.inf, e) for e in subject.settled]
    for name in [n for n in fit.model.effects if n not in searcher.frozen]:
        effect = fit.model.library[name]
        bare = searcher.fit(found.fit.model.without_effect(name), 4)
        loss = searcher.loss(bare)
        gap = searcher.saving(found.losses, loss)
        mine = searcher.of_block == searcher.data.views.index(gap.view)
        often = frequency(found.losses[mine], loss[mine], rng)
        estimates = _estimates(subject, effect, fit.model, spread)
        title = subject.views()[gap.view].title
        evidence = [
            f"without it the squared residual of the {title} would be {1.0 / max(1.0 - gap.share, 1e-3):.3g} times as "
            f"large ({gap.errors:.1f} standard errors, on blocks held out)"
        ]
        worth = gap.share, gap.errors, often
        told = described(effect, estimates, worth, evidence, others, found.path, fit.model.effects, {})
        out.append((bare.cost - found.fit.cost, told))
    out.sort(key=lambda e: -e[0])
    return apart(e for _, e in out)


def _estimates(
    subject: Subject, effect: SensorEffect, model: SensorModel, spread: Mapping[tuple[str, str, int | None], float]
) -> tuple[Estimate, ...]:
    out = []
    for q in effect.parameters:
        values = model.effects[effect.name][q.symbol]
        for i, v in enumerate(values):
            s = spread.get((effect.name, q.symbol, i), 0.0)
            low, high = (-np.inf, np.inf) if q.phase else (min(q.lower, v), max(q.upper, v))
            symbol = f"{q.symbol}[{i}]" if len(values) > 1 else q.symbol
            unit = subject.unit(effect.name, q.symbol)
            span = max(float(v) - s, float(low)), min(float(v) + s, float(high))
            out.append(Estimate(symbol, float(v), *span, unit, q.text))
    return tuple(out)
