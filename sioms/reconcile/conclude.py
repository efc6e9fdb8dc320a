"""From what a search ended with to a verdict: figures on untouched samples, intervals, evidence, what to say and to do
next.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from sioms.reconcile.ambiguity import Rival
from sioms.reconcile.axis_verdict import AxisVerdict
from sioms.reconcile.bends import Bend, bent, loosened
from sioms.reconcile.bounces import deepest, has_impacts
from sioms.reconcile.controlled import foreign
from sioms.reconcile.disturbance import disturbance
from sioms.reconcile.effects import known
from sioms.reconcile.effects.smooth import OPPOSING
from sioms.reconcile.engine.evidence import alternative, outcome
from sioms.reconcile.evidence import describe, spans_of
from sioms.reconcile.excitation import Gate
from sioms.reconcile.experiment import Envelope, Experiment, separate
from sioms.reconcile.fit import Fit, Problem, refit
from sioms.reconcile.floor import ON_MODEL, closed_floor
from sioms.reconcile.free import freely
from sioms.reconcile.gaps import free_gaps, measure, rungs, session_states
from sioms.reconcile.judge import Judgement, judge
from sioms.reconcile.locked import locked
from sioms.reconcile.model import AxisModel
from sioms.reconcile.noise import effective_samples
from sioms.reconcile.opposing import at_rest, friction_told, likened
from sioms.reconcile.pictured import pictures
from sioms.reconcile.plausible import leans
from sioms.reconcile.prepare import TIMES, Options, Prepared, searched
from sioms.reconcile.rate import SAMPLE_TIME, instead, remark
from sioms.reconcile.records import Session
from sioms.reconcile.refine import runs_away
from sioms.reconcile.refusals import (
    REFUSED_FREE,
    REFUSED_SMALL,
    another_law,
    as_stated,
    doubted,
    dwarfed,
    formulas,
    idle,
    refused,
)
from sioms.reconcile.remarks import of_bend, of_bursts, of_change, of_doubts, of_hanging, of_inertia, of_much
from sioms.reconcile.search import Found, Searcher
from sioms.reconcile.session import State
from sioms.reconcile.steps import halved
from sioms.reconcile.thresholds import (
    AXIS,
    BURSTS,
    LARGE,
    LOCKED,
    LOUD,
    MOSTLY_LOCKED,
    QUIET,
    REFUTED,
    UNEXPLAINED,
)
from sioms.reconcile.timed import as_recorded
from sioms.reconcile.uneven import Uneven, uneven
from sioms.reconcile.verdict import Candidate, Gap, NamedEffect, Outcome

HELD = (
    "delay and lag are counted from a force that is held from row to row of the log; of a loop much faster than the "
    "log they are up to {:.2g} ms longer (loop_time_s in columns.toml would tell)"
)
#: What another drive is called among the alternatives, and what is said of it.
OTHER_LAW = "another_law_of_the_drive"
OF_DRIVE = "measured and commanded force do not tell {} from another law of the drive"
TO_TELL = "{} would be told from {} by {}, with less noise of the force"
AT_REST = (
    "the level of Coulomb friction is that of all friction, extrapolated to rest; in model.toml a law without a name "
    "has a part of it"
)
#: Steps of the last fit.
LAST = 12
#: The effect that another sample time looks like.
PAYLOAD = "payload"


#: Intervals by (effect, symbol).
Spans = dict[tuple[str, str], tuple[float, float]]


@dataclass(frozen=True, slots=True)
class Searched:
    """What a search ended with.

    Attributes:
        share: that a generic smoother explains of what remains.
        rejected: effects that left when nameless terms came in.
    """

    ready: Prepared
    excited: Gate
    searcher: Searcher
    found: Found
    share: float
    rejected: tuple[str, ...]


def conclude(s: Searched, o: Options, others: Sequence[Rival], burst: float) -> AxisVerdict:
    """Conclude.

    Args:
        others: confounders in the place of what was found.
        burst: share of the residual's energy above the quiet level that lies in its loudest tenths of a second.
    """
    ready, found, nominal = s.ready, s.found, s.ready.nominal
    rng = np.random.default_rng(o.seed)
    o.progress("untouched samples: gap before and after")
    states = session_states(ready.final, found.fit.model)
    gaps, judged = _gaps(s, states, rng)
    whole = replace(ready.problem, end=1.0, weights=None)
    fit, *others_as_deep = _last(whole, s, rng)
    fit, changed = (fit, {}) if has_impacts(fit.model) else halved(whole, fit, s.searcher.frozen)
    tight = _widened(spans_of(whole, fit, others_as_deep), changed)
    spans = _with_room(tight, whole, fit, s.searcher.frozen)
    ends = [(float(r.position.min()), float(r.position.max())) for r in ready.problem.session.records]
    travel = max(high for _, high in ends) - min(low for low, _ in ends)
    told = describe(ready.findings, fit, found, s.searcher, others, spans, rng)
    named, terms = formulas(*told, travel / nominal.pitch, {n for force in ready.timed for n in force.beside})
    terms += [force.term for force in ready.timed]
    open_rivals = [r for r in others if r.open]
    ratio = found.fit.ratio
    disturbance = ratio > QUIET and burst > BURSTS and s.share < UNEXPLAINED and not has_impacts(found.fit.model)
    odd = ratio > AXIS.odd and s.share > UNEXPLAINED
    leaning = [e for e in named if e.name not in s.searcher.frozen and leans(fit.model, e.name)]
    beyond = ratio > (LARGE if named or terms or ready.points else LOUD)
    if runs_away(found.fit.model):
        judged = replace(judged, refusals=(*judged.refusals, of_inertia(nominal, found.fit.model)))
    if ready.strays:
        judged = replace(judged, refusals=(*judged.refusals, ready.strays))
    missing = bool(terms) or bool(leaning) or disturbance or beyond or odd or bool(judged.refusals)
    # what makes the force is a part of the model, too: with none of its mechanics missing it is not right
    missing = missing or (not named and foreign(searched(ready.problem.session), nominal))
    blindly = ready.blind and any(e.name == PAYLOAD for e in named)
    wave = locked(ready.problem, found.fit)
    missing = missing or (wave is not None and wave.share > (MOSTLY_LOCKED if named else LOCKED))
    changing = [] if missing else _changing(s, named)
    turned = [] if missing else _turned(s, named)
    missing = missing or bool(changing) or bool(turned)
    drives = [f.effect for f in ready.findings if f.doubted]
    said = outcome(bool(named), missing, bool(open_rivals) or blindly or bool(drives))
    gaps = tuple(_told(g, said is Outcome.UNEXPLAINED) for g in gaps)
    notes = [*ready.notes, *judged.notes, *judged.refusals]
    notes += [f"{e.title} leans on the end of what it can be: it stands for something else" for e in leaning]
    if ready.held and any(e.name in TIMES for e in named):
        notes.append(HELD.format(0.5e3 * fit.model.sample_time_s))
    if wave is not None:
        notes.append(wave.text)
    if disturbance:
        notes.append(of_bursts(ready.problem, found.fit, burst))
    elif beyond or (ratio > LOUD and not (ready.points or has_impacts(found.fit.model))):
        notes.append(of_much(ratio, s.share))
    if not judged.refusals:
        notes += likened(s.searcher, found)
        if any(e.name in OPPOSING for e in terms):
            notes += [text for text in (friction_told(whole, fit),) if text]
            named = [_at_rest(e, whole, fit, notes) for e in named]
    notes += [of_change(known()[c.effect].title, c, ratio) for c in changing]
    notes += [of_bend(known()[b.effect].title, b) for b in turned]
    if ready.blind:
        notes.insert(0, remark(nominal))
    tried = refused(named, leaning, bool(judged.refusals), beyond)
    tried += another_law(named, changing, turned)
    if judged.refusals:
        tried += tuple(Candidate(e.name, e.title, REFUSED_FREE) for e in terms if e.name in fit.model.effects)
    elif said is Outcome.UNEXPLAINED and not has_impacts(fit.model):
        tried += idle((ready.problem, ready.final), found.fit.model, (*named, *terms), tried, s.searcher.frozen)
        small = [e for e in named if e.name not in s.searcher.frozen and dwarfed(e, terms)]
        gone = {c.name for c in tried}
        tried += tuple(Candidate(e.name, e.title, REFUSED_SMALL) for e in small if e.name not in gone)
    terms = [e for e in terms if e.name not in {c.name for c in tried}]
    found_here = [e for e in named if e.name not in {c.name for c in tried}]
    others_said = _alternatives(fit.model, found_here, open_rivals, blindly) if said is Outcome.AMBIGUOUS else ()
    if drives and said is Outcome.AMBIGUOUS:
        others_said = (*others_said, tuple(OTHER_LAW if e.name in drives else e.name for e in found_here))
        notes.append(OF_DRIVE.format(" and ".join(e.title for e in found_here if e.name in drives)))
    if blindly:
        found_here = [_rated(e, nominal, fit.model) for e in found_here]
    open_now = open_rivals if said is Outcome.AMBIGUOUS else []
    if nominal.imposed:  # no command is designed for a rig
        notes += [
            TO_TELL.format(*(known()[n].title for n in (r.effect, r.rival)), known()[r.rival].separate)
            for r in open_now
        ]
    searched_for = [e for e in found_here if e.name not in s.searcher.frozen]
    # beside a gap the remainder is of bounces, which no other effect can be
    doubtful = [] if has_impacts(found.fit.model) else [e.name for e in searched_for if doubted(e, ratio)]
    hanging = [e.name for e in searched_for if e.name not in doubtful and hangs(e.name, tight, spans)]
    for doubts, of in ((doubtful, of_doubts), (hanging, of_hanging)):
        if doubts and said in (Outcome.NAMED, Outcome.AMBIGUOUS):
            said = Outcome.AMBIGUOUS
            others_said = (*others_said, tuple(e.name for e in found_here if e.name not in doubts))
            notes.append(of([e.title for e in found_here if e.name in doubts]))
    places, spectrum, traces = pictures(ready, nominal, found.fit.model, o, rng)
    return AxisVerdict(
        outcome=said,
        nominal=nominal,
        model=as_stated(fit.model, nominal) if judged.refusals else fit.model,
        effects=tuple(found_here),
        candidates=tried,
        alternatives=others_said,
        symbolic=tuple(terms),
        gaps=gaps,
        path=found.path,
        rungs=rungs(ready.final, [step.model for step in found.path]),
        findings=ready.findings,
        missing=s.excited.missing,
        pairs=s.excited.pairs,
        places=places,
        spectra=spectrum,
        decisive=_plan(ready, o, fit.model, open_now) if open_now else None,
        ratio=ratio,
        smoother_share=s.share,
        burst_share=burst,
        effective_samples=effective_samples(found.fit.residual),
        samples=len(found.fit.residual),
        notes=tuple(notes),
        traces=traces,
        states=tuple((r.name, q) for r, q in zip(ready.final.session.records, states, strict=True)),
        rejected=s.rejected,
        others=tuple(q.fit.model.effects for q in open_now),
    )


def _changing(s: Searched, named: Sequence[NamedEffect]) -> list[Uneven]:
    """Return what is named whose numbers are not the same everywhere; beside a gap the remainder is of bounces."""
    fit = s.found.fit
    if s.searcher.done(fit) or has_impacts(fit.model):
        return []
    return uneven(s.ready.problem, fit, [e.name for e in named if e.name not in s.searcher.frozen])


def _turned(s: Searched, named: Sequence[NamedEffect]) -> list[Bend]:
    """Return what is named whose exponents are others; beside a gap the remainder is of bounces."""
    fit = s.found.fit
    if has_impacts(fit.model):
        return []
    return bent(s.ready.problem, fit, [e.name for e in named if e.name not in s.searcher.frozen])


def _with_room(spans: Spans, whole: Problem, fit: Fit, frozen: Sequence[str]) -> Spans:
    """Widen intervals by what exponents that the records do not tell leave open."""
    if has_impacts(fit.model):
        return spans
    room = loosened(whole, fit, [n for n in fit.model.effects if n not in frozen])
    return _widened(spans, room)


def _widened(spans: Spans, room: Mapping[tuple[str, str], float]) -> Spans:
    return {key: _wide(span, room.get(key, 0.0)) for key, span in spans.items()}


def hangs(name: str, tight: Spans, wide: Spans) -> bool:
    """Say whether an effect may be none for no other reason than what exponents leave open."""
    effect = known()[name]
    key, nothing = (name, effect.primary.symbol), effect.neutral
    return key in tight and not tight[key][0] <= nothing <= tight[key][1] and wide[key][0] <= nothing <= wide[key][1]


def _wide(span: tuple[float, float], room: float) -> tuple[float, float]:
    middle, half = 0.5 * (span[0] + span[1]), 0.5 * (span[1] - span[0])
    half = float(np.hypot(half, room))
    return middle - half, middle + half


def _alternatives(
    model: AxisModel, found: Sequence[NamedEffect], rivals: Sequence[Rival], blindly: bool
) -> tuple[tuple[str, ...], ...]:
    """Return the sets of names that explain as well; a payload may be another sample time where nothing tells that."""
    sets = [alternative(r, model.effects) for r in rivals]
    if blindly:
        sets.append(tuple(SAMPLE_TIME if e.name == PAYLOAD else e.name for e in found))
    return tuple(sets)


def _at_rest(e: NamedEffect, whole: Problem, fit: Fit, notes: list[str]) -> NamedEffect:
    """Give Coulomb friction beside a law without a name the level that friction has when extrapolated to rest: how much
    of it the law takes is a convention.
    """
    if e.name != "coulomb" or (told := at_rest(whole, fit)) is None:
        return e
    (level, *rest), (value, half) = e.parameters, told
    level = replace(level, value=value, low=value - half, high=value + half)
    notes.append(AT_REST)
    return replace(e, parameters=(level, *rest))


def _rated(e: NamedEffect, nominal: AxisModel, model: AxisModel) -> NamedEffect:
    """Tell beside a payload which sample time would do the same."""
    if e.name != PAYLOAD:
        return e
    return replace(e, evidence=(*e.evidence, instead(nominal, model.effects[PAYLOAD]["J_extra"])))


def _gaps(s: Searched, states: Sequence[State], rng: np.random.Generator) -> tuple[tuple[Gap, ...], Judgement]:
    """Measure the gaps, and judge the model by its free run; before, nothing was known of a force in time."""
    ready, nominal, model = s.ready, s.ready.nominal, s.found.fit.model
    noise = disturbance(ready.problem, model, s.share)
    floor = closed_floor(ready.final, model, noise, rng)
    plain = ready.final if ready.apart else as_recorded(ready.final, ready.timed)
    gaps = measure(ready.final, nominal, model, floor, states)
    if ready.timed and not ready.apart:
        before = measure(plain, nominal, nominal, floor)
        gaps = tuple(replace(g, before=p.before) for g, p in zip(gaps, before, strict=True))
    free = freely((plain, ready.final), (nominal, model), noise, rng)
    if nominal.imposed:  # small forces that are wrong add up in a motion that they do not make
        free = tuple(f for f in free if np.isfinite(f.horizon_s))
        return gaps, judge(ready.final, model, free, gaps, noise.size)
    judged = judge(ready.final, model, free, gaps, noise.size)
    return (*gaps, *free_gaps(free, nominal.position_unit)), judged


def _told(gap: Gap, missing: bool) -> Gap:
    """Take no floor for known that is refuted by what is left, or that holds what is missing."""
    read_off = gap.floor_from == ON_MODEL
    refuted = gap.after < REFUTED * gap.floor if read_off and not missing else missing and gap.after <= gap.floor
    return replace(gap, floor=np.nan) if refuted or (read_off and missing) else gap


def _last(problem: Problem, s: Searched, rng: np.random.Generator) -> tuple[Fit, ...]:
    """Fit once more to all samples; beside a gap the fits from elsewhere come after it."""
    model = s.found.fit.model
    if has_impacts(model):
        return deepest(problem, model, s.searcher.frozen, rng)
    fit = refit(problem, model, s.searcher.frozen, LAST)
    worse = fit.cost > float(np.sum(problem.residual(model) ** 2))
    return (replace(fit, model=model) if worse else fit,)


def _plan(ready: Prepared, o: Options, model: AxisModel, open_rivals: Sequence[Rival]) -> Experiment | None:
    """Choose the experiment that separates the model from its open rivals."""
    envelope = o.envelope or _seen(ready.problem.session, model)
    return separate([model, *(q.fit.model for q in open_rivals)], envelope, ready.problem.noise.drive)


def _seen(session: Session, model: AxisModel) -> Envelope:
    """Take the travel that the records show, on a rotary axis a little more than a pitch to either side at least."""
    centre = float(session.records[0].position[0])
    reach = max(float(np.max(np.abs(r.position - centre))) for r in session.records)
    return Envelope.of(model, centre, max(reach, 1.1 * model.pitch) if model.rotary else reach)
